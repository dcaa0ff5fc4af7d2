"""Which grids and tiles are worked on together, level by level: pure geometry of a surface of several grids.

Where a surface of one grid has bands of rows, one of several blocks has runs of neighbouring grids: patches, and the
interfaces along which they meet. No patch is divided, so that the largest one says how much memory there must be.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from ..grid.layout import Layout
from .geometry import CORE_POINTS

__all__ = ["GridRun", "GridRuns"]


@dataclass(frozen=True)
class GridRun:
    """Neighbouring grids of one level whose tiles have no others.

    Attributes
    ----------
    level, number : int
        The level, and which of its runs this is, from the first grid on.
    tiles : range
        Numbers of their tiles.
    grids : range
        Numbers of the grids in the layout.
    """

    level: int
    number: int
    tiles: range
    grids: range


class GridRuns:
    """The runs of a layout of several grids; what `Bands` is for a layout of one.

    Parameters
    ----------
    layout : Layout
    points : int
        About so many points of its level make a run, but at least one patch, or several small ones whose tiles are
        common.
    core_points : int
        Levels of at most so many points belong to the core.

    Attributes
    ----------
    core : int
        The finest level of the core, which is one piece.
    """

    def __init__(self, layout: Layout, points: int, core_points: int = CORE_POINTS) -> None:
        self.layout, self._points = layout, points
        self.core = max((level for level in range(layout.levels + 1) if layout.points(level) <= core_points), default=0)
        self._levels = [self._runs(level) for level in self.levels]

    def of(self, level: int) -> tuple[GridRun, ...]:
        """The runs of a level finer than the core."""
        return self._levels[level - self.core - 1]

    @property
    def levels(self) -> range:
        """The levels that have runs, coarsest first."""
        return range(self.core + 1, self.layout.levels + 1)

    @cached_property
    def core_tiles(self) -> range:
        """Numbers of the tiles of the core."""
        return range(self.layout.tiles_of(self.core).stop)

    def samples(self, level: int) -> list[range]:
        """The grids of each piece of a level's samples: those of the next finer level's runs leave them."""
        if level == self.core == self.layout.levels:
            return [range(len(self.layout.grids))]
        return [run.grids for run in self.of(min(level + 1, self.layout.levels))]

    def size(self, grid: int, level: int) -> int:
        """Points of a grid at a level."""
        rows, columns = self.layout.shape(grid, level)
        return rows * columns

    def _runs(self, level: int) -> tuple[GridRun, ...]:
        grids, tiles = (ends.tolist() for ends in self.layout.tile_arrays.groups(level))
        found: list[GridRun] = []
        first, size = 0, 0
        for group in range(len(grids) - 1):
            own = sum(self.size(grid, level) for grid in range(grids[group], grids[group + 1]))
            if group > first and size + own > self._points:
                found.append(self._run(level, len(found), grids, tiles, first, group))
                first, size = group, 0
            size += own
        found.append(self._run(level, len(found), grids, tiles, first, len(grids) - 1))
        return tuple(found)

    @staticmethod
    def _run(level: int, number: int, grids: list[int], tiles: list[int], first: int, last: int) -> GridRun:
        return GridRun(level, number, range(tiles[first], tiles[last]), range(grids[first], grids[last]))
