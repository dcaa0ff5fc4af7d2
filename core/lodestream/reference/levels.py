"""Sections 3.1 and 4 of docs/format.md: grids and their levels, and the ends that curves have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

from ..errors import StreamError
from .header import Block, Grid, Header

__all__ = ["Axis", "GridLevels", "Levels", "Predictor"]

FITTED = 24

Predictor = tuple[int, int]


@dataclass(frozen=True)
class Axis:
    """One axis of a grid at one level; `clamped` are its two ends."""

    samples: int
    closed: bool
    stops: bool
    clamped: tuple[bool, ...]

    @property
    def steps(self) -> bool:
        """Whether it takes a step to the next coarser level."""
        return self.samples >= (5 if self.closed else 3) and not (self.stops and self.samples % 2 == 0)

    @property
    def periodic(self) -> bool:
        """Whether the run of its step goes round without a gap."""
        return self.closed and self.samples % 2 == 0

    @property
    def midpoints(self) -> int:
        """M of its step."""
        return self.samples // 2 if self.periodic else (self.samples - 1) // 2

    @property
    def run(self) -> int:
        """R of its step."""
        return (self.samples + 1) // 2

    @property
    def nodes(self) -> int:
        """Samples of the coarser level."""
        return self.samples - self.midpoints if self.steps else self.samples

    @property
    def clamped_run(self) -> tuple[bool, bool]:
        """Which ends of the run are clamped."""
        return self.clamped[0], self.clamped[1] and self.samples % 2 == 1

    def coarser(self) -> Axis:
        """The same axis at the next coarser level."""
        return replace(self, samples=self.nodes)

    def at_nodes(self, samples: list[int]) -> list[int]:
        """What of each sample there is, at the nodes alone."""
        if not self.steps:
            return samples
        return samples[: 2 * self.run : 2] + samples[len(samples) - (self.nodes - self.run) :]


@dataclass(frozen=True)
class GridLevels:
    """A grid at all levels."""

    number: int
    grid: Grid
    axes: list[list[Axis]]  # by level: axis 0 and axis 1
    lacks: tuple[bool, ...]  # whether bands of coordinates leave out the first and last nodes of axis 0, and of axis 1

    @property
    def is_curve(self) -> bool:
        """Whether it is a curve, whose bands lack nodes at level 0 only."""
        return self.grid.is_curve

    def shape(self, level: int) -> tuple[int, int]:
        """Rows and columns of a level."""
        rows, columns = self.axes[level]
        return rows.samples, columns.samples

    def places(self, level: int, block: Block) -> list[list[int]]:
        """The rows and columns of its block at which the nodes of a level stand, in the order of the grid."""
        found = []
        for axis, size in enumerate(block[:2]):
            places = list(range(self.grid.shape[axis]))
            for finer in self.axes[:level:-1]:
                places = finer[axis].at_nodes(places)
            if self.grid.backwards[axis]:
                places = [self.grid.shape[axis] - 1 - place for place in places]
            found.append([(self.grid.first[axis] + place) % size for place in places])
        return found


End = tuple[int, int]  # of a curve: its number, and 0 for its first point, 1 for its last


def _common_ends(grids: list[Grid]) -> dict[End, End]:
    """For each end of a curve that another end holds, that end."""
    lengths = [grid.shape[0] for grid in grids if grid.is_curve]
    holder = {(curve, end): (curve, end) for curve in range(len(lengths)) for end in (0, 1)}

    def join(one: End, other: End) -> None:
        groups = holder[one], holder[other]
        if groups[0] != groups[1]:
            holder.update({end: min(groups) for end, held in holder.items() if held in groups})

    one_point = {(number, 1): (number, 0) for number, length in enumerate(lengths) if length == 1}
    for first, last in one_point.items():
        join(first, last)
    for part in grids:
        for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
            across, down = part.sides[row], part.sides[2 + column]
            if across is not None and down is not None and not any(part.closed):
                join((across.curve, column ^ across.reversed), (down.curve, row ^ down.reversed))
    return {end: held for end, held in holder.items() if held not in (end, one_point.get(end))}


class Levels:
    """Section 4: all `grids`, and the number of the `last` level, L; `held` has the ends that are held by others."""

    def __init__(self, header: Header) -> None:
        self.held = _common_ends(header.grids)
        self._group_points = 2 ** (sum(header.tile) + 2)
        levels = [
            [
                [Axis(grid.shape[k], grid.closed[k], grid.stops[k], grid.clamped[2 * k : 2 * k + 2]) for k in (0, 1)]
                for grid in header.grids
            ]
        ]
        while any(axis.steps for axes in levels[0] for axis in axes):
            levels.insert(0, [[axis.coarser() for axis in axes] for axes in levels[0]])
        self.last = len(levels) - 1
        self.grids = []
        for number, grid in enumerate(header.grids):
            lacks = tuple(side is not None for side in grid.sides)
            if grid.is_curve:
                lacks = ((number, 0) in self.held, (number, 1) in self.held, False, False)
            self.grids.append(GridLevels(number, grid, [level[number] for level in levels], lacks))
        steps = [*product(range(1, self.last + 1), ((0, False), (1, False), (0, True)))]
        fitted = [(level, *which) for level, which in steps if self._is_fitted(level, *which)]
        self._predictors: dict[tuple[int, int, int, bool], Predictor] = {}
        for channel, own in enumerate(header.predictors):
            coded = [step for step in fitted if channel < header.coordinates or not step[-1]]
            if len(coded) != len(own):
                raise StreamError(f"expected {len(coded)} predictors of channel {channel}, got {len(own)}")
            self._predictors |= {(channel, *step): pair for step, pair in zip(coded, own, strict=True)}

    def _is_fitted(self, level: int, axis: int, of_curves: bool) -> bool:
        axes = [grid.axes[level][axis] for grid in self.grids if grid.is_curve == of_curves]
        return any(each.steps and each.run >= FITTED for each in axes)

    def predictor(self, channel: int, grid: GridLevels, level: int, axis: int) -> Predictor:
        """The (a, b) of a grid's step from a level down."""
        if grid.axes[level][axis].run < FITTED:
            return 16, 0
        return self._predictors[channel, level, axis, grid.is_curve]

    def groups(self) -> list[list[list[GridLevels]]]:
        """Section 5: for each level the groups of grids that have tiles in common; level 0 has one."""
        levels = [[[grid] for grid in self.grids]]
        for level in range(self.last, 0, -1):
            groups: list[list[GridLevels]] = []
            for group in levels[0]:
                if groups and _belong_together([*groups[-1], *group], level, self._group_points):
                    groups[-1] += group
                else:
                    groups.append(list(group))
            levels.insert(0, groups)
        return [[self.grids], *levels[:-1]]


def _belong_together(grids: list[GridLevels], level: int, most: int) -> bool:
    if grids[0].is_curve or grids[-1].is_curve:
        return grids[-1].is_curve
    return sum(math.prod(grid.shape(level)) for grid in grids) <= most
