"""Some rows of a surface of one grid, or a window of them, in any states, from a part of its tiles.

Level by level from a coarse one, which is reconstructed whole, only that is made which the next finer level needs:
`crop_axis` tells what. Levels hold fewer and fewer points, so all of them take little more than the window itself. What
a state shares with the one before it is not made again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..entropy.band_fields import COLUMNS, ROWS
from ..entropy.tiles import Tiles, TileTable
from ..grid.layout import Layout
from ..transform.all_levels import LevelInverse
from ..transform.lifting import FRACTION_BITS
from ..transform.predictors import predictor
from ..transform.pyramid import PADDING, inverse
from .crop import AxisCrop, crop_axis
from .levels import known_levels

__all__ = ["KnownState", "RowsGeometry", "RowsReconstructor", "known_state"]

#: Rows or columns, half-open.
Span = tuple[int, int]


@dataclass(frozen=True)
class _Step:
    """One level of the way up: what it takes and makes along both axes, and which part of that is wanted."""

    level: int
    crops: tuple[AxisCrop, AxisCrop]
    part: tuple[Span, Span]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns that are made, those beside what is wanted included."""
        return self.crops[0].step.length, self.crops[1].step.length

    @property
    def coarse(self) -> tuple[int, int]:
        """Rows and columns of nodes that are taken."""
        return self.crops[0].step.coarse, self.crops[1].step.coarse

    def spans(self, layout: Layout, axis: int) -> tuple[Span, Span]:
        """The nodes and the details that are taken along an axis, among all coefficients."""
        crop, nodes = self.crops[axis], layout.shape(0, self.level - 1)[axis]
        first, details = crop.first, crop.step.length - crop.step.coarse
        return (first, first + crop.step.coarse), (nodes + first, nodes + first + details)


class RowsGeometry:
    """What some rows of a surface need, or a window of them.

    Parameters
    ----------
    layout : Layout
        Of one grid, whose rows do not wrap.
    rows : (int, int)
        Half-open.
    core : int
        The level that is reconstructed whole.
    columns : (int, int), optional
        Half-open; all if not given. Where columns wrap all of them are made whatever is wanted.
    level : int, optional
        Of which rows and columns are wanted, at least ``core``; the finest if not given.
    """

    def __init__(
        self, layout: Layout, rows: Span, core: int, columns: Span | None = None, level: int | None = None
    ) -> None:
        if len(layout.grids) != 1 or layout.grids[0].closed[0]:
            raise ValueError("expected a layout of one grid whose rows do not wrap")
        self.layout, self.rows, self.core = layout, rows, core
        self.level = layout.levels if level is None else level
        self.columns = columns or (0, layout.shape(0, self.level)[1])
        steps, spans = [], (rows, self.columns)
        for finer in range(self.level, core, -1):
            across, down = layout.steps(0, finer)
            crops = crop_axis(across, *spans[0]), crop_axis(down, *spans[1])
            above, left = (
                (crop.start, crop.start + stop - start) for crop, (start, stop) in zip(crops, spans, strict=True)
            )
            steps.append(_Step(finer, crops, (above, left)))
            above, left = ((crop.first, crop.first + crop.step.coarse) for crop in crops)
            spans = above, left
        self.steps = steps[::-1]
        self.core_part = spans

    @cached_property
    def tiles(self) -> list[range]:
        """The numbers of the tiles that are needed for all columns, in their order.

        Of all levels up to the core, then of each finer one.
        """
        return [range(self.layout.tiles_of(self.core).stop), *(self._tiles_of(step) for step in self.steps)]

    def _tiles_of(self, step: _Step) -> range:
        """The tiles of a level that have nodes or details in the rows; they are neighbours."""
        own = self.layout.tiles_of(step.level)
        bands = self.layout.tile_arrays.bands(np.arange(own.start, own.stop), True)
        first, last = bands.start[:, 0], bands.start[:, 0] + bands.shape[:, 0]
        taken = [(first < stop) & (last > start) for start, stop in step.spans(self.layout, 0)]
        found = own.start + bands.tile[taken[0] | taken[1]]
        return range(int(found[0]), int(found[-1]) + 1) if found.size else range(0)


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

    ``wanted`` are the rows and columns of it that are wanted, ``frame`` these and more columns, in one piece.
    """

    def __init__(self, shape: tuple[int, int], wanted: tuple[Span, Span]) -> None:
        (top, bottom), (left, right) = wanted
        pitch = shape[1] + PADDING
        flat = np.empty((shape[0] + 1) * pitch, np.int32)
        self.array = flat[: shape[0] * pitch].reshape(-1, pitch)[:, : shape[1]]
        first = top * pitch + left
        self.frame = flat[first : first + (bottom - top) * pitch].reshape(-1, pitch)
        self.wanted = self.frame[:, : right - left]


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
        self._core = _Grid(layout.shape(0, geometry.core), geometry.core_part)
        self._grids = [_Grid(step.shape, step.part) for step in geometry.steps]
        self.frame = (self._grids or [self._core])[-1].frame
        self._quarters = [self._quarters_of(*own) for own in zip(geometry.steps, self._grids, strict=True)]
        self._inverses = []
        for step in geometry.steps:
            across, down = (
                predictor(predictors, layout.grids[0], full, step.level, axis)
                for axis, full in enumerate(layout.steps(0, step.level))
            )
            crops = step.crops
            self._inverses.append(LevelInverse((crops[0].step, crops[1].step), (across, down)))
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
        spans = [step.spans(self._layout, axis) for axis in range(2)]
        quarters = []
        for down, across in ((0, 1), (1, 0), (1, 1)):
            starts, stops = np.array([spans[0][down], spans[1][across]]).T
            taken = ((first < stops) & (last > starts)).all(axis=1)
            rows, columns = (
                slice(count, None) if details else slice(count)
                for count, details in zip(step.coarse, (down, across), strict=True)
            )
            quarters.append(_Quarter(numbers[taken], grid.array[rows, columns], (int(starts[0]), int(starts[1]))))
        return [quarter for quarter in quarters if len(quarter.numbers) and quarter.part.size]

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
        rows = self._core.wanted
        for number, grid in enumerate(self._grids):
            if number + 1 >= shared:
                self._finer(number, rows, state)
            rows = grid.wanted
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

    def _finer(self, number: int, nodes: NDArray[np.int32], state: KnownState) -> None:
        """Make the grid of a step from its nodes."""
        step, array = self._geometry.steps[number], self._grids[number].array
        bare = step.level in state.bare
        array[: step.coarse[0], : step.coarse[1]] = nodes
        if not bare:
            for numbers, part, origin in self._quarters[number]:
                self._tiles.spread_part(numbers, state.passes, part, origin, step.level > state.whole)
        self._inverses[number](array, step.level == state.whole + 1, bare)
