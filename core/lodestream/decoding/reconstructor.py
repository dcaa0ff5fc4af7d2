"""Reconstruct the lattice coordinates of a region of one channel, in one state after another.

Whole grids are made up to the core in one call of a kernel, each finer level of a window in another one. What a state
shares with the one before it is not made again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import accumulate, pairwise, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..entropy.band_fields import COLUMNS, ROWS
from ..entropy.stacks import Stacks
from ..entropy.tiles import Tiles, TileTable
from ..transform.all_levels import LevelInverse
from ..transform.lifting import FRACTION_BITS
from ..transform.predictors import predictor
from ..transform.pyramid import PADDING, inverse
from .progress import known_levels
from .region import LevelPart, Region, Span, span_pieces

__all__ = ["KnownState", "Reconstructor", "known_state"]

Grid = NDArray[np.int32]


class KnownState(NamedTuple):
    """A state as far as some of the tiles are concerned.

    Attributes
    ----------
    passes : int8, shape (tile,)
        Passes that remain of each tile of a table.
    whole, bare : int, list of int
        See `known_levels`: of the whole surface, up to the level that is made.
    """

    passes: NDArray[np.int8]
    whole: int
    bare: list[int]


def known_state(table: TileTable, state: NDArray[np.int8], level: int) -> KnownState:
    """Return the part of a state, int8, shape (tile,), that a table needs for all levels up to ``level``."""
    passes = state if table.chosen is None else state[table.chosen]
    return KnownState(np.ascontiguousarray(passes), *known_levels(table.layout, state, level))


class _Quarter(NamedTuple):
    """Coefficients of a level that stand side by side: their bands, and where they go.

    ``numbers`` are those of the bands in the table, int64, shape (band,); ``place`` is a view of the level's array,
    shape (row, column), ``origin`` its first row and column among all coefficients.
    """

    numbers: NDArray[np.int64]
    place: Grid
    origin: tuple[int, int]


class Reconstructor:
    """Makes a region of one channel, in one state after another.

    Parameters
    ----------
    region : Region
    predictors : int8, shape (level, axis, 2)
        Of the channel.
    tiles : Tiles
        Of all tiles of the surface, or of the region's: `Region.tile_runs`, and any others.
    coordinate : bool
        Whether sides come from interfaces.
    memory : int32, shape (number,), optional
        Room of `Region.size` numbers to work in, or of `Region.size_above` with ``below``, whatever it holds.
    below : int32, shape (row, column), and int, optional
        The core's only grid if it is made already, and the power of two that it stands over.
    """

    def __init__(
        self,
        region: Region,
        predictors: NDArray[np.int8],
        tiles: Tiles,
        coordinate: bool = True,
        memory: NDArray[np.int32] | None = None,
        below: tuple[Grid, int] | None = None,
    ) -> None:
        self._region, self._predictors, self._tiles, self._coordinate = region, predictors, tiles, coordinate
        self._below_fraction = None if below is None else below[1]
        shapes = [region.part.shape(number, region.core) for number in range(len(region.grids))]
        arrays = _arrays([*(shapes if below is None else ()), *(step.shape for step in region.steps)], memory)
        self._core, arrays = ([below[0]], arrays) if below else (arrays[: len(shapes)], arrays[len(shapes) :])
        #: Of each grid of the surface its array at the core; None if it is not made.
        places: list[Grid | None] = [None] * len(region.layout.grids)
        for number, array in zip(region.grids, self._core, strict=True):
            places[number] = array
        self._stacks = tiles.stacks(places) if below is None else None
        self._levels, self._shown = [], self._core
        if region.core_spans is not None:
            wanted = [span_pieces(*of) for of in zip(region.core_spans, shapes[0], strict=True)]
            nodes = self._core[0]
            for step, array in zip(region.steps, arrays, strict=True):
                copies = _copies(step, array, nodes, wanted)
                self._levels.append(_Level(step, array, copies, predictors, tiles.table))
                nodes, wanted = array, [list(step.rows.crop.wanted), list(step.columns.crop.wanted)]
            self._shown = [nodes[slice(*rows), slice(*columns)] for rows, columns in product(*wanted)]
        self._columns = len(wanted[1]) if region.core_spans is not None else 1
        #: Of the core and of each level above it: the tiles that count, by their numbers in the table.
        self._used = [np.arange(tiles.table.tiles_from(region.core + 1)), *(level.tiles for level in self._levels)]
        self._before: KnownState | None = None

    def reconstruct(self, state: KnownState) -> tuple[list[Grid], int]:
        """Reconstruct the region in a state.

        Parameters
        ----------
        state : KnownState
            Of the tiles' table.

        Returns
        -------
        list of int32 arrays, shape (row, column), and int
            Lattice coordinates of each of the region's grids, over two to the power of the second. The arrays are this
            object's: the next call changes them.
        """
        shared = self._shared_with(state)
        self._before = state
        if not shared and self._stacks is not None:
            self._make_core(state, self._stacks)
        for level in self._levels[max(shared - 1, 0) :]:
            level.make(self._tiles, state)
        fraction = FRACTION_BITS if state.whole < self._region.level else 0
        if self._region.spans is None or len(self._shown) == 1:
            return self._shown, fraction
        cells = [self._shown[k : k + self._columns] for k in range(0, len(self._shown), self._columns)]
        return [np.block(cells)], fraction

    @cached_property
    def frames(self) -> list[Grid]:
        """The grids of the last call in one piece; further columns, whose values mean nothing, follow.

        int32, shape (row, column and `PADDING` or more); of a window only where it crosses no seam.
        """
        if len(self._shown) > 1 and self._region.spans is not None:
            raise ValueError("expected a window that crosses no seam")
        return [
            np.lib.stride_tricks.as_strided(array, (len(array), array.strides[0] // array.itemsize))
            for array in self._shown
        ]

    def is_shown(self, state: KnownState) -> bool:
        """Return whether the state before looks the same."""
        return self._shared_with(state) == len(self._used)

    def _shared_with(self, state: KnownState) -> int:
        """Return how many levels, the core counting as one, are the same as in the state before."""
        before = self._before
        if before is None:
            return 0
        for number, used in enumerate(self._used):
            level = self._region.core + number
            # Up to the level that is known whole they count lattice steps, beyond it finer ones.
            if min(before.whole, level) != min(state.whole, level) or (before.passes[used] != state.passes[used]).any():
                return number
        return len(self._used)

    def _make_core(self, state: KnownState, stacks: Stacks) -> None:
        region, core = self._region, self._region.core
        bare = [level for level in state.bare if level <= core]
        self._tiles.spread_levels(core, state.passes, stacks, state.whole, bare=bare)
        inverse(self._core, region.part, self._predictors, core, state.whole, self._coordinate, bare=bare)


class _Level:
    """A level of a window: its array, int32, shape (row, column), what goes into it, and what is done with that."""

    def __init__(
        self,
        step: LevelPart,
        array: Grid,
        copies: list[tuple[Grid, Grid]],
        predictors: NDArray[np.int8],
        table: TileTable,
    ) -> None:
        layout, self._number, self._copies = table.layout, step.level, copies
        self._quarters = _quarters(step, array, table)
        owners = [table.origins[quarter.numbers, 0] for quarter in self._quarters]
        #: The tiles that have something of it, by their numbers in the table.
        self.tiles = np.unique(np.concatenate(owners)) if owners else np.zeros(0, np.int64)
        down, across = (
            predictor(predictors, layout.grids[0], whole, step.level, axis)
            for axis, whole in enumerate(layout.steps(0, step.level))
        )
        self._inverses = []
        for (top, rows), (left, columns) in product(step.rows.places, step.columns.places):
            corner = array[top : top + rows.step.length, left : left + columns.step.length]
            self._inverses.append((corner, LevelInverse((rows.step, columns.step), (down, across))))

    def make(self, tiles: Tiles, state: KnownState) -> None:
        """Reconstruct the level from the level below."""
        bare = self._number in state.bare
        for place, nodes in self._copies:
            place[...] = nodes
        if not bare:
            for numbers, place, origin in self._quarters:
                tiles.spread_part(numbers, state.passes, place, origin, self._number > state.whole)
        for array, undo in self._inverses:
            undo(array, self._number == state.whole + 1, bare)


def _quarters(step: LevelPart, array: Grid, table: TileTable) -> list[_Quarter]:
    """Return the parts of a level's array that hold its coefficients."""
    tiles = table.layout.tiles_of(step.level)
    span = np.searchsorted(np.asarray(table.members), [tiles.start, tiles.stop])
    numbers = np.arange(table.first[span[0]], table.first[span[1]])
    first = table.origins[numbers, 1:]
    last = first + table.bands[numbers][:, [ROWS, COLUMNS]]
    quarters = []
    for rows, columns in product(step.rows.runs, step.columns.runs):
        if rows.details or columns.details:
            starts, stops = np.array([rows[:2], columns[:2]]).T
            taken = ((first < stops) & (last > starts)).all(axis=1)
            height, width = (stops - starts).tolist()
            place = array[rows.place : rows.place + height, columns.place : columns.place + width]
            quarters.append(_Quarter(numbers[taken], place, (rows.first, columns.first)))
    return [quarter for quarter in quarters if len(quarter.numbers)]


