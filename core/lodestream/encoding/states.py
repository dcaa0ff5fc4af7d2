"""States reconstructed one after another, each from the finest coarse level that it shares with the one before."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..container.model import Header
from ..decoding.progress import known_levels
from ..entropy.tiles import Tiles
from ..grid.layout import Layout
from ..transform.lifting import FRACTION_BITS
from ..transform.pyramid import PADDING, grids, inverse

__all__ = ["Canvases", "StateReconstructor"]

#: Levels of at most this share of the points are kept, which all together take a twelfth of a canvas.
_KEPT = 16
#: Levels of fewer points are made again: that takes less than the calls to keep each by itself.
_WORTH = 1 << 12

#: Room for reconstructions: int32, shape (coordinate, row, column and `PADDING` more), of each grid.
Canvases = list[NDArray[np.int32]]


@dataclass
class _Kept:
    """Coarse levels of one channel in the state that was reconstructed last.

    Attributes
    ----------
    state : int8, shape (tile,)
    grids : list of lists of int32 arrays, shape (row, column)
        Copies of the grids of the coarsest levels that are kept.
    """

    state: NDArray[np.int8]
    grids: list[list[NDArray[np.int32]]] = field(default_factory=list)


class StateReconstructor:
    """Reconstructs coordinates and other channels in any states; each thread has its own.

    Most layers change tiles of fine levels alone: what is coarser than these is taken from the state before.

    Parameters
    ----------
    header : Header
    tiles : sequence of Tiles, one for each channel
        All that a reader knows in the end.
    patches : sequence of int, optional
        Of these patches alone, by their numbers, and of the interfaces that they need: ``tiles`` have their tiles.

    Attributes
    ----------
    canvases : Canvases
        What was reconstructed last, of each grid: of chosen patches interfaces first.
    """

    def __init__(self, header: Header, tiles: Sequence[Tiles], patches: Sequence[int] | None = None) -> None:
        layout = header.layout
        self._places: Sequence[int] = range(len(layout.grids))
        if patches is not None:
            first = len(layout.grids) - len(header.patches)
            layout, self._places = layout.part([first + patch for patch in patches])
        shapes = [grid.shape for grid in layout.grids]
        self.canvases: Canvases = [
            np.empty((header.geometric, rows, columns + PADDING), np.int32) for rows, columns in shapes
        ]
        #: Where several grids are made: in one piece of memory, so that one call makes all levels of all of them.
        self._together = grids(layout, layout.levels) if len(shapes) > 1 else None
        self._header, self._tiles, self._layout = header, tiles, layout
        most = layout.points(layout.levels) // _KEPT
        self._levels = [level for level in range(layout.levels) if _WORTH <= layout.points(level) <= most]
        self._kept: dict[int, _Kept] = {}

    def reconstruct(self, place: int, channel: int, state: NDArray[np.int8]) -> int:
        """Reconstruct a channel into the canvases of a coordinate; it stands over two to the power returned.

        Parameters
        ----------
        place : int
            The coordinate.
        channel : int
        state : int8, shape (tile,)
            Passes that remain of each tile of the surface.
        """
        header, layout, tiles = self._header, self._layout, self._tiles[channel]
        shown = [canvas[place, :, :-PADDING] for canvas in self.canvases]
        arrays = self._together or shown
        whole, bare = known_levels(header.layout, state, layout.levels)
        kept = self._kept.get(channel)
        shared = 0
        if kept is not None:
            changed = _first_changed(header.layout, kept.state, state)
            shared = min(bisect_left(self._levels, changed), len(kept.grids))
        self._kept[channel] = kept = _Kept(state.copy(), [] if kept is None else kept.grids[:shared])
        start = self._levels[shared - 1] if shared else None
        if start is not None:
            for array, grid in zip(arrays, kept.grids[-1], strict=True):
                array[: grid.shape[0], : grid.shape[1]] = grid
        every: list[NDArray[np.int32] | None] = [None] * len(header.layout.grids)
        for number, array in zip(self._places, arrays, strict=True):
            every[number] = array
        own = state if layout is header.layout else state[np.asarray(tiles.table.members)]
        tiles.spread_levels(layout.levels, own, every, whole, start, bare)
        rules, coordinate = header.predictors[channel], channel < header.geometric
        for level in self._levels[shared:]:
            inverse(arrays, layout, rules, level, whole, coordinate, start, bare)
            start = level
            corners = zip(arrays, (layout.shape(k, level) for k in range(len(arrays))), strict=True)
            kept.grids.append([array[:rows, :columns].copy() for array, (rows, columns) in corners])
        inverse(arrays, layout, rules, layout.levels, whole, coordinate, start, bare)
        if self._together is not None:
            for canvas, array in zip(shown, arrays, strict=True):
                canvas[...] = array
        return FRACTION_BITS if whole < layout.levels else 0


def _first_changed(layout: Layout, before: NDArray[np.int8], after: NDArray[np.int8]) -> int:
    """The coarsest level of which anything else is known; one more than there are where nothing is.

    Levels below it stand over the same power of two in both states: the coarsest level that is not known whole is this
    one, or the same as before.
    """
    changed = np.flatnonzero(before != after)
    return layout.level_of(changed[0]) if changed.size else layout.levels + 1
