"""The values of a region: channels stored as values, restored by the residual, with holes marked."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from threading import local
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.chunks import ChunkPlace, chunks_within, first_chunks
from ..container.model import Header
from ..entropy.tiles import Tiles
from ..grid.patches import assemble, level_masks
from ..grid.window import taken
from ..parallel import spread, threads
from ..quantization.distortion import store_values
from ..residual import chunk_coder
from ..surface import Block, Closed, finite_block
from .reconstructor import Grid, KnownState, Reconstructor, known_state
from .region import Region, Span

__all__ = ["Chunks", "Values", "block_of", "mark_holes", "region_of_blocks", "restore", "values_of"]

#: Gives a chunk of the residual by its number: its bytes and where they stand; None if it is empty or not there.
Chunks = Callable[[int], tuple[bytes | memoryview, int] | None]

#: Rows of a band at most; of a wide one the fewest, and its values where it has more rows than these.
_BAND_ROWS, _FEWEST_ROWS, _BAND_VALUES = 512, 128, 1 << 20
#: Values of a level that one thread makes as a whole: bands would only be more calls.
_ONE_CALL_VALUES = 1 << 20
#: Least values of a level that threads share.
_SHARED_VALUES = 1 << 17
#: Numbers that a thread keeps room for: a new array costs more than what a band does in it.
_KEPT_NUMBERS = 3 << 19

_kept = local()


@dataclass
class Values:
    """A block's points, shape (row, column, channel), and those of its attributes."""

    arrays: list[NDArray[Any]]

    def channel(self, number: int) -> NDArray[Any]:
        """One channel, shape (row, column), a view."""
        for array in self.arrays:
            if number < array.shape[2]:
                return array[..., number]
            number -= array.shape[2]
        raise IndexError(number)

    def window(self, place: ChunkPlace, top: int = 0, left: int = 0) -> NDArray[Any]:
        """One channel at the place of a chunk, shape (row, column), a view.

        The arrays begin at row ``top`` and column ``left`` of the block.
        """
        rows, columns = (
            slice(start - first, stop - first)
            for (start, stop), first in zip((place.rows, place.columns), (top, left), strict=True)
        )
        return self.channel(place.channel)[rows, columns]

    def clear(self, holes: NDArray[np.bool_], hole: int) -> None:
        """Give holes (bool, shape (row, column)) the value that says so.

        NaN in floats, ``hole`` in integer points, 0 in integer attributes.
        """
        for number, array in enumerate(self.arrays):
            array[holes] = np.nan if array.dtype.kind == "f" else 0 if number else array.dtype.type(hole)


def region_of_blocks(header: Header, level: int, blocks: Sequence[int]) -> Region:
    """All points of some blocks at a level, and the interfaces that they need."""
    interfaces = len(header.layout.grids) - len(header.patches)
    patches = sorted(number for block in blocks for number, _ in header.block_patches[block])
    if len(patches) == len(header.patches):
        return Region.whole(header.layout, level)
    return Region.of_grids(header.layout, level, [interfaces + patch for patch in patches])


