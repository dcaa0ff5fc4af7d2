"""Segments into points: the state of a surface that is being refined, and values of any state that it passed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.chunks import ChunkPlace, chunk_places
from ..container.model import Header
from ..container.sections import Entry
from ..entropy.bitplanes import pass_count
from ..entropy.dequantize import UNANNOUNCED
from ..entropy.tiles import Reading, Tiles, TileTable
from ..errors import CorruptStreamError
from ..grid.patches import assemble, level_masks
from ..grid.window import hull, meets, taken
from ..parallel import spread
from ..planning.selection import restored
from ..quantization.distortion import store_values
from ..residual import chunk_coder
from ..target import Region
from ..transform.predictors import COEFFICIENT_BITS
from .batches import Coded, batch_length, rounds_of
from .channels import Coordinates, reconstruct_channel, values_of_grid
from .crop import reconstruct_window

__all__ = [
    "Coordinates",
    "Progress",
    "Reconstruction",
    "Values",
    "initial_state",
    "reconstruct_channel",
    "to_values",
]


#: Bytes of segments that are worth decoding before anybody asks for points.
_WORTH = 1 << 13
#: Bytes of a segment from which on a window of those that arrived takes less memory than a copy.
_WINDOW = 256


class Reconstruction:
    """Decodes segments when a reconstruction asks for them, in the order in which they were added.

    A *state* is the number of coding passes still to come of every tile and channel: int8, shape (tile, channel), and
    `UNANNOUNCED` where that is not known. States that lie behind what was decoded are reconstructions too: what later
    passes told is ignored.
    """

    def __init__(self, header: Header) -> None:
        self.header = header
        self._queue: dict[int, Coded] = {}  # what is not decoded yet, by number
        self._added = self._taken = self._forgotten = 0
        self._begun: tuple[int, list[list[Reading]]] = 0, []  # the batch on its way: what it ends before, its rounds
        self._lock = Lock()
        self._chunks: dict[int, tuple[bytes | memoryview, int]] = {}
        self._tiles: list[Tiles] = []
        #: Whether what was added is forgotten, see `drop`.
        self.dropped = False

    @property
    def length(self) -> int:
        """Segments added so far."""
        return self._added

    def add(self, segments: Sequence[Coded]) -> None:
        """Take segments; nothing is decoded yet."""
        self._queue.update(enumerate(segments, self._added))
        self._added += len(segments)

    def correct(self, number: int, data: bytes | memoryview, offset: int) -> None:
        """Take a chunk of the residual section, which stands at ``offset``."""
        if data:
            self._chunks[number] = data, offset

    def drop(self) -> None:
        """Forget all that was added and is not decoded: for whoever asks for no values."""
        self._queue.clear()
        self._chunks.clear()
        self.dropped = True

    def prepare(self, length: int) -> None:
        """Decode the first ``length`` segments, if those that wait are worth the calls that this takes."""
        with self._lock:
            waiting = 0
            for number in range(self._taken, length):
                waiting += len(self._queue[number].data)
                if waiting >= _WORTH:
                    self._decode(length)
                    return

    def blocks(
        self,
        length: int,
        state: NDArray[np.int8],
        level: int,
        corrected: bool = False,
        chosen: NDArray[np.bool_] | None = None,
    ) -> list[Values]:
        """The grids of ``level`` when the first ``length`` segments are known, one for each block.

        ``state`` is int8, shape (tile, channel), ``chosen`` bool, shape (channel,): channels that are not chosen mean
        nothing.

        Raises
        ------
        CorruptStreamError
            When ``corrected`` is asked for and a chunk of the residual section does not fit.
        """
        header = self.header
        blocks = self._whole(length, state, level, chosen)
        if corrected:
            self._correct(blocks, chosen)
        masks = level_masks(header.patches, header.layout, level, header.masks)
        every = header.kept_masks if corrected else [None] * len(blocks)  # which nothing else needs, nor is upset by
        for block, mask, kept in zip(blocks, masks, every, strict=True):
            if mask is not None and mask.any():  # else no node of so coarse a level is valid, see `View.surface`
                block.clear(~mask if kept is None else ~(mask | kept), header.hole)
        return blocks

    def _whole(
        self, length: int, state: NDArray[np.int8], level: int, chosen: NDArray[np.bool_] | None
    ) -> list[Values]:
        """The values of all blocks before residual and holes."""
        if len(self.header.layout.grids) > 1:
            return to_values(self.header, self.reconstructions(length, state, level, chosen), level)
        with self._lock:
            self._decode(length)
            arrays = values_of_grid(self.header, self._tiles, state, level, chosen)
        return [Values(_arranged(self.header, level, [[array] for array in arrays], 0))]

    def reconstructions(
        self, length: int, state: NDArray[np.int8], level: int, chosen: NDArray[np.bool_] | None = None
    ) -> list[Coordinates]:
        """The grids of ``level`` of each channel, in lattice coordinates: int32, shape (row, column); see `blocks`."""
        reconstructions: list[Coordinates] = []
        with self._lock:
            self._decode(length)
            for channel, tiles in enumerate(self._tiles):
                if chosen is None or chosen[channel]:
                    reconstructions.append(reconstruct_channel(self.header, channel, tiles, state[:, channel], level))
                else:
                    reconstructions.append(reconstructions[0])  # of the right shapes
        return reconstructions

    def reconstruction(self, length: int, state: NDArray[np.int8], level: int, channel: int) -> Coordinates:
        """One channel of the grids of ``level``: int32, shape (row, column) each; see `reconstructions`."""
        with self._lock:
            self._decode(length)
            return reconstruct_channel(self.header, channel, self._tiles[channel], state[:, channel], level)

    def window(
        self,
        length: int,
        state: NDArray[np.int8],
        region: Region,
        corrected: bool,
        chosen: NDArray[np.bool_],
    ) -> Values:
        """A window of the surface, of one grid, when the first ``length`` segments are known.

        Takes memory for what the window is made of, not for the surface; but an axis along which it crosses the seam is
        made whole. Its arrays have the shape (row, column, component) of the window. See `blocks`.
        """
        header, shape = self.header, self.header.shape
        around = restored(header, region)
        inside = hull(around, shape)
        values = self._window_values(length, state, inside, chosen)
        if corrected:
            self._correct([values], chosen, around, (inside[0][0], inside[1][0]))
        values = Values([taken(array, region, shape, (inside[0][0], inside[1][0])) for array in values.arrays])
        if (mask := header.masks[0]) is not None:
            if corrected and (kept := header.kept_masks[0]) is not None:
                mask = mask | kept
            values.clear(~taken(mask, region, shape), header.hole)
        return values

    def _window_values(self, length: int, state: NDArray[np.int8], region: Region, chosen: NDArray[np.bool_]) -> Values:
        """The values of a window before residual and holes."""
        header = self.header
        with self._lock:
            self._decode(length)
            reconstructions = [
                reconstruct_window(header, channel, tiles, state[:, channel], region) if chosen[channel] else None
                for channel, tiles in enumerate(self._tiles)
            ]
        shape = region[0][1] - region[0][0], region[1][1] - region[1][0]
        arrays, channel = [], 0
        for count in (header.point_channels, *(kind.channels for kind in header.attributes)):
            array = np.zeros((*shape, count), header.dtypes[channel])
            for component in range(count):
                if (reconstruction := reconstructions[channel]) is not None:
                    store_values(header.lattices[channel], reconstruction, array, component)
                channel += 1
            arrays.append(array)
        return Values(arrays)

    def _correct(
        self,
        blocks: list[Values],
        chosen: NDArray[np.bool_] | None,
        region: Region | None = None,
        first: tuple[int, int] = (0, 0),
    ) -> None:
        """Restore all windows of residual that there are, or of a region of the only block those inside.

        The arrays begin at row and column ``first`` of the block.
        """
        for number, window in enumerate(chunk_places(self.header)):
            inside = region is None or all(map(meets, region, (window.rows, window.columns), self.header.shape))
            if number in self._chunks and inside and (chosen is None or chosen[window.channel]):
                values = blocks[window.block].window(window, *first)
                masks = self.header.kept_masks if window.kept else self.header.masks
                mask, (data, offset) = masks[window.block], self._chunks[number]
                valid = None if mask is None else mask[slice(*window.rows), slice(*window.columns)]
                places = slice(None) if valid is None else valid
                known = values[places]
                values[places] = self._restored(known.ravel(), bytes(data), offset).reshape(known.shape)

    def _restored(self, known: NDArray[Any], chunk: bytes, offset: int) -> NDArray[Any]:
        """The values of a chunk of the residual section."""
        return chunk_coder.decode_chunk(known, chunk, offset)

    def _prepare(self) -> list[Tiles]:
        if not self._tiles:
            header = self.header
            table = TileTable.of(header.layout)
            other = TileTable.of(header.layout, False) if header.layout.shared else table
            self._tiles = [
                Tiles(table, header.quantiser, header.large)
                if channel < header.geometric
                else Tiles(other, None, header.large)
                for channel in range(header.channels)
            ]
        return self._tiles

    def _decode(self, length: int) -> None:
        """Decode the first ``length`` segments. After an interruption at any place the next call goes on from there."""
        every = self._prepare()
        while self._taken < length:
            if self._begun[0] <= self._taken:
                waiting = [self._queue[number] for number in range(self._taken, length)]
                batch = waiting[: batch_length(self.header.layout, waiting)]
                self._begun = self._taken + len(batch), rounds_of(every, batch)
            end, rounds = self._begun
            for readings in rounds:
                spread(Reading.run, readings)
            self._taken = end
            self._forget(end)

    def _forget(self, end: int) -> None:
        """Drop the segments before number ``end``, and any that an interruption has left."""
        while self._forgotten < end:
            self._queue.pop(self._forgotten, None)
            self._forgotten += 1


class Progress:
    """Which passes of each tile have been announced so far, and whether a segment continues them."""

    def __init__(self, header: Header) -> None:
        shape = len(header.layout.tiles), header.channels
        self._state = initial_state(header)
        #: The same arrays, whose numbers are read and written more quickly so.
        self.top, self.state = np.zeros(shape, np.int8).data, self._state.data

    def advance(self, tile: int, channel: int, top: int, passes: int, offset: int) -> int:
        """Note a segment; returns the first of its passes.

        Parameters
        ----------
        top : int
            Bit-planes of the tile, told with its first segment; 0 with the others.

        Raises
        ------
        CorruptStreamError
            When the tile was not announced, was announced already, or has not so many passes left.
        """
        known = self.top[tile, channel]
        if not known and self.state[tile, channel] == 0:
            raise CorruptStreamError(f"expected no segment of tile {tile}, whose level has zeros only", offset)
        if bool(top) == bool(known):
            problem = "told again" if known else "not told"
            raise CorruptStreamError(
                f"expected the planes of tile {tile} once, at its first segment: {problem}", offset
            )
        if top > COEFFICIENT_BITS:
            raise CorruptStreamError(
                f"expected at most {COEFFICIENT_BITS} bit-planes of tile {tile}, got {top}", offset
            )
        if top:
            self.top[tile, channel], self.state[tile, channel] = top, pass_count(top)
        below = self.state[tile, channel]
        if passes > below:
            raise CorruptStreamError(f"expected at most {below} more passes of tile {tile}, got {passes}", offset)
        self.state[tile, channel] = below - passes
        return below - 1

    def advance_all(self, entries: Sequence[Entry], payload: memoryview, start: int, offset: int) -> list[Coded]:
        """Note the segments of a layer, whose bytes stand in its payload one after another from ``start`` on.

        The payload, of bytes that never change, stands at ``offset``. See `advance`.
        """
        state, segments = self.state, []
        for tile, channel, top, passes, length in entries:
            below = state[tile, channel]
            if top or below == UNANNOUNCED or passes > below:
                first = self.advance(tile, channel, top, passes, offset + start)
            else:  # goes on with a tile that is known, which is all that `advance` looks at: there are many segments
                state[tile, channel] = below - passes
                first = below - 1
            end = start + length
            data = payload[start:end] if length >= _WINDOW else bytes(payload[start:end])
            segments.append(Coded(tile, channel, first, passes, data, offset + start))
            start = end
        return segments

    def snapshot(self, whole: bool) -> NDArray[np.int8]:
        """The present state, int8, shape (tile, channel).

        Once ``whole``, a tile that no layer has announced is known to have nothing but zeros.
        """
        return np.where(self._state == UNANNOUNCED, np.int8(0), self._state) if whole else self._state.copy()


def initial_state(header: Header) -> NDArray[np.int8]:
    """The state before the first layer, int8, shape (tile, channel).

    What has no coefficient, or none other than 0 in its whole level, is known.
    """
    layout = header.layout
    state = np.full((len(layout.tiles), header.channels), UNANNOUNCED, np.int8)
    for channel, bits in enumerate(header.empty):
        for level in range(bits.bit_length()):
            if bits >> level & 1:
                tiles = layout.tiles_of(level)
                state[tiles.start : tiles.stop, channel] = 0
    for coordinate, channels in ((True, slice(header.geometric)), (False, slice(header.geometric, None))):
        if (without := TileTable.of(layout, coordinate).without_bands).size:
            state[without, channels] = 0
    return state


@dataclass
class Values:
    """A block's points, shape (row, column, channel), and those of its attributes."""

    arrays: list[NDArray[Any]]

    def window(self, window: ChunkPlace, top: int = 0, left: int = 0) -> NDArray[Any]:
        """One channel at the place of a chunk, shape (row, column), a view.

        The arrays begin at row ``top`` and column ``left`` of the block.
        """
        channel = window.channel
        rows, columns = (
            slice(start - first, stop - first)
            for (start, stop), first in zip((window.rows, window.columns), (top, left), strict=True)
        )
        for array in self.arrays:
            if channel < array.shape[2]:
                return array[rows, columns, channel]
            channel -= array.shape[2]
        raise IndexError(window.channel)

    def clear(self, holes: NDArray[np.bool_], hole: int) -> None:
        """Give holes (bool, shape (row, column)) the value that says so.

        NaN in floats, ``hole`` in integer points, 0 in integer attributes.
        """
        for number, array in enumerate(self.arrays):
            array[holes] = np.nan if array.dtype.kind == "f" else 0 if number else array.dtype.type(hole)


