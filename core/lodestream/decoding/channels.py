"""The channels of a state: their lattice coordinates, or their values by bands of rows.

Where there is one grid, the finest level is made by bands, each from coefficients to values before the next one. What a
band takes stays in the cache, no array holds all coefficients of the level, and bands have nothing to do with each
other, so several threads make them. A band inverts some more rows than it shows: `crop_axis` tells which.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise
from threading import local
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.model import Header
from ..entropy.band_fields import ROWS
from ..entropy.dequantize import UNANNOUNCED
from ..entropy.tiles import Tiles
from ..parallel import spread, threads
from ..quantization.distortion import store_values
from ..transform.lifting import FRACTION_BITS, inverse_step
from ..transform.predictors import predictor
from ..transform.pyramid import PADDING, grids, inverse, refine
from .crop import AxisCrop, crop_axis
from .levels import known_levels

__all__ = ["Coordinates", "has_bands", "reconstruct_channel", "reconstruct_patches", "values_of_grid"]

#: Lattice coordinates of each grid, over two to the power of the second.
Coordinates = tuple[list[NDArray[np.int32]], int]
#: First and past-the-last row of a band.
Band = tuple[int, int]

#: Most rows of a band; of wide ones the fewest, and values where it has more rows than these.
_ROWS, _FEW_ROWS, _VALUES = 512, 128, 1 << 20
#: Values of a level that one thread makes as a whole: bands would only be more calls.
_SMALL = 1 << 20
#: Least values of a level that threads share.
_SHARED = 1 << 17
#: Values that a thread keeps room for.
_KEPT = 3 << 19

_kept = local()


def reconstruct_channel(
    header: Header,
    channel: int,
    tiles: Tiles,
    state: NDArray[np.int8],
    level: int,
    coefficients: list[NDArray[np.int32]] | None = None,
) -> Coordinates:
    """One channel of the grids of ``level`` in a state.

    ``coefficients`` are where it is made, whatever they hold: int32 arrays as of `grids`, new ones if not given.

    Returns
    -------
    (list of int32 arrays, shape (row, column), int)
        Lattice coordinates of each grid, interfaces first, over two to the power of the second.
    """
    layout = header.layout
    whole, bare = known_levels(layout, state, level)
    coefficients = grids(layout, level) if coefficients is None else coefficients
    tiles.spread_levels(level, state, coefficients, whole, bare=bare)
    coordinate = channel < header.geometric
    inverse(coefficients, layout, header.predictors[channel], level, whole, coordinate, bare=bare)
    return coefficients, FRACTION_BITS if whole < level else 0


def reconstruct_patches(
    header: Header, channel: int, tiles: Tiles, patches: Sequence[int], level: int
) -> list[NDArray[np.int32]]:
    """One channel of some patches when all segments are known, at a level: int32, shape (row, column) each.

    Parameters
    ----------
    header : Header
        Of a surface of several grids.
    channel : int
    tiles : Tiles
        Of the tiles that these patches have up to the level, and all interfaces.
    patches : sequence of int
        By their numbers.
    level : int
    """
    interfaces = len(header.layout.grids) - len(header.patches)
    layout, places = header.layout.part([interfaces + patch for patch in patches])
    arrays = grids(layout, level)
    every: list[NDArray[np.int32] | None] = [None] * len(header.layout.grids)
    for place, array in zip(places, arrays, strict=True):
        every[place] = array
    tiles.spread_levels(level, np.zeros(len(tiles.table.members), np.int8), every, level)
    inverse(arrays, layout, header.predictors[channel], level, level, channel < header.geometric)
    return arrays[-len(patches) :]


def has_bands(header: Header, level: int) -> bool:
    """Whether a level is made by bands: a large one of one grid whose rows, if they change in its step, do not wrap."""
    layout = header.layout
    if len(layout.grids) > 1 or level == 0 or layout.steps(0, level)[0].wraps:
        return False
    points, least = layout.points(level), min(_SMALL, _SHARED)
    return points > least and points > (_SMALL if threads() == 1 else least)


def values_of_grid(
    header: Header, tiles: Sequence[Tiles], state: NDArray[np.int8], level: int, chosen: NDArray[np.bool_] | None = None
) -> list[NDArray[Any]]:
    """Values of a level of the only grid: of the points and of each attribute, shape (row, column, component).

    ``tiles`` are of each channel, ``state`` is int8, shape (tile, channel), ``chosen`` bool, shape (channel,): channels
    that are not chosen are 0.
    """
    counts = header.point_channels, *(kind.channels for kind in header.attributes)
    places = [(number, component) for number, count in enumerate(counts) for component in range(count)]
    wanted = [channel for channel in range(len(places)) if chosen is None or chosen[channel]]
    made = np.empty if len(wanted) == len(places) else np.zeros
    shape = header.layout.shape(0, level)
    arrays = [
        made((*shape, count), header.dtypes[channel])
        for count, channel in zip(counts, accumulate(counts, initial=0), strict=False)
    ]

    def show_whole(channel: int) -> None:
        number, component = places[channel]
        own = tiles[channel], state[:, channel]
        (made,), fraction = reconstruct_channel(header, channel, *own, level, [_room(*shape)])
        store_values(header.lattices[channel], (made, fraction), arrays[number], component)

    if not has_bands(header, level):
        spread(show_whole, wanted)
        return arrays

    def level_of(channel: int) -> _Level:
        own = tiles[channel], state[:, channel]
        return _Level(header, channel, *own, level, _coordinates(header, channel, *own, level - 1))

    def show(work: tuple[int, _Level, Band]) -> None:
        channel, own, band = work
        number, component = places[channel]
        store_values(header.lattices[channel], own.coordinates(band), arrays[number][slice(*band)], component)

    own = zip(wanted, spread(level_of, wanted), strict=True)
    spread(show, [(channel, made, band) for channel, made in own for band in made.bands()])
    return arrays


def _coordinates(
    header: Header, channel: int, tiles: Tiles, state: NDArray[np.int8], level: int
) -> tuple[NDArray[np.int32], int]:
    """As `reconstruct_channel`, of one grid; by bands where several threads can take part."""
    rows, columns = header.layout.shape(0, level)
    if threads() == 1 or rows * columns < _SHARED or not has_bands(header, level):
        (whole,), fraction = reconstruct_channel(header, channel, tiles, state, level)
        return whole, fraction
    own = _Level(header, channel, tiles, state, level, _coordinates(header, channel, tiles, state, level - 1))
    whole = np.empty((rows, columns), np.int32)

    def put(band: Band) -> None:
        whole[slice(*band)] = own.coordinates(band)[0]

    spread(put, own.bands())
    return whole, own.fraction


class _Level:
    """A level of one channel in a state, by bands.

    Parameters
    ----------
    tiles : Tiles
        Of this channel.
    state : int8, shape (tile,)
        Passes that remain of each tile.
    nodes : int32, shape (row, column), and int
        The level below: lattice coordinates over two to the power of the second.
    """

    def __init__(
        self,
        header: Header,
        channel: int,
        tiles: Tiles,
        state: NDArray[np.int8],
        level: int,
        nodes: tuple[NDArray[np.int32], int],
    ) -> None:
        layout, table = header.layout, tiles.table
        self._tiles, self._state = tiles, state
        self._nodes, self._nodes_fraction = nodes
        self._shape, self._steps = layout.shape(0, level), layout.steps(0, level)
        self._rules = [
            predictor(header.predictors[channel], layout.grids[0], step, level, axis)
            for axis, step in enumerate(self._steps)
        ]
        span = layout.tiles_of(level)
        own = state[span.start : span.stop]
        self.fraction = FRACTION_BITS if self._nodes_fraction or own.any() else 0
        self._announced = bool((own < UNANNOUNCED).any())
        self._numbers = np.arange(table.first[span.start], table.first[span.stop])
        self._first = table.origins[self._numbers, 1]
        self._last = self._first + table.bands[self._numbers, ROWS]

    def bands(self) -> list[Band]:
        """All of them, for every thread as many."""
        rows, columns = self._shape
        count = -(-rows // min(_ROWS, max(_FEW_ROWS, _VALUES // columns)))
        if rows * columns >= _SHARED:
            workers = threads()
            count = -(-count // workers) * workers
        bounds = [rows * number // count for number in range(count + 1)]
        return [(start, stop) for start, stop in pairwise(bounds) if stop > start]

    def coordinates(self, band: Band) -> tuple[NDArray[np.int32], int]:
        """Lattice coordinates of a band, int32, shape (row, column), over two to the power of the second.

        The array is this thread's, and its own until it asks for the next band.
        """
        crop = crop_axis(self._steps[0], *band)
        canvas = _room(crop.step.length, self._shape[1])
        corner = canvas[: crop.step.coarse, : self._steps[1].coarse]
        corner[...] = self._nodes[crop.first : crop.first + crop.step.coarse]
        if self.fraction != self._nodes_fraction:
            refine(corner)
        if self._announced:
            self._put_details(canvas, crop)
        known = canvas if self._announced else canvas[: crop.step.coarse]
        for axis, step, part in ((1, self._steps[1], known), (0, crop.step, canvas)):
            if step.midpoints:
                inverse_step(part, axis, step, self._rules[axis], not self._announced)
        return canvas[crop.start : crop.start + band[1] - band[0]], self.fraction

    def _put_details(self, canvas: NDArray[np.int32], crop: AxisCrop) -> None:
        nodes = crop.step.coarse
        for part, first in ((canvas[:nodes], crop.first), (canvas[nodes:], self._steps[0].coarse + crop.first)):
            if len(part):
                numbers = self._numbers[(self._first < first + len(part)) & (self._last > first)]
                self._tiles.spread_part(numbers, self._state, part, (first, 0), bool(self.fraction))


def _room(rows: int, columns: int) -> NDArray[np.int32]:
    """An array from `allocate`, whatever it holds: this thread's, if that is large enough.

    A new one costs more than what a band does in it, since the machine has to find its memory page by page.
    """
    width = columns + PADDING
    kept: NDArray[np.int32] | None = getattr(_kept, "room", None)
    if kept is None or kept.size < rows * width:
        kept = np.empty(rows * width, np.int32)
        if kept.size <= _KEPT:
            _kept.room = kept
    return kept[: rows * width].reshape(rows, width)[:, :columns]