def values_of(
    header: Header,
    region: Region,
    channels: Sequence[Tiles],
    state: NDArray[np.int8],
    chosen: NDArray[np.bool_] | None = None,
) -> dict[int, Values]:
    """Return the values of a region by block, as the segments alone tell them: `restore` and `mark_holes` come after.

    Parameters
    ----------
    header : Header
    region : Region
    channels : sequence of Tiles, one for each channel
        Of all tiles of the surface, or of the region's `coded_tiles`.
    state : int8, shape (tile, channel)
        Passes that remain of each tile of the surface.
    chosen : bool, shape (channel,), optional
        Channels that are not chosen are 0. All if not given.
    """
    interfaces = len(header.layout.grids) - len(header.patches)
    patches = [grid - interfaces for grid in region.grids if grid >= interfaces]
    shapes = region.shapes[-len(patches) :]
    counts = header.point_channels, *(kind.channels for kind in header.attributes)
    wanted = [channel for channel in range(header.channels) if chosen is None or chosen[channel]]
    new = np.empty if len(wanted) == header.channels else np.zeros
    #: Of points and of each attribute, of each patch.
    arrays = [
        [new((*shape, count), header.dtypes[first]) for shape in shapes]
        for count, first in zip(counts, accumulate(counts, initial=0), strict=False)
    ]
    places = [(grids, component) for grids, count in zip(arrays, counts, strict=True) for component in range(count)]

    def store(work: _Work) -> None:
        reconstructor = Reconstructor(
            work.region,
            header.predictors[work.channel],
            channels[work.channel],
            work.channel < header.geometric,
            _room(work.region.size if work.below is None else work.region.size_above),
            work.below,
        )
        coordinates, fraction = reconstructor.reconstruct(work.known)
        grids, component = places[work.channel]
        for array, grid in zip(grids, coordinates[-len(patches) :], strict=True):
            part = array if work.rows is None else array[slice(*work.rows)]
            store_values(header.lattices[work.channel], (grid, fraction), part, component)

    def work_of(channel: int) -> list[_Work]:
        known = known_state(channels[channel].table, state[:, channel], region.level)
        if not _is_divided(region):
            return [_Work(channel, region, known)]
        below = _level_below(header.predictors[channel], channels[channel], state[:, channel], region)
        return [_Work(channel, _band(region, rows), known, below, rows) for rows in _bands(region)]

    spread(store, [work for of in spread(work_of, wanted) for work in of])
    if region.spans is not None:
        return {0: Values([array for (array,) in arrays])}
    blocks = sorted({header.patches[patch].block for patch in patches})
    return {block: Values(_assembled(header, region.level, block, patches, arrays)) for block in blocks}


def _assembled(
    header: Header, level: int, block: int, patches: Sequence[int], arrays: Sequence[Sequence[NDArray[Any]]]
) -> list[NDArray[Any]]:
    """The arrays of a block from those of patches, which stand by array and patch."""
    shape, every = header.blocks[block][0], []
    for grids in arrays:
        of_patch: list[NDArray[Any]] = [grids[0]] * len(header.patches)
        for patch, grid in zip(patches, grids, strict=True):
            of_patch[patch] = grid
        whole = assemble(header.block_patches[block], header.layout, level, shape, of_patch)
        every.append(np.ascontiguousarray(whole))
    return every


@dataclass(frozen=True)
class _Work:
    """A channel of a region, or of some rows of it above a level that is made already."""

    channel: int
    region: Region
    known: KnownState
    below: tuple[Grid, int] | None = None
    rows: Span | None = None


def _is_divided(region: Region) -> bool:
    """Whether all of a level of one grid is made by bands of rows.

    What a band takes stays in the processor's cache, no array holds all coefficients of the level, and several threads
    make bands at the same time.
    """
    if len(region.grids) > 1 or region.spans is not None or region.level == 0:
        return False
    return region.layout.points(region.level) > (_ONE_CALL_VALUES if threads() == 1 else _SHARED_VALUES)


