"""Checking a container from an untrusted source: every section, the index, every value, and the recorded errors."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..container.digest import little_endian
from ..container.model import Header
from ..decoding.inspected_sections import walk
from ..decoding.inspection import (
    READ,
    Inspection,
    check_errors,
    check_levels,
    check_values,
    corners_of,
    states_of,
)
from ..decoding.level_grids import at_level, level_nodes, with_rules
from ..decoding.measurer import Figures, Measured, Measurer, comparisons, distances_of
from ..decoding.pieces import PiecewiseDecoder, why_not_by_pieces
from ..decoding.region import Region
from ..decoding.values import Values, block_of
from ..entropy.tiles import Tiles
from ..errors import CorruptStreamError, TooLargeError
from ..grid.patches import level_shapes
from ..library import require
from ..parallel import spread
from ..surface import Block, Surface
from .memory import default_memory

__all__ = ["inspect"]

#: Bytes that looking a container through takes for each value, in one piece.
_WHOLE_BYTES = 24
#: Of the memory, what decoding pieces may take; and points of the levels that are restored as their metadata say.
_PIECES_SHARE, _MOST_POINTS = 4, 1 << 20
#: How much of it is done when all pieces are measured.
_MEASURED = 0.95


def inspect(
    file: BinaryIO,
    *,
    max_vertices: int,
    memory: int | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Inspection:
    """Check a whole container, and decode it once, piece by piece.

    Nothing is decoded before the header has announced the number of vertices. For an exact container each layer and
    level is decoded and compared with the complete surface, which takes about as long as measuring them did in the
    encoder. Only levels of up to a million points are restored as the metadata say.

    Parameters
    ----------
    file : binary file
        The container and nothing else; seekable.
    max_vertices : int
        Larger surfaces are refused.
    memory : int, optional
        Bytes to work in, about; a quarter of what there is if not given.
    progress : callable
        Called from time to time with the fraction done, 0 to 1.

    Raises
    ------
    CorruptStreamError
        If it is damaged, contradicts itself, or is followed by more bytes; with the offset.
    TruncatedStreamError
        If it is cut short; the message names the offset.
    UnsupportedVersionError
        If this program does not read its version.
    TooLargeError
        If it has more vertices than allowed, or takes more memory and cannot be decoded by pieces.
    UnavailableError
        If the compiled kernels are missing.
    """
    require("looking a container through")
    memory = default_memory() if memory is None else memory
    walked = walk(file, max_vertices=max_vertices, progress=lambda part: progress(READ * part))
    index, header = walked.index, walked.index.header
    size = sum(rows * columns for (rows, columns), _ in header.blocks) * header.channels * _WHOLE_BYTES
    if size > memory and (reason := why_not_by_pieces(header, memory)) is not None:
        raise TooLargeError(
            f"expected a surface that takes at most {memory >> 20:,} MiB to check, got one that takes about "
            f"{size >> 20:,} MiB and cannot be decoded by pieces: {reason}"
        )

    def read(offset: int, length: int) -> bytes:
        file.seek(offset)
        return file.read(length)

    states = list(states_of(walked)) if header.exact else []
    check_levels(index, lambda level: _level(header, index.metadata_values, level), _MOST_POINTS)
    decoder = PiecewiseDecoder(read, index)
    result = _decoded(decoder, states, memory // (_PIECES_SHARE if size > memory else 1), progress)
    check_values(index, result.holes, result.corners)
    if index.digest is not None and result.digest != index.digest:
        problem = f"expected values with the SHA-256 {index.digest}, got {result.digest}"
        raise CorruptStreamError(problem, header.length)
    if header.exact:
        errors = _errors(decoder, result.figures, states, size <= memory)
        check_errors(walked, errors, lambda part: progress(_MEASURED + (1 - _MEASURED) * part))
    progress(1.0)
    return Inspection(index, header.exact)


@dataclass(frozen=True)
class _Decoded:
    """What decoding tells: the SHA-256 of all values, holes of each block, corners of parts, and figures if any are."""

    digest: str
    holes: tuple[int, ...]
    corners: list[NDArray[Any]]
    figures: list[Figures]


@dataclass(frozen=True)
class _Part:
    """Some rows of a block, or all: points and attributes, shape (row, column, component), and which are valid."""

    arrays: list[NDArray[Any]]
    mask: NDArray[np.bool_] | None

    @property
    def holes(self) -> int:
        """Points that are not valid, or not finite."""
        points = self.arrays[0]
        count = points.shape[0] * points.shape[1]
        if points.dtype.kind != "f":
            return 0 if self.mask is None else int(count - np.count_nonzero(self.mask))
        valid = np.isfinite(points[..., :3]).all(axis=2)
        return int(count - np.count_nonzero(valid if self.mask is None else valid & self.mask))


def _decoded(
    decoder: PiecewiseDecoder,
    states: Sequence[NDArray[np.int8]],
    memory: int,
    progress: Callable[[float], None],
) -> _Decoded:
    """Decode all pieces, and measure them in these states."""
    header = decoder.header
    digest, corners, figures = hashlib.sha256(), list[NDArray[Any]](), list[Figures]()
    holes, lists = [0] * len(header.blocks), list(decoder.pieces(memory))
    # An array is hashed whole before the next one, so of bands of rows each attribute takes another pass.
    divided = lists[0][0].spans is not None and sum(map(len, lists)) > 1
    passes = 1 + (len(header.attributes) if divided and decoder.index.digest is not None else 0)
    for number, together in enumerate(lists, 1):
        for parts, measured in spread(lambda region: _piece(decoder, region, states), together):
            for block, part in parts.items():
                for array in part.arrays[:1] if divided else part.arrays:
                    digest.update(little_endian(array))
                corners += corners_of(part.arrays[0], part.mask)
                holes[block] += part.holes
            figures += measured
        progress(READ + (_MEASURED - READ) * number / len(lists) / passes)
    for attribute in range(1, passes):
        for together in lists:
            for found in spread(decoder.segments.values, together):
                digest.update(little_endian(found[0].arrays[attribute]))
        progress(READ + (_MEASURED - READ) * (attribute + 1) / passes)
    return _Decoded(digest.hexdigest(), tuple(holes), corners, figures)


def _piece(
    decoder: PiecewiseDecoder, region: Region, states: Sequence[NDArray[np.int8]]
) -> tuple[dict[int, _Part], list[Figures]]:
    """Decode a piece, by block, and measure it in these states, if there are any."""
    header, tiles = decoder.header, decoder.segments.channels(region)
    values = decoder.segments.values_from(region, tiles)
    figures = [_measurer(header, region, tiles, values).figures(states)] if states else []
    rows = slice(None) if region.spans is None else slice(*region.spans[0])
    parts = {}
    for block, (arrays, mask) in ((block, (own.arrays, header.masks[block])) for block, own in values.items()):
        mask = None if mask is None else mask[rows]
        if header.plane is not None:  # never divided
            heights = Surface(blocks=[block_of(header, arrays, header.closed, mask)])
            arrays = [with_rules(heights, header, None, header.kept_masks[0]).points, *arrays[1:]]
        parts[block] = _Part(arrays, mask)
    return parts, figures


def _measurer(header: Header, region: Region, tiles: Sequence[Tiles], values: Mapping[int, Values]) -> Measurer:
    """What measures a region, whose values in the end are these."""
    rows = slice(None) if region.spans is None else slice(*region.spans[0])
    arrays = {block: own.arrays for block, own in values.items()}
    points = {block: own[0] for block, own in arrays.items()}
    masks = [None if mask is None else mask[rows] for mask in header.masks]
    compared = comparisons(region, header.arrangement, header.geometric, points, arrays, masks)
    return Measurer(header, region, tiles, compared)


def _level(header: Header, metadata: Mapping[str, Any], level: int) -> Surface:
    """A surface of a level's shape whose values are 0: as much as its metadata are about."""
    shapes = level_shapes(header.patches, header.layout, level, [shape for shape, _ in header.blocks])
    counts = (header.point_channels, *(kind.channels for kind in header.attributes))
    first = [sum(counts[:number]) for number in range(len(counts))]
    blocks = []
    for shape, (_, closed), mask in zip(shapes, header.blocks, header.masks, strict=True):
        points, *others = (
            np.zeros((*shape, count), header.dtypes[channel]) for count, channel in zip(counts, first, strict=True)
        )
        attributes = {
            kind.name: array if kind.components else array[..., 0]
            for kind, array in zip(header.attributes, others, strict=True)
        }
        valid = None if mask is None else np.ones(shape, np.bool_)
        blocks.append(Block(points[..., 0] if header.flat else points, closed, mask=valid, attributes=attributes))
    surface = Surface(blocks=blocks, metadata=dict(metadata))
    if level < header.levels:
        surface = at_level(surface, header, level)
    if header.plane is not None:
        values = surface.metadata
        surface = with_rules(surface, header, None if level == header.levels else level_nodes(header, level)[0])
        surface.metadata = values
    return surface


def _errors(
    decoder: PiecewiseDecoder, figures: list[Figures], states: Sequence[NDArray[np.int8]], fits: bool
) -> list[Measured]:
    """The errors of all states of the whole surface; ``fits``: it may be decoded in one piece.

    Raises
    ------
    TooLargeError
        If float64 does not hold the squares of the values, which are then looked at in one piece, and it does not fit.
    """
    header = decoder.header
    measured = [distances_of(header, figures, number) for number in range(len(states))]
    if None not in measured:
        return [distances for distances in measured if distances is not None]
    if not fits:
        raise TooLargeError("expected values whose squares float64 holds, in a surface this large, got others")
    region = Region.whole(header.layout, header.levels)
    tiles = decoder.segments.channels(region)
    measurer = _measurer(header, region, tiles, decoder.segments.values_from(region, tiles))
    return [distances or measurer.exact_errors(state) for distances, state in zip(measured, states, strict=True)]
