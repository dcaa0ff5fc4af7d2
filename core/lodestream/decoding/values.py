"""The values of a region: channels as values, corrected by the residual, with holes marked."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from threading import local
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.chunks import ChunkPlace, chunks_within, first_chunks
from ..container.model import Header
from ..entropy.tiles import Tiles
from ..grid.patches import assemble, level_masks
from ..parallel import spread, threads
from ..quantization.distortion import store_values
from ..residual import chunk_coder
from ..surface import Block, Closed, finite_block
from .pieces import Band, bands_of
from .reconstructor import Grid, KnownState, Reconstructor, known_state
from .region import Region, Span

__all__ = ["Chunks", "Values", "block_of", "chunks_of_region", "mark_holes", "restore", "values_of"]

#: Gives a chunk of the residual by its number: its bytes and where they stand; None if it is empty or not there.
Chunks = Callable[[int], tuple[bytes | memoryview, int] | None]

#: Numbers that a thread keeps room for: a new array costs more than what a band does in it.
_KEPT_NUMBERS = 3 << 19
#: Chunks that a thread corrects one after another: some milliseconds.
_CHUNKS_AT_ONCE = 8

_kept = local()


@dataclass
class Values:
    """A block's points, shape (row, column, channel), and those of its attributes; or those of a window of it.

    Attributes
    ----------
    arrays : list of arrays
    first : (int, int)
        The row and the column of the block with which the arrays begin.
    shape : (int, int)
        Rows and columns of the block: a window across its seam goes on with the first ones.
    """

    arrays: list[NDArray[Any]]
    first: tuple[int, int] = (0, 0)
    shape: tuple[int, int] = (0, 0)

    def channel(self, number: int) -> NDArray[Any]:
        """Return one channel, shape (row, column), a view."""
        for array in self.arrays:
            if number < array.shape[2]:
                return array[..., number]
            number -= array.shape[2]
        raise IndexError(number)

    def window(self, place: ChunkPlace) -> NDArray[Any]:
        """Return one channel at the place of a chunk, shape (row, column), a view."""
        rows, columns = map(_slice_from, self.first, (place.rows, place.columns), self.shape)
        return self.channel(place.channel)[rows, columns]

    def clear(self, holes: NDArray[np.bool_], hole: int) -> None:
        """Write the hole value into holes (bool, shape (row, column)).

        NaN in floats, ``hole`` in integer points, 0 in integer attributes.
        """
        for number, array in enumerate(self.arrays):
            array[holes] = np.nan if array.dtype.kind == "f" else 0 if number else array.dtype.type(hole)


def _slice_from(first: int, span: Span, length: int) -> slice:
    """Return the slice of samples of an axis of this length in an array that begins with sample ``first``."""
    turn = length if span[0] < first else 0  # across the seam the first samples stand behind the last ones
    return slice(span[0] + turn - first, span[1] + turn - first)


def values_of(
    header: Header,
    region: Region,
    channels: Sequence[Tiles],
    state: NDArray[np.int8],
    chosen: NDArray[np.bool_] | None = None,
) -> dict[int, Values]:
    """Return the values of a region by block from the segments alone; `restore` and `mark_holes` come after.

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
    patches, shapes = region.patches, region.patch_shapes
    counts = header.point_channels, *(kind.channels for kind in header.attributes)
    wanted = [channel for channel in range(header.channels) if chosen is None or chosen[channel]]
    new = np.empty if len(wanted) == header.channels else np.zeros
    #: Of points and of each attribute, of each patch.
    arrays = [
        [new((*shape, count), header.dtypes[first]) for shape in shapes]
        for count, first in zip(counts, accumulate(counts, initial=0), strict=False)
    ]
    places = [(grids, component) for grids, count in zip(arrays, counts, strict=True) for component in range(count)]

    bands = bands_of(region, threads())

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
            store_values(header.lattices[work.channel], (grid, fraction), array[work.rows], component)

    def work_of(channel: int) -> list[_Work]:
        known = known_state(channels[channel].table, state[:, channel], region.level)
        below = None
        if len(bands) > 1:
            below = _level_below(header.predictors[channel], channels[channel], state[:, channel], region)
        return [_Work(channel, band.region, band.rows, known, below) for band in bands]

    spread(store, [work for of in spread(work_of, wanted) for work in of])
    if region.spans is not None:
        (top, _), (left, _) = region.spans
        return {0: Values([array for (array,) in arrays], (top, left), region.layout.shape(0, region.level))}
    blocks = sorted({header.patches[patch].block for patch in patches})
    return {block: Values(_assembled(header, region.level, block, patches, arrays)) for block in blocks}


