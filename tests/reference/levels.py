"""Grids and their levels: steps of an axis, subbands, where nodes stand. Section 4 of docs/format.md."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Axis:
    """One axis of a grid at one level.

    `samples` (int): its samples at this level; `closed` (bool): it is periodic; `clamped` ((bool, bool)): its first and
    its last sample keep their value in every step.
    """

    samples: int
    closed: bool
    clamped: tuple[bool, bool] = (False, False)

    def steps(self, stops: bool) -> bool:
        """Whether the axis takes a step; with `stops` none once its length is even."""
        return self.samples >= (5 if self.closed else 3) and not (stops and self.samples % 2 == 0)

    @property
    def extra(self) -> bool:
        """Whether the last sample is one more node, outside the run."""
        return not self.closed and self.samples % 2 == 0

    @property
    def run(self) -> int:
        """Nodes of the run, R."""
        return self.samples // 2 if self.extra else (self.samples + 1) // 2

    @property
    def nodes(self) -> int:
        """Nodes after the step."""
        return self.run + self.extra

    @property
    def midpoints(self) -> int:
        """Midpoints, which become details."""
        return self.samples - self.nodes


@dataclass(frozen=True)
class Grid:
    """One interface or patch.

    `interface` (bool): it is an interface: its second axis has one sample; `axes` (list of (Axis, Axis)): both axes at
    every level, from 0 to L; `left_out` ((bool, bool, bool, bool)): nodes of a coordinate that come from elsewhere: of
    a patch in its first row, last row, first column, last column; of an interface at level 0 its first and its last.
    """

    interface: bool
    axes: list[tuple[Axis, Axis]]
    left_out: tuple[bool, bool, bool, bool] = field(default=(False, False, False, False))

    def shape(self, level: int) -> tuple[int, int]:
        """Rows and columns at a level."""
        first, second = self.axes[level]
        return first.samples, second.samples

    def stepped(self, level: int, axis: int) -> bool:
        """Whether the axis takes a step from this level to the one below it."""
        return level > 0 and self.axes[level][axis].samples != self.axes[level - 1][axis].samples

    def kept(self, level: int, axis: int) -> tuple[int, int]:
        """Which nodes along an axis a coordinate's bands of a level hold: the first, and behind the last."""
        count = self.shape(max(level - 1, 0))[axis]
        if self.interface and (level > 0 or axis == 1):
            return 0, count
        first, last = self.left_out[2 * axis : 2 * axis + 2]
        return int(first), max(count - last, int(first))


def levels_of(axes: list[tuple[Axis, Axis]], stops: list[tuple[bool, bool]]) -> list[list[tuple[Axis, Axis]]]:
    """Give the axes of all grids at all levels.

    `axes`, `stops` (list): of each grid, at the finest level. Returns list of list of (Axis, Axis): for each grid its
    axes at the levels 0 to L; L is the same for all.
    """
    found = [[pair] for pair in axes]
    while True:
        stepped = False
        below = []
        for chain, stop in zip(found, stops, strict=True):
            pair = tuple(
                Axis(axis.nodes, axis.closed, axis.clamped) if axis.steps(end) else axis
                for axis, end in zip(chain[-1], stop, strict=True)
            )
            stepped = stepped or pair != chain[-1]
            below.append((pair[0], pair[1]))
        if not stepped:
            return [chain[::-1] for chain in found]
        for chain, lower in zip(found, below, strict=True):
            chain.append(lower)


def fitted_steps(grids: list[Grid], interfaces: bool) -> list[tuple[int, int]]:
    """List the steps for which a channel has predictors.

    `grids` (list of Grid): all grids; `interfaces` (bool): whether those of interfaces count: for coordinates, not for
    attributes. Returns list of (int, int): lower level of the step, and 0, 1 for the axes of patches, 2 for interfaces;
    in the order of the header.
    """
    kinds = [(0, False, 0), (1, False, 1)] + ([(2, True, 0)] if interfaces else [])
    return [
        (level, kind)
        for level in range(len(grids[0].axes) - 1)
        for kind, of_interfaces, axis in kinds
        if any(
            grid.interface == of_interfaces and grid.stepped(level + 1, axis) and grid.axes[level + 1][axis].run >= 24
            for grid in grids
        )
    ]


def positions(grid: Grid, axis: int, level: int) -> NDArray[np.int64]:
    """Find the samples of the finest level at which an axis' nodes of a level stand; int64 (nodes,)."""
    place = np.arange(grid.shape(level)[axis])
    for upper in range(level + 1, len(grid.axes)):
        if grid.stepped(upper, axis):
            line = grid.axes[upper][axis]
            place = 2 * place
            if line.extra:
                place[place == 2 * line.run] = line.samples - 1
    return place