def _bands(region: Region) -> list[Span]:
    """The rows of each band: as many bands for every thread."""
    ((rows, columns),) = region.shapes
    count = -(-rows // min(_BAND_ROWS, max(_FEWEST_ROWS, _BAND_VALUES // columns)))
    workers = threads()
    count = -(-count // workers) * workers
    bounds = [rows * number // count for number in range(count + 1)]
    return [(start, stop) for start, stop in pairwise(bounds) if stop > start]


def _band(region: Region, rows: Span) -> Region:
    ((_, columns),) = region.shapes
    return Region.window(region.layout, region.level, rows, (0, columns), region.level - 1)


def _level_below(
    predictors: NDArray[np.int8], tiles: Tiles, state: NDArray[np.int8], region: Region
) -> tuple[Grid, int]:
    """The only grid one level below a region, and the power of two that it stands over; by bands if it is large."""
    whole = Region.whole(region.layout, region.level - 1)
    known = known_state(tiles.table, state, whole.level)
    if threads() == 1 or not _is_divided(whole):
        (grid,), fraction = Reconstructor(whole, predictors, tiles).reconstruct(known)
        return grid, fraction
    below = _level_below(predictors, tiles, state, whole)
    array = np.empty(whole.shapes[0], np.int32)

    def put(rows: Span) -> int:
        band = _band(whole, rows)
        reconstructor = Reconstructor(band, predictors, tiles, True, _room(band.size_above), below)
        (grid,), fraction = reconstructor.reconstruct(known)
        array[slice(*rows)] = grid
        return fraction

    return array, spread(put, _bands(whole))[0]


def _room(size: int) -> NDArray[np.int32]:
    """Room for so many numbers, whatever it holds: this thread's, until the thread asks again."""
    kept: NDArray[np.int32] | None = getattr(_kept, "room", None)
    if kept is None or kept.size < size:
        kept = np.empty(size, np.int32)
        if size <= _KEPT_NUMBERS:
            _kept.room = kept
    return kept


def block_of(
    header: Header,
    arrays: Sequence[NDArray[Any]],
    closed: Closed,
    mask: NDArray[np.bool_] | None,
    names: Sequence[str] | None = None,
    finite: bool = False,
) -> Block:
    """Make a block of its arrays.

    Parameters
    ----------
    header : Header
    arrays : sequence of arrays, shape (row, column, component)
        The points, then each attribute.
    closed : (bool, bool)
    mask : bool, shape (row, column), or None
        True where a point is valid.
    names : sequence of str, optional
        Attributes that are wanted; all if not given.
    finite : bool
        All values are known to be finite.

    Raises
    ------
    InputError
        If no point is valid.
    """
    points, *others = arrays
    points = points[..., 0] if header.flat else points
    attributes = {
        kind.name: array if kind.components else array[..., 0]
        for kind, array in zip(header.attributes, others, strict=True)
        if names is None or kind.name in names
    }
    if finite:
        return finite_block(points, closed, mask, attributes)
    return Block(points, closed, mask=mask, attributes=attributes)


def restore(
    header: Header,
    region: Region,
    blocks: Mapping[int, Values],
    chunks: Chunks,
    chosen: NDArray[np.bool_] | None = None,
) -> None:
    """Add what the residual has of a region of the finest level, in place.

    Parameters
    ----------
    header : Header
    region : Region
        All of some blocks, or a window made of whole chunks.
    blocks : mapping of int to Values
        Of the region, by block.
    chunks : callable (number) -> (bytes, offset) or None
    chosen : bool, shape (channel,), optional
        Channels that are restored; all if not given.

    Raises
    ------
    CorruptStreamError
        If a chunk does not fit.
    """
    first = first_chunks(header)
    for block, values in blocks.items():
        shape = header.blocks[block][0]
        spans = region.spans or ((0, shape[0]), (0, shape[1]))
        for number, place in chunks_within(header, block, first[block], spans):
            if (chosen is not None and not chosen[place.channel]) or (chunk := chunks(number)) is None:
                continue
            # Across a seam the first rows of the block stand behind the last ones.
            top, left = (
                begin if start >= begin else begin - length
                for (start, _), (begin, _), length in zip((place.rows, place.columns), spans, shape, strict=True)
            )
            window = values.window(place, top, left)
            mask = (header.kept_masks if place.kept else header.masks)[block]
            valid = slice(None) if mask is None else mask[slice(*place.rows), slice(*place.columns)]
            known, (data, offset) = window[valid], chunk
            window[valid] = chunk_coder.decode_chunk(known.ravel(), bytes(data), offset).reshape(known.shape)


def mark_holes(header: Header, region: Region, blocks: Mapping[int, Values], corrected: bool) -> None:
    """Give holes the value that says so, in place; ``corrected``: but for those that keep a value of their own."""
    finest = region.level == header.levels
    masks = level_masks(header.patches, header.layout, region.level, header.masks)
    for block, values in blocks.items():
        mask = masks[block]
        if mask is None or not (finest or mask.any()):
            continue  # no node of so coarse a level is valid: the values under the holes are shown
        if corrected and finest and (kept := header.kept_masks[block]) is not None:
            mask = mask | kept
        if region.spans is not None:
            mask = taken(mask, region.spans, header.layout.shape(0, region.level))
        values.clear(~mask, header.hole)
