"""Some rows of a surface of one grid, or a window of them, in any states, from a part of its tiles.

Level by level from a coarse one, which is reconstructed whole, only that is made which the next finer level needs:
`crop_across_seam` tells what. Where rows wrap, the first ones need some of the last ones, and the other way round.
Levels hold fewer and fewer points, so all of them take little more than the window itself. What a state shares with the
one before it is not made again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..entropy.band_fields import COLUMNS, ROWS
from ..entropy.part_table import consecutive
from ..entropy.tiles import Tiles, TileTable
from ..grid.axis import AxisStep
from ..grid.layout import Layout
from ..transform.all_levels import LevelInverse
from ..transform.lifting import FRACTION_BITS
from ..transform.predictors import predictor
from ..transform.pyramid import PADDING, inverse
from .crop import AxisCrop, SeamCrop, crop_across_seam, crop_axis
from .levels import known_levels

__all__ = ["KnownState", "RowsGeometry", "RowsReconstructor", "known_state"]

#: Rows or columns, half-open.
Span = tuple[int, int]


class _Run(NamedTuple):
    """Nodes or details that stand side by side along an axis.

    ``first`` and ``last`` are their places among all coefficients, half-open, ``place`` where the first one goes in
    what a step takes.
    """

    first: int
    last: int
    place: int
    details: bool


def _runs(full: AxisStep, crop: AxisCrop, before: int) -> list[_Run]:
    """What a crop takes of an axis: nodes and details, each in two runs where they go on with the first ones.

    ``before``: so many samples are made before those of the crop.
    """
    found = []
    nodes, details = crop.step.coarse, crop.step.length - crop.step.coarse
    for count, every, start, place in (
        (nodes, full.coarse, 0, before),
        (details, full.length - full.coarse, full.coarse, before + nodes),
    ):
        own = min(count, max(every - crop.first, 0))
        found.append(_Run(start + crop.first, start + crop.first + own, place, start > 0))
        found.append(_Run(start, start + count - own, place + own, start > 0))
    return [run for run in found if run.last > run.first]


@dataclass(frozen=True)
class _Step:
    """One level of the way up: what it takes and makes along both axes, and which part of that is wanted.

    Rows may go on beyond the last one, with the first ones.
    """

    level: int
    rows: SeamCrop
    columns: AxisCrop
    wanted_columns: Span

    @property
    def starts(self) -> list[int]:
        """Where the rows begin that each crop makes."""
        return [0, *accumulate(crop.step.length for crop in self.rows.crops)][:-1]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns that are made, those beside what is wanted included."""
        return sum(crop.step.length for crop in self.rows.crops), self.columns.step.length

    @property
    def nodes(self) -> list[Span]:
        """The rows that nodes go to."""
        return [(at, at + crop.step.coarse) for at, crop in zip(self.starts, self.rows.crops, strict=True)]

    def runs(self, layout: Layout) -> tuple[list[_Run], list[_Run]]:
        """The rows and the columns of coefficients that are taken."""
        down, across = layout.steps(0, self.level)
        rows = [_runs(down, crop, at) for at, crop in zip(self.starts, self.rows.crops, strict=True)]
        return [run for own in rows for run in own], _runs(across, self.columns, 0)


class RowsGeometry:
    """What some rows of a surface need, or a window of them.

    Parameters
    ----------
    layout : Layout
        Of one grid.
    rows : (int, int)
        Half-open.
    core : int
        The level that is reconstructed whole.
    columns : (int, int), optional
        Half-open; all if not given. Where columns wrap all of them are made whatever is wanted.
    level : int, optional
        Of which rows and columns are wanted, at least ``core``; the finest if not given.

    Raises
    ------
    ValueError
        If the layout has several grids.
    """

    def __init__(
        self, layout: Layout, rows: Span, core: int, columns: Span | None = None, level: int | None = None
    ) -> None:
        if len(layout.grids) != 1:
            raise ValueError(f"expected a layout of one grid, got {len(layout.grids)}")
        self.layout, self.rows, self.core = layout, rows, core
        self.level = layout.levels if level is None else level
        self.columns = columns or (0, layout.shape(0, self.level)[1])
        steps = []
        down, across = rows, self.columns
        for finer in range(self.level, core, -1):
            along, beside = layout.steps(0, finer)
            own, crop = crop_across_seam(along, *down), crop_axis(beside, *across)
            steps.append(_Step(finer, own, crop, (crop.start, crop.start + across[1] - across[0])))
            down, across = own.nodes, (crop.first, crop.first + crop.step.coarse)
        self.steps = steps[::-1]
        length = layout.shape(0, core)[0]
        self.core_rows = [(down[0], min(down[1], length)), *([(0, down[1] - length)] if down[1] > length else [])]
        self.core_columns = across

    @cached_property
    def levels(self) -> list[list[range]]:
        """The numbers of the tiles that are needed for all columns: runs of them, in their order.

        Of all levels up to the core, then of each finer one.
        """
        return [[range(self.layout.tiles_of(self.core).stop)], *(self._tiles_of(step) for step in self.steps)]

    @property
    def tiles(self) -> list[range]:
        """The same of all levels, one after another."""
        return [run for own in self.levels for run in own]

    def _tiles_of(self, step: _Step) -> list[range]:
        """The tiles of a level that have nodes or details in the rows."""
        own = self.layout.tiles_of(step.level)
        bands = self.layout.tile_arrays.bands(np.arange(own.start, own.stop), True)
        first, last = bands.start[:, 0], bands.start[:, 0] + bands.shape[:, 0]
        taken = np.zeros(len(first), np.bool_)
        for run in step.runs(self.layout)[0]:
            taken |= (first < run.last) & (last > run.first)
        return consecutive(own.start + bands.tile[taken])