def _assembled(
    header: Header, level: int, block: int, patches: Sequence[int], arrays: Sequence[Sequence[NDArray[Any]]]
) -> list[NDArray[Any]]:
    """Return the arrays of a block, assembled from those of its patches, ordered by array and patch."""
    shape, assembled = header.blocks[block][0], []
    for grids in arrays:
        of_patch: list[NDArray[Any]] = [grids[0]] * len(header.patches)
        for patch, grid in zip(patches, grids, strict=True):
            of_patch[patch] = grid
        whole = assemble(header.block_patches[block], header.layout, level, shape, of_patch)
        assembled.append(np.ascontiguousarray(whole))
    return assembled


@dataclass(frozen=True)
class _Work:
    """A channel of a region, or of a band of its rows above a level that is made already."""

    channel: int
    region: Region
    rows: slice
    known: KnownState
    below: tuple[Grid, int] | None


def _level_below(
    predictors: NDArray[np.int8], tiles: Tiles, state: NDArray[np.int8], region: Region
) -> tuple[Grid, int]:
    """Return the only grid one level below a region, and its number of fractional bits; threads share it by bands."""
    whole = Region.whole(region.layout, region.level - 1)
    known = known_state(tiles.table, state, whole.level)
    bands = bands_of(whole, threads())
    if threads() == 1 or len(bands) == 1:
        (grid,), fraction = Reconstructor(whole, predictors, tiles).reconstruct(known)
        return grid, fraction
    below = _level_below(predictors, tiles, state, whole)
    array = np.empty(whole.shapes[0], np.int32)

    def put(band: Band) -> int:
        reconstructor = Reconstructor(band.region, predictors, tiles, True, _room(band.region.size_above), below)
        (grid,), fraction = reconstructor.reconstruct(known)
        array[band.rows] = grid
        return fraction

    return array, spread(put, bands)[0]


def _room(size: int) -> NDArray[np.int32]:
    """Return an uninitialised buffer of this thread, int32, shape (size,); the next call returns it again."""
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
    """Make a block from its arrays.

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


def chunks_of_region(header: Header, region: Region, blocks: Iterable[int]) -> Iterator[tuple[int, ChunkPlace]]:
    """Yield the chunks of some blocks in a region of the finest level, in the order of the file, with their numbers."""
    first = first_chunks(header)
    for block in blocks:
        yield from chunks_within(header, block, first[block], region.spans_in(header.blocks[block][0]))


def restore(
    header: Header,
    region: Region,
    blocks: Mapping[int, Values],
    chunks: Chunks,
    chosen: NDArray[np.bool_] | None = None,
) -> None:
    """Add the residual of a region of the finest level, in place.

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

    def correct(run: Sequence[tuple[int, ChunkPlace]]) -> None:
        for number, place in run:
            if (chunk := chunks(number)) is None:
                continue
            window = blocks[place.block].window(place)
            mask = (header.kept_masks if place.kept else header.masks)[place.block]
            valid = slice(None) if mask is None else mask[slice(*place.rows), slice(*place.columns)]
            known, (data, offset) = window[valid], chunk
            window[valid] = chunk_coder.decode_chunk(known.ravel(), bytes(data), offset).reshape(known.shape)

    places = chunks_of_region(header, region, blocks)
    wanted = [item for item in places if chosen is None or chosen[item[1].channel]]
    # No two chunks change the same value, so threads write side by side.
    spread(correct, [wanted[start : start + _CHUNKS_AT_ONCE] for start in range(0, len(wanted), _CHUNKS_AT_ONCE)])


def mark_holes(header: Header, region: Region, blocks: Mapping[int, Values], corrected: bool) -> None:
    """Write the hole value into holes, in place; ``corrected``: except where a hole keeps its own value."""
    finest = region.level == header.levels
    masks = level_masks(header.patches, header.layout, region.level, header.masks)
    for block, values in blocks.items():
        mask = masks[block]
        if mask is None or not (finest or mask.any()):
            continue  # no node of so coarse a level is valid: the values under the holes are shown
        if corrected and finest and (kept := header.kept_masks[block]) is not None:
            mask = mask | kept
        values.clear(~region.of_block(mask), header.hole)
