"""A part of a surface at a level, and the parts of all coarser levels that it depends on.

A region is the whole surface, rows or a window of its only grid, or some of its grids. Whole grids are made up to a
level, the *core*. Each finer level of a window is made from the nodes and details around it alone: `crop_across_seam`
says which. Levels have fewer and fewer points, so all of them together take little more than the window itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..entropy.part_table import consecutive, tiles_of_grids
from ..grid.axis import AxisStep
from ..grid.layout import Layout
from ..grid.window import taken
from ..kernels import PART_COLUMNS, PART_ROWS
from ..transform.pyramid import PADDING
from .crop import AxisCrop, SeamCrop, crop_across_seam

__all__ = ["CORE_POINTS", "AxisPart", "LevelPart", "Region", "Run", "Span", "core_level", "span_pieces"]

#: Rows or columns, half-open; of a closed axis they may go on beyond the last one with the first ones.
Span = tuple[int, int]

#: Points of the core of a window, at most: smaller cores take more time in calls than they save.
CORE_POINTS = 1 << 12


class Run(NamedTuple):
    """Neighbouring nodes or details of an axis, half-open among all coefficients, and their place in a level's part."""

    first: int
    last: int
    place: int
    details: bool


@dataclass(frozen=True)
class AxisPart:
    """What the step to a level takes and makes along one axis.

    Attributes
    ----------
    step : AxisStep
        The step of the whole axis.
    crop : SeamCrop
        What it takes for the samples that are wanted.
    """

    step: AxisStep
    crop: SeamCrop

    @cached_property
    def starts(self) -> list[int]:
        """Start of the samples of each crop among all that are made, then their number."""
        return [0, *accumulate(crop.step.length for crop in self.crop.crops)]

    @property
    def length(self) -> int:
        """Number of samples that are made, including those beside the wanted ones."""
        return self.starts[-1]

    @property
    def places(self) -> list[tuple[int, AxisCrop]]:
        """Each crop, and the start of its samples among all that are made."""
        return list(zip(self.starts, self.crop.crops, strict=False))

    @property
    def node_places(self) -> list[Span]:
        """Places of the nodes of each crop among the samples that are made."""
        return [(at, at + crop.step.coarse) for at, crop in self.places]

    @property
    def runs(self) -> list[Run]:
        """The nodes and details that the crops take, in runs of neighbours."""
        return [run for at, crop in self.places for run in self._runs(crop, at)]

    def _runs(self, crop: AxisCrop, before: int) -> list[Run]:
        """Return nodes and details of a crop, each in two runs where they continue at the start of the axis."""
        full, runs = self.step, []
        nodes, details = crop.step.coarse, crop.step.length - crop.step.coarse
        for count, total, start, place in (
            (nodes, full.coarse, 0, before),
            (details, full.length - full.coarse, full.coarse, before + nodes),
        ):
            until_seam = min(count, max(total - crop.first, 0))
            runs.append(Run(start + crop.first, start + crop.first + until_seam, place, start > 0))
            runs.append(Run(start, start + count - until_seam, place + until_seam, start > 0))
        return [run for run in runs if run.last > run.first]


