"""The coding passes of each tile that have been announced, and the state that follows from them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..container.model import Header, Index, Segment
from ..container.sections import Entry
from ..entropy.bitplanes import pass_count
from ..entropy.dequantize import UNANNOUNCED
from ..entropy.tiles import TileTable
from ..errors import CorruptStreamError
from ..grid.layout import Layout
from ..transform.predictors import COEFFICIENT_BITS
from .batches import Coded

__all__ = ["Progress", "initial_state", "known_levels", "state_after"]

#: Bytes of a segment from which on a window of those that arrived takes less memory than a copy.
_WINDOW = 256


class Progress:
    """Which passes of each tile have been announced so far, and whether a segment continues them."""

    def __init__(self, header: Header) -> None:
        shape = len(header.layout.tiles), header.channels
        self._state = initial_state(header)
        #: The same arrays, whose numbers are read and written more quickly so.
        self.top, self.state = np.zeros(shape, np.int8).data, self._state.data

    def advance(self, tile: int, channel: int, top: int, passes: int, offset: int) -> int:
        """Record a segment, and return the first of its passes.

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

    def follow(self, segment: Segment) -> int:
        """Record a segment as an index tells it, with the planes of its tile each time; see `advance`."""
        known = self.top[segment.tile, segment.channel]
        top = 0 if known else segment.top
        return self.advance(segment.tile, segment.channel, top, segment.passes, segment.range.offset)

    def advance_all(self, entries: Sequence[Entry], payload: memoryview, start: int, offset: int) -> list[Coded]:
        """Record the segments of a layer, whose bytes stand in its payload one after another from ``start`` on.

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
        """Return the present state, int8, shape (tile, channel).

        Once ``whole``, a tile that no layer has announced is known to have nothing but zeros.
        """
        return np.where(self._state == UNANNOUNCED, np.int8(0), self._state) if whole else self._state.copy()


def state_after(index: Index, layers: int) -> NDArray[np.int8]:
    """Return the state after the first ``layers`` layers of a container, int8, shape (tile, channel).

    Raises
    ------
    CorruptStreamError
        If the index names a tile whose level has zeros only, or more passes than a tile has.
    """
    progress = Progress(index.header)
    for segment in index.segments:
        if segment.layer < layers:
            progress.follow(segment)
    return progress.snapshot(layers == index.header.layer_count)


def initial_state(header: Header) -> NDArray[np.int8]:
    """Return the state before the first layer, int8, shape (tile, channel).

    Tiles without coefficients, and tiles of a level whose coefficients are all 0, are known.
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


def known_levels(layout: Layout, state: NDArray[np.int8], level: int) -> tuple[int, list[int]]:
    """Return the finest level whose details are known to the end, and the levels without details, up to ``level``.

    ``state`` is int8, shape (tile,). No level is without details where sides come from interfaces, which tell those
    along them.
    """
    starts = layout.starts[: level + 1]
    level_state = state[: layout.tiles_of(level).stop]
    if not level_state.any():
        return level, []
    unknown = np.flatnonzero(np.maximum.reduceat(level_state, starts)[1:])
    whole = int(unknown[0]) if unknown.size else level
    if layout.shared:
        return whole, []
    nothing = np.minimum.reduceat(level_state, starts)[1:] >= UNANNOUNCED
    bare: list[int] = (np.flatnonzero(nothing) + 1).tolist()
    return whole, bare