def to_values(header: Header, reconstructions: Sequence[Coordinates], level: int) -> list[Values]:
    """Values of each channel's reconstruction, block by block, shape (row, column, component) each."""
    layout, patches = header.layout, header.patches
    interfaces = len(layout.grids) - len(patches)
    components = [header.point_channels, *(kind.channels for kind in header.attributes)]
    grids: list[list[NDArray[Any]]] = []  # of each array, of each patch
    channel = 0
    for count in components:
        arrays = [
            np.empty((*layout.shape(interfaces + k, level), count), header.dtypes[channel]) for k in range(len(patches))
        ]
        for component in range(count):
            coordinates, fraction = reconstructions[channel]
            for k, array in enumerate(arrays):
                store_values(header.lattices[channel], (coordinates[interfaces + k], fraction), array, component)
            channel += 1
        grids.append(arrays)
    return [Values(_arranged(header, level, grids, block)) for block in range(len(header.blocks))]


def _arranged(header: Header, level: int, grids: list[list[NDArray[Any]]], block: int) -> list[NDArray[Any]]:
    """The arrays of a block from those of patches, which stand by array and patch."""
    own, shape = header.block_patches[block], header.blocks[block][0]
    return [np.ascontiguousarray(assemble(own, header.layout, level, shape, arrays)) for arrays in grids]