class KnownState(NamedTuple):
    """A state as far as a part of the tiles is concerned.

    Attributes
    ----------
    passes : int8, shape (tile,)
        Passes that remain of each tile of the part.
    whole, bare : int, list of int
        See `known_levels`: of the whole surface, or of its levels up to the one that is reconstructed.
    """

    passes: NDArray[np.int8]
    whole: int
    bare: list[int]


def known_state(table: TileTable, state: NDArray[np.int8], level: int | None = None) -> KnownState:
    """A state, int8, shape (tile,) of all tiles of the surface, as far as those of a table are concerned.

    It is to be reconstructed at ``level``, the finest one if not given.
    """
    finest = table.layout.levels if level is None else level
    return KnownState(state[np.asarray(table.members)], *known_levels(table.layout, state, finest))


class _Quarter(NamedTuple):
    """Nodes or details of a level along either axis: their bands, and where they go.

    ``numbers`` are those of the bands in the table, int64, shape (band,); ``part`` is a view of the level's grid,
    ``origin`` its first row and column among all coefficients.
    """

    numbers: NDArray[np.int64]
    part: NDArray[np.int32]
    origin: tuple[int, int]


class _Grid:
    """Room for a level's grid, or for a part of it: ``array``, int32, shape (row, column).

    ``wanted`` are rows of it that are wanted, in their order; ``frame`` are the first of them and more columns, in one
    piece.
    """

    def __init__(self, shape: tuple[int, int], rows: Sequence[Span], columns: Span) -> None:
        (top, bottom), (left, right) = rows[0], columns
        pitch = shape[1] + PADDING
        flat = np.empty((shape[0] + 1) * pitch, np.int32)
        self.array = flat[: shape[0] * pitch].reshape(-1, pitch)[:, : shape[1]]
        first = top * pitch + left
        self.frame = flat[first : first + (bottom - top) * pitch].reshape(-1, pitch)
        self.wanted = [self.array[slice(*span), left:right] for span in rows]


#: A place for nodes, and the nodes; shape (row, column) both.
_Copy = tuple[NDArray[np.int32], NDArray[np.int32]]


def _copies(wanted: Sequence[NDArray[np.int32]], places: Sequence[NDArray[np.int32]]) -> list[_Copy]:
    """Which parts of the nodes that are wanted, shape (row, column) each, go to which parts of their places."""
    ends = sorted({*accumulate(map(len, wanted)), *accumulate(map(len, places))})
    found = []
    for start, stop in pairwise([0, *ends]):
        found.append((_rows_of(places, start, stop), _rows_of(wanted, start, stop)))
    return found


def _rows_of(arrays: Sequence[NDArray[np.int32]], start: int, stop: int) -> NDArray[np.int32]:
    """Some rows, of one of the arrays that stand one below the other."""
    for array in arrays:
        if start < len(array):
            return array[start:stop]
        start, stop = start - len(array), stop - len(array)
    raise IndexError(start)


