"""Checking a container from an untrusted source that does not fit into memory: values and errors by bands."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..container.digest import little_endian
from ..container.model import Header
from ..decoding.by_bands import decoder_by_bands, why_not_by_bands
from ..decoding.by_blocks import BYTES, BlocksDecoder
from ..decoding.by_rows import RowsDecoder
from ..decoding.inspected_sections import Walked, walk
from ..decoding.inspection import (
    READ,
    Inspection,
    Measured,
    check_errors,
    check_levels,
    check_values,
    corners_of,
    inspect_whole,
    states_of,
)
from ..decoding.reconstruction import Values
from ..errors import CorruptStreamError, TooLargeError
from ..grid.patches import level_shapes
from ..library import require
from ..parallel import spread, threads
from ..quantization.distortion import originals_of, other_originals
from ..surface import Block, Surface
from .grid_measuring import BlocksMeasurer
from .measuring import Figures, RowsMeasurer, distances_of
from .windows import RowsGiven

__all__ = ["inspect"]

#: Bytes that looking a container through takes for each value, in one piece.
_WHOLE = 24
#: Of the memory, what decoding a band may take; and points of the levels that are restored as their metadata say.
_PART, _MOST_POINTS = 4, 1 << 20
#: How much of it is done when all rows are measured.
_MEASURED = 0.95


def inspect(
    file: BinaryIO,
    *,
    max_vertices: int,
    memory: int,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Inspection:
    """Check a whole container as `lodestream.decoding.inspection.inspect` does, by bands of rows if it is large.

    Of a large one only levels of up to a million points are restored as the metadata say.

    Parameters
    ----------
    file : binary file
        The container and nothing else; seekable.
    max_vertices : int
        Larger surfaces are refused.
    memory : int
        Bytes to work in, about.
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
        If it has more vertices than allowed, or takes more memory and cannot be decoded by bands.
    UnavailableError
        If the compiled kernels are missing.
    """
    require("looking a container through")
    walked = walk(
        file,
        max_vertices=max_vertices,
        keeps=lambda header: _fits(header, memory),
        progress=lambda part: progress(READ * part),
    )
    header = walked.index.header
    if _fits(header, memory):
        return inspect_whole(walked, progress)
    if (reason := why_not_by_bands(header, memory)) is not None:
        raise TooLargeError(
            f"expected a surface that takes at most {memory >> 20:,} MiB to check, got one that takes about "
            f"{_values(header) * _WHOLE >> 20:,} MiB and cannot be decoded by bands: {reason}"
        )
    return _by_bands(file, walked, memory // _PART, progress)


def _values(header: Header) -> int:
    return sum(rows * columns for (rows, columns), _ in header.blocks) * header.channels


def _fits(header: Header, memory: int) -> bool:
    return _values(header) * _WHOLE <= memory


@dataclass(frozen=True)
class _Found:
    """What decoding by bands tells: the SHA-256 of all values, holes, corners of parts, and figures if any are."""

    digest: str
    holes: tuple[int, ...]
    corners: list[NDArray[Any]]
    figures: list[Figures]


def _by_bands(file: BinaryIO, walked: Walked, memory: int, progress: Callable[[float], None]) -> Inspection:
    def read(offset: int, length: int) -> bytes:
        file.seek(offset)
        return file.read(length)

    index, header = walked.index, walked.index.header
    states = list(states_of(walked)) if header.exact else []
    check_levels(index, lambda level: _level(header, index.metadata_values, level), _MOST_POINTS)
    decoder = decoder_by_bands(read, index)
    if isinstance(decoder, RowsDecoder):
        found = _of_rows(decoder, states, memory, progress)
    else:
        found = _of_blocks(decoder, states, memory, progress)
    check_values(index, found.holes, found.corners)
    if index.digest is not None and found.digest != index.digest:
        problem = f"expected values with the SHA-256 {index.digest}, got {found.digest}"
        raise CorruptStreamError(problem, header.length)
    if header.exact:
        check_errors(walked, _errors(header, found.figures, len(states)), lambda part: None)
    progress(1.0)
    return Inspection(index, header.exact)


def _of_rows(
    decoder: RowsDecoder, states: Sequence[NDArray[np.int8]], memory: int, progress: Callable[[float], None]
) -> _Found:
    """Decode and measure the rows of the one grid, some at a time."""
    header, hashed = decoder.header, decoder.index.digest is not None
    groups, passes = decoder.groups(memory), 1 + (len(header.attributes) if hashed else 0)
    digest, holes, corners, figures = hashlib.sha256(), 0, list[NDArray[Any]](), list[Figures]()
    for number, group in enumerate(groups, 1):
        for rows, band in zip(group, spread(lambda rows: _band(decoder, rows, states), group), strict=True):
            digest.update(little_endian(band.points))
            mask = header.masks[0]
            holes += _holes(band.points, None if mask is None else mask[slice(*rows)])
            corners += band.corners
            figures += band.figures
        progress(READ + (_MEASURED - READ) * number / len(groups) / passes)
    # An array is hashed whole before the next one, so each attribute takes another pass.
    for attribute in range(1, passes):
        for group in groups:
            for values in spread(decoder.rows, group):
                digest.update(little_endian(values.arrays[attribute]))
        progress(READ + (_MEASURED - READ) * (attribute + 1) / passes)
    return _Found(digest.hexdigest(), (holes,), corners, figures)


def _holes(points: NDArray[Any], mask: NDArray[np.bool_] | None) -> int:
    """Points that are not valid, or not finite, of some of shape (row, column, component)."""
    count = points.shape[0] * points.shape[1]
    if points.dtype.kind != "f":
        return 0 if mask is None else int(count - np.count_nonzero(mask))
    valid = np.isfinite(points[..., :3]).all(axis=2)
    return int(count - np.count_nonzero(valid if mask is None else valid & mask))


@dataclass(frozen=True)
class _Band:
    """What is kept of a band: its points, shape (row, column, component), their corners, and figures if any are."""

    points: NDArray[Any]
    corners: list[NDArray[Any]]
    figures: list[Figures]


def _band(decoder: RowsDecoder, rows: tuple[int, int], states: Sequence[NDArray[np.int8]]) -> _Band:
    """Decode some rows, and measure them in these states."""
    header = decoder.header
    geometry, tiles = decoder.tiles(rows)
    arrays = decoder.values(geometry, tiles).arrays
    mask = None if header.masks[0] is None else header.masks[0][slice(*rows)]
    figures = []
    if states:
        given = RowsGiven.of(arrays[0], arrays, mask, header.geometric)
        measurer = RowsMeasurer(given, header.lattices, header.geometric, header.predictors, geometry, tiles)
        figures = [measurer.figures(states)]
    return _Band(arrays[0], corners_of(arrays[0], mask), figures)


def _of_blocks(
    decoder: BlocksDecoder, states: Sequence[NDArray[np.int8]], memory: int, progress: Callable[[float], None]
) -> _Found:
    """Decode and measure some blocks at a time: runs of them by several threads, as far as there is memory for all."""
    digest, corners, figures = hashlib.sha256(), list[NDArray[Any]](), list[Figures]()
    holes, masks = list[int](), decoder.header.masks
    for together in _together(decoder, memory):
        for values, own in spread(lambda blocks: _measured(decoder, blocks, states), together):
            for block, found in values.items():
                for array in found.arrays:
                    digest.update(little_endian(array))
                corners += corners_of(found.arrays[0], masks[block])
                holes.append(_holes(found.arrays[0], masks[block]))
            figures += own
        progress(READ + (_MEASURED - READ) * together[-1].stop / len(decoder.header.blocks))
    return _Found(digest.hexdigest(), tuple(holes), corners, figures)


def _together(decoder: BlocksDecoder, memory: int) -> Iterator[list[range]]:
    """Runs of blocks, as many at a time as there are threads and as fit into memory, but at least one."""
    found: list[range] = []
    taken = 0
    for blocks in decoder.groups(memory // threads()):
        points = sum(rows * columns for rows, columns in decoder.shapes[blocks.start : blocks.stop])
        own = points * decoder.header.channels * BYTES
        if found and (len(found) == threads() or taken + own > memory):
            yield found
            found, taken = [], 0
        found.append(blocks)
        taken += own
    yield found


def _measured(
    decoder: BlocksDecoder, blocks: range, states: Sequence[NDArray[np.int8]]
) -> tuple[dict[int, Values], list[Figures]]:
    """Decode some blocks, and measure them in these states."""
    header, tiles, patches = decoder.header, decoder.tiles(blocks), decoder.patches(blocks)
    values = decoder.values(blocks, tiles)
    if not states:
        return values, []
    points = {block: own.arrays[0] for block, own in values.items()}
    arrays = {block: own.arrays for block, own in values.items()}
    coordinates = originals_of(header.arrangement, points, header.masks, patches)
    others = other_originals(header.arrangement, arrays, header.masks, header.geometric, patches)
    return values, [BlocksMeasurer(header, tiles, blocks, patches).figures(states, coordinates, others)]


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
    return Surface(blocks=blocks, metadata=dict(metadata))


def _errors(header: Header, figures: list[Figures], states: int) -> list[Measured]:
    """The errors of all states of the whole surface."""
    found = [distances_of(figures, number, header.geometric, header.dtypes) for number in range(states)]
    if any(one is None for one in found):
        raise TooLargeError("expected values whose squares float64 holds, in a surface this large, got others")
    return [one for one in found if one is not None]