def _arrays(shapes: Sequence[tuple[int, int]], memory: NDArray[np.int32] | None) -> list[Grid]:
    """Return arrays of these shapes, (row, column), in one piece of memory, each followed by room for another row."""
    ends = list(accumulate(((rows + 1) * (columns + PADDING) for rows, columns in shapes), initial=0))
    flat = np.empty(ends[-1], np.int32) if memory is None else memory
    arrays = []
    for first, (rows, columns) in zip(ends, shapes, strict=False):
        pitch = columns + PADDING
        arrays.append(flat[first : first + rows * pitch].reshape(rows, pitch)[:, :columns])
    return arrays


def _copies(step: LevelPart, array: Grid, nodes: Grid, wanted: Sequence[Sequence[Span]]) -> list[tuple[Grid, Grid]]:
    """Return pairs of views.

    A place in a level's array, shape (row, column), and the nodes of the level below for it.
    """
    pairs = [
        list(_paired(part.node_places, spans)) for part, spans in zip((step.rows, step.columns), wanted, strict=True)
    ]
    return [
        (array[slice(*rows[0]), slice(*columns[0])], nodes[slice(*rows[1]), slice(*columns[1])])
        for rows, columns in product(*pairs)
    ]


def _paired(places: Sequence[Span], sources: Sequence[Span]) -> Iterator[tuple[Span, Span]]:
    """Yield pairs of equally long spans: those of ``sources``, one after another, and their places among ``places``."""
    cuts = sorted({0, *(accumulate(b - a for a, b in places)), *(accumulate(b - a for a, b in sources))})
    for start, stop in pairwise(cuts):
        yield _within(places, start, stop), _within(sources, start, stop)


def _within(spans: Sequence[Span], start: int, stop: int) -> Span:
    """Return the samples from ``start`` to before ``stop`` of concatenated spans; all must lie within one span."""
    for first, last in spans:
        if start < last - first:
            return first + start, first + stop
        start, stop = start - (last - first), stop - (last - first)
    raise IndexError(start)