class RowsReconstructor:
    """Reconstructs the rows, or the window, of one channel, in one state after another.

    Parameters
    ----------
    geometry : RowsGeometry
    predictors : int8, shape (level, axis, 2)
    tiles : Tiles
        Of the tiles of the geometry and any others, numbered anew in their order, with all that is to be known of them;
        or of all tiles of the surface. Those of levels up to the core are all there.

    Attributes
    ----------
    frame : int32, shape (row, column and `PADDING` or more)
        What was reconstructed last, in one piece. What the columns beyond hold means nothing.
    """

    def __init__(self, geometry: RowsGeometry, predictors: NDArray[np.int8], tiles: Tiles) -> None:
        self._geometry, self._layout, self._predictors = geometry, geometry.layout, predictors
        self._tiles, layout = tiles, geometry.layout
        self._core = _Grid(layout.shape(0, geometry.core), geometry.core_rows, geometry.core_columns)
        self._grids = [_Grid(step.shape, step.rows.wanted, step.wanted_columns) for step in geometry.steps]
        self.frame = (self._grids or [self._core])[-1].frame
        self._quarters = [self._quarters_of(*own) for own in zip(geometry.steps, self._grids, strict=True)]
        #: Of each step: which nodes go where, and what each of its crops is undone with.
        self._nodes, self._inverses = [], []
        below = self._core
        for step, grid in zip(geometry.steps, self._grids, strict=True):
            places = [grid.array[slice(*span), : step.columns.step.coarse] for span in step.nodes]
            self._nodes.append(_copies(below.wanted, places))
            below = grid
            down, across = (
                predictor(predictors, layout.grids[0], full, step.level, axis)
                for axis, full in enumerate(layout.steps(0, step.level))
            )
            self._inverses.append(
                [
                    (
                        grid.array[at : at + crop.step.length],
                        LevelInverse((crop.step, step.columns.step), (down, across)),
                    )
                    for at, crop in zip(step.starts, step.rows.crops, strict=True)
                ]
            )
        origins = tiles.table.origins
        #: Of the core, then of each step: the tiles that are looked at.
        self._used = [np.arange(layout.tiles_of(geometry.core).stop)]
        for own in self._quarters:
            numbers = [quarter.numbers for quarter in own]
            self._used.append(np.unique(origins[np.concatenate(numbers), 0]) if own else np.zeros(0, np.int64))
        self._before: KnownState | None = None

    def _quarters_of(self, step: _Step, grid: _Grid) -> list[_Quarter]:
        """The parts of a level's grid that hold its coefficients."""
        table, own = self._tiles.table, self._layout.tiles_of(step.level)
        span = np.searchsorted(np.asarray(table.members), [own.start, own.stop])
        numbers = np.arange(table.first[span[0]], table.first[span[1]])
        first = table.origins[numbers, 1:]
        last = first + table.bands[numbers][:, [ROWS, COLUMNS]]
        quarters = []
        for rows, columns in product(*step.runs(self._layout)):
            if rows.details or columns.details:
                starts, stops = np.array([rows[:2], columns[:2]]).T
                taken = ((first < stops) & (last > starts)).all(axis=1)
                height, width = (stops - starts).tolist()
                part = grid.array[rows.place : rows.place + height, columns.place : columns.place + width]
                quarters.append(_Quarter(numbers[taken], part, (rows.first, columns.first)))
        return [quarter for quarter in quarters if len(quarter.numbers)]

    def reconstruct(self, state: KnownState) -> tuple[NDArray[np.int32], int]:
        """The rows, or the window, in a state.

        Parameters
        ----------
        state : KnownState
            Of the tiles' table.

        Returns
        -------
        int32, shape (row, column), and int
            Lattice coordinates over two to the power of the second, as `reconstruct_channel` gives them. The array
            is this object's: the next call changes it.
        """
        layout, geometry = self._layout, self._geometry
        whole, bare = state.whole, state.bare
        shared = self._shared_with(state)
        self._before = state
        if not shared:
            known = [level for level in bare if level <= geometry.core]
            self._tiles.spread_levels(geometry.core, state.passes, [self._core.array], whole, bare=known)
            inverse([self._core.array], layout, self._predictors, geometry.core, whole, bare=bare)
        for number in range(max(shared - 1, 0), len(self._grids)):
            self._finer(number, state)
        # Rows of the surface itself never go on beyond the last one.
        (rows,) = (self._grids or [self._core])[-1].wanted
        return rows, FRACTION_BITS if whole < geometry.level else 0

    def is_shown(self, state: KnownState) -> bool:
        """Whether the state before shows the same."""
        return self._shared_with(state) == len(self._used)

    def _shared_with(self, state: KnownState) -> int:
        """How many grids, the core's and those of finer levels, are the same as in the state before."""
        before = self._before
        if before is None:
            return 0
        for number, used in enumerate(self._used):
            level = self._geometry.core + number
            # Up to the level that is known whole they count lattice steps, beyond it finer ones.
            if min(before.whole, level) != min(state.whole, level) or (before.passes[used] != state.passes[used]).any():
                return number
        return len(self._used)

    def _finer(self, number: int, state: KnownState) -> None:
        """Make the grid of a step from its nodes."""
        level = self._geometry.steps[number].level
        bare = level in state.bare
        for place, nodes in self._nodes[number]:
            place[...] = nodes
        if not bare:
            for numbers, part, origin in self._quarters[number]:
                self._tiles.spread_part(numbers, state.passes, part, origin, level > state.whole)
        for array, undo in self._inverses[number]:
            undo(array, level == state.whole + 1, bare)
