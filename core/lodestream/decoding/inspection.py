"""Check a container from an untrusted source: every section, the index, every value, and the recorded errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..container.capacity import default_memory
from ..container.digest import ValuesDigest
from ..container.fields import told, told_roughly
from ..container.model import Errors, Header, Index, LayerRecord
from ..coordinates.height_fields import to_xyz
from ..coordinates.seams import restore
from ..entropy.tiles import Tiles
from ..errors import CorruptStreamError, InputError, TooLargeError
from ..grid.patches import level_shapes
from ..library import require
from ..parallel import spread
from ..planning.window_errors import CELL, WindowErrors, layer_codes
from ..quantization.measure import extent_of
from ..surface import Block, Surface
from .inspected_sections import Walked, walk
from .level_grids import at_level, level_nodes, with_rules
from .measurer import Figures, Measured, Measurer, comparisons, distances_of
from .pieces import why_not_by_pieces
from .piecewise import PiecewiseDecoder
from .progress import initial_state
from .region import Region
from .values import Values, block_of

__all__ = ["Inspection", "inspect"]

#: By how much, of itself, a recorded error may differ from the one found. Values are the same bit for bit wherever they
#: are decoded; but who adds up as many squares as a surface may have points in another order finds another last digit.
_TOLERANCE = 1e-9

#: How much is done when all sections are read, and when all pieces are measured.
_READ, _MEASURED = 0.2, 0.95
#: Bytes that looking a container through takes for each value, in one piece.
_WHOLE_BYTES = 24
#: Of the memory, what decoding pieces may take; and points of the levels that are restored as their metadata say.
_PIECES_SHARE, _MOST_POINTS = 4, 1 << 20
#: What the functions that put a surface back where its metadata say may raise when these say something else.
_UNUSABLE = (InputError, TypeError, ValueError, LookupError, AttributeError, ArithmeticError, RecursionError)


@dataclass(frozen=True)
class Inspection:
    """The result of checking a container that is sound.

    Attributes
    ----------
    index : Index
    errors_checked : bool
        Whether the recorded errors were measured again. This needs the original values, which only an exact container
        has; otherwise the errors are what the container's maker claims.
    """

    index: Index
    errors_checked: bool


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
    walked = walk(file, max_vertices=max_vertices, progress=lambda part: progress(_READ * part))
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

    states = list(_states_of(walked)) if header.exact else []
    _check_levels(index, lambda level: _level(header, index.metadata_values, level), _MOST_POINTS)
    decoder = PiecewiseDecoder(read, index)
    result = _decoded(decoder, states, memory // (_PIECES_SHARE if size > memory else 1), progress)
    _check_values(index, result.holes, result.corners)
    if index.digest is not None and result.digest != index.digest:
        problem = f"expected values with the SHA-256 {index.digest}, got {result.digest}"
        raise CorruptStreamError(problem, header.length)
    if header.exact:
        errors = _errors(decoder, result.figures, states, size <= memory)
        _check_errors(walked, errors, lambda part: progress(_MEASURED + (1 - _MEASURED) * part))
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
    """Decode all pieces, and measure them in the given states."""
    header = decoder.header
    digest, corners, figures = ValuesDigest(), list[NDArray[Any]](), list[Figures]()
    holes, lists = [0] * len(header.blocks), list(decoder.pieces(memory))
    # An array is hashed whole before the next one, so of bands of rows each attribute takes another pass.
    divided = lists[0][0].spans is not None and sum(map(len, lists)) > 1
    passes = 1 + (len(header.attributes) if divided and decoder.index.digest is not None else 0)
    for number, together in enumerate(lists, 1):
        for parts, measured in spread(lambda region: _piece(decoder, region, states), together):
            for block, part in parts.items():
                for array in part.arrays[:1] if divided else part.arrays:
                    digest.take(array)
                corners += _corners_of(part.arrays[0], part.mask)
                holes[block] += part.holes
            figures += measured
        progress(_READ + (_MEASURED - _READ) * number / len(lists) / passes)
    for attribute in range(1, passes):
        for together in lists:
            for block_values in spread(decoder.segments.values, together):
                digest.take(block_values[0].arrays[attribute])
        progress(_READ + (_MEASURED - _READ) * (attribute + 1) / passes)
    return _Decoded(digest.hexdigest(), tuple(holes), corners, figures)


def _piece(
    decoder: PiecewiseDecoder, region: Region, states: Sequence[NDArray[np.int8]]
) -> tuple[dict[int, _Part], list[Figures]]:
    """Decode a piece, by block, and measure it in the given states, if there are any."""
    header, tiles = decoder.header, decoder.segments.channels(region)
    values = decoder.segments.values_from(region, tiles)
    figures = [_measurer(header, region, tiles, values).figures(states)] if states else []
    parts = {}
    for block, (arrays, mask) in (
        (block, (restored.arrays, header.masks[block])) for block, restored in values.items()
    ):
        mask = None if mask is None else region.of_block(mask)
        if header.plane is not None:  # never divided
            heights = Surface(blocks=[block_of(header, arrays, header.closed, mask)])
            arrays = [with_rules(heights, header, None, header.kept_masks[0]).points, *arrays[1:]]
        parts[block] = _Part(arrays, mask)
    return parts, figures


def _measurer(header: Header, region: Region, tiles: Sequence[Tiles], values: Mapping[int, Values]) -> Measurer:
    """Return a measurer of a region whose final values are ``values``."""
    arrays = {block: restored.arrays for block, restored in values.items()}
    points = {block: restored[0] for block, restored in arrays.items()}
    masks = [None if mask is None else region.of_block(mask) for mask in header.masks]
    compared = comparisons(region, header.arrangement, header.geometric, points, arrays, masks)
    return Measurer(header, region, tiles, compared)


def _level(header: Header, metadata: Mapping[str, Any], level: int) -> Surface:
    """Return a surface of zeros with a level's shape, to which its metadata can be attached."""
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
    """Return the errors of all states of the whole surface; ``fits``: it fits into memory in one piece.

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


def _check_values(index: Index, holes: tuple[int, ...], corners: Sequence[NDArray[Any]]) -> None:
    """Refuse a container whose holes or extent differ from its complete surface.

    The digest is checked while decoding.

    Parameters
    ----------
    index : Index
    holes : tuple of int
        Of each block.
    corners : sequence of arrays, shape (channel,)
        The least and the largest values of the valid points, or of parts of them.

    Raises
    ------
    CorruptStreamError
        If anything else was told.
    """
    header = index.header
    if index.digest is not None and not header.exact:
        raise CorruptStreamError(
            f"expected no SHA-256 of values that are not exact, got {index.digest!a:.80}", index.metadata.offset
        )
    if holes != (header.holes or (0,) * len(holes)):
        raise CorruptStreamError(f"expected {header.holes} holes in the blocks, got {holes}", 0)
    if any(count == rows * columns for count, ((rows, columns), _) in zip(holes, header.blocks, strict=True)):
        raise CorruptStreamError("expected a valid point in each block, got none", 0)
    if header.exact:
        box = np.stack(corners)[:, np.newaxis]
        extent = extent_of(box[..., 0] if box.shape[2] == 1 else box, min(box.shape[2], 3))
        if not math.isclose(extent, header.extent, rel_tol=_TOLERANCE):
            raise CorruptStreamError(f"expected the extent of the surface, {extent}, got {header.extent}", 0)


def _corners_of(points: NDArray[Any], mask: NDArray[np.bool_] | None) -> list[NDArray[Any]]:
    """Return the smallest and the largest values of valid points, shape (channel,).

    An empty list without valid points.

    Parameters
    ----------
    points : shape (row, column, channel)
    mask : bool, shape (row, column), or None
        True where a point is valid.
    """
    flat = points.reshape(-1, points.shape[2]) if mask is None else points[mask]
    return [flat.min(axis=0), flat.max(axis=0)] if len(flat) else []


def _check_levels(index: Index, surface_at: Callable[[int], Surface], most: int | None = None) -> None:
    """Reject metadata with which a level could not be written to a file.

    Parameters
    ----------
    index : Index
    surface_at : callable (level) -> Surface
        The finest level complete.
    most : int, optional
        Levels of more points are not looked at.

    Raises
    ------
    CorruptStreamError
        If a level cannot be restored.
    """
    finest = index.header.levels
    for level in range(finest + 1):
        if most is not None and index.header.layout.points(level) > most:
            break
        try:
            surface = restore(surface_at(level))
            if level < finest:
                to_xyz(surface)
        except _UNUSABLE as error:
            problem = f"{type(error).__name__}: {error}"
            raise CorruptStreamError(
                f"expected metadata with which level {level} can be restored, got others ({problem:.200})",
                index.metadata.offset,
            ) from None


def _states_of(walked: Walked) -> Iterator[NDArray[np.int8]]:
    """Yield the states with recorded errors, int8, shape (tile, channel).

    Of the layers, then of all levels but the last.
    """
    header = walked.index.header
    for _, view in zip(walked.index.layers, walked.decoder.layers, strict=False):
        yield view._state
    for known in walked.index.levels[:-1]:
        state = initial_state(header)
        state[: header.layout.tiles_of(known.level).stop] = 0
        yield state


def _check_errors(walked: Walked, measurements: Iterable[Measured], progress: Callable[[float], None]) -> None:
    """Refuse a container whose recorded errors of layers, levels or windows differ from the measured ones.

    Parameters
    ----------
    walked : Walked
        Of an exact container.
    measurements : iterable of (Errors, list)
        What was measured of each of `_states_of`.
    progress : callable
        Called with the fraction done.

    Raises
    ------
    CorruptStreamError
        If others were told.
    """
    index, windows = walked.index, walked.windows
    names: list[tuple[str, LayerRecord | None, Errors, int]] = [
        (f"layer {record.number}", record, record.errors, record.offset) for record in index.layers
    ]
    names += [(f"level {known.level}", None, known.errors, index.index.offset) for known in index.levels[:-1]]
    for number, ((name, record, errors, offset), (measured, cells)) in enumerate(
        zip(names, measurements, strict=True), 1
    ):
        _agree(errors, measured, name, offset)
        if record is not None and windows is not None and index.header.arrangement is None and cells:
            _bound(windows, cells[0], record)
        progress(number / len(names))
    nothing = Errors(0.0, 0.0, ((0.0, 0.0),) * len(index.levels[-1].channels))
    _agree(index.levels[-1].errors, nothing, "the exact surface", index.index.offset)


def _agree(stored: Errors, measured: Errors, what: str, offset: int) -> None:
    pairs = [(told, stored[:2], measured[:2])]
    pairs += [(told_roughly, *channel) for channel in zip(stored.channels, measured.channels, strict=True)]
    for rounded, recorded, other in pairs:
        for a, b in zip(recorded, other, strict=True):
            if not rounded(b * (1 - _TOLERANCE)) <= a <= rounded(b * (1 + _TOLERANCE)):
                wanted, got = (f"{pair[0]} and {pair[1]}" for pair in (other, recorded))
                raise CorruptStreamError(f"expected the RMS and maximum error of {what}, {wanted}, got {got}", offset)


def _bound(windows: WindowErrors, cells: NDArray[np.float64], layer: LayerRecord) -> None:
    """Refuse errors of windows below the measured ones, where the cells are the same."""
    known = layer_codes(cells, windows.header)
    if windows.cell != CELL or known is None:
        return
    if (windows.codes[:, layer.number] > known).any():
        raise CorruptStreamError(
            f"expected bounds of the errors of windows in layer {layer.number}, got smaller ones", 0
        )