@dataclass(frozen=True)
class LevelPart:
    """What is made of a level of the only grid: its parts along the axis of rows and the axis of columns."""

    level: int
    rows: AxisPart
    columns: AxisPart

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns that are made, those beside the wanted ones included."""
        return self.rows.length, self.columns.length


class Region:
    """What is made of a surface at a level. Use `whole`, `window` or `of_grids`.

    Attributes
    ----------
    layout : Layout
        Of the surface.
    level : int
    grids : sequence of int
        The grids that are made, by their numbers in the layout.
    part : Layout
        The layout of these grids.
    core : int
        The level up to which these grids are made whole.
    spans : ((int, int), (int, int)) or None
        Rows and columns of the level, of a window.
    steps : list of LevelPart
        The levels above the core, coarsest first; none where grids are made whole.
    core_spans : ((int, int), (int, int)) or None
        Rows and columns of the core that the first step takes, of a window.
    """

    def __init__(
        self,
        layout: Layout,
        level: int,
        core: int,
        spans: tuple[Span, Span] | None = None,
        part: tuple[Layout, Sequence[int]] | None = None,
    ) -> None:
        self.layout, self.level, self.core, self.spans = layout, level, core, spans
        self.part, self.grids = part or (layout, range(len(layout.grids)))
        self.steps: list[LevelPart] = []
        self.core_spans = spans
        if spans is not None:
            for finer in range(level, core, -1):
                down, across = (
                    AxisPart(step, crop_across_seam(step, *span))
                    for step, span in zip(layout.steps(0, finer), spans, strict=True)
                )
                self.steps.append(LevelPart(finer, down, across))
                spans = down.crop.nodes, across.crop.nodes
            self.steps.reverse()
            self.core_spans = spans

    @staticmethod
    def whole(layout: Layout, level: int) -> Region:
        """Return all grids of a level."""
        return Region(layout, level, level)

    @staticmethod
    def window(layout: Layout, level: int, rows: Span, columns: Span, core: int | None = None) -> Region:
        """Return rows and columns of a level of the only grid.

        Parameters
        ----------
        layout : Layout
            Of one grid.
        level : int
        rows, columns : (int, int)
            Half-open, of the level; along a closed axis they may go on beyond its last sample with the first ones.
        core : int, optional
            The level that is made whole; by default the finest one of at most `CORE_POINTS` points.

        Raises
        ------
        ValueError
            If the layout has several grids.
        """
        if len(layout.grids) != 1:
            raise ValueError(f"expected a layout of one grid, got {len(layout.grids)}")
        if core is None:
            core = core_level(layout, level, CORE_POINTS)
        return Region(layout, level, core, (rows, columns))

    @staticmethod
    def of_grids(layout: Layout, level: int, grids: Sequence[int]) -> Region:
        """Return some grids of a level, patches by their numbers in the layout, and the interfaces that they need."""
        return Region(layout, level, level, part=layout.part(grids))

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """Rows and columns of each grid that is made."""
        if self.spans is not None:
            (top, bottom), (left, right) = self.spans
            return [(bottom - top, right - left)]
        return [self.part.shape(number, self.level) for number in range(len(self.grids))]

    @cached_property
    def patches(self) -> list[int]:
        """The patches that are made, by their numbers: interfaces come before them in the layout."""
        interfaces = sum(grid.interface for grid in self.layout.grids)
        return [grid - interfaces for grid in self.grids if grid >= interfaces]

    @property
    def patch_shapes(self) -> list[tuple[int, int]]:
        """Rows and columns of each patch that is made."""
        return self.shapes[-len(self.patches) :]

    @property
    def cells(self) -> tuple[int, int]:
        """Rows and columns of the cells in which errors are summed up.

        Of one grid a cell has `PART_ROWS` x `PART_COLUMNS` points; of several grids each patch is a row with one cell.
        """
        if not self.has_cells:
            return len(self.patches), 1
        ((rows, columns),) = self.shapes
        return -(-rows // PART_ROWS), -(-columns // PART_COLUMNS)

    @property
    def has_cells(self) -> bool:
        """Whether the surface is one grid, which is divided into cells."""
        return len(self.layout.grids) == 1

    def spans_in(self, shape: tuple[int, int]) -> tuple[Span, Span]:
        """Return the rows and columns, half-open, of the region in a block of this shape at the level."""
        return self.spans or ((0, shape[0]), (0, shape[1]))

    def of_block(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return the region's part of an array of a block at the level, shape (row, column, ...).

        A view if it is one piece.
        """
        return array if self.spans is None else taken(array, self.spans, (array.shape[0], array.shape[1]))

    @property
    def size(self) -> int:
        """Integers that a reconstruction takes: the grids of the core, and the parts of all finer levels."""
        core = [self.part.shape(number, self.core) for number in range(len(self.grids))]
        return _size(core) + self.size_above

    @property
    def size_above(self) -> int:
        """Integers that a reconstruction takes where the core is made already."""
        return _size([step.shape for step in self.steps])

    @cached_property
    def tiles(self) -> list[range]:
        """The tiles with coefficients of the region: runs of numbers, of one level each."""
        if self.spans is None:
            return tiles_of_grids(self.layout, self.grids, self.level)
        return [run for runs in self._level_tiles for run in runs]

    @cached_property
    def coded_tiles(self) -> list[range]:
        """The same with their parents, whose segments are decoded before theirs."""
        if self.spans is None:
            return self.tiles
        levels = list(self._level_tiles)
        for number in range(len(levels) - 1, 1, -1):
            parents = [self.layout.tile_arrays.parents(np.array(run)) for run in levels[number]]
            if parents:
                levels[number - 1] = consecutive(np.concatenate([*parents, *map(np.array, levels[number - 1])]))
        return [run for runs in levels for run in runs]

    @cached_property
    def _level_tiles(self) -> list[list[range]]:
        """The tiles of all levels up to the core, then of each finer one."""
        return [[range(self.layout.tiles_of(self.core).stop)], *map(self._tiles_of, self.steps)]

    def _tiles_of(self, step: LevelPart) -> list[range]:
        """Return the tiles of a level that have nodes or details of what is made of it."""
        tiles = self.layout.tiles_of(step.level)
        bands = self.layout.tile_arrays.bands(np.arange(tiles.start, tiles.stop), True)
        first, last = bands.start, bands.start + bands.shape
        taken = np.zeros(len(first), np.bool_)
        for rows, columns in product(step.rows.runs, step.columns.runs):
            starts, stops = np.array([rows[:2], columns[:2]]).T
            taken |= ((first < stops) & (last > starts)).all(axis=1)
        return consecutive(tiles.start + bands.tile[taken])


def _size(shapes: Sequence[tuple[int, int]]) -> int:
    """Return numbers that arrays of these shapes take, each with room for one row more."""
    return sum((rows + 1) * (columns + PADDING) for rows, columns in shapes)


def core_level(layout: Layout, level: int, points: int) -> int:
    """Return the finest level, up to ``level``, of at most so many points; 0 if there is none."""
    return max((coarser for coarser in range(level + 1) if layout.points(coarser) <= points), default=0)


def span_pieces(span: Span, length: int) -> list[Span]:
    """Return a span of an axis, in two spans where it continues at the start of the axis."""
    start, stop = span
    return [(start, min(stop, length)), *([(0, stop - length)] if stop > length else [])]
