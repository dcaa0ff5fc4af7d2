"""Which tiles and rows the bands of each level have: pure geometry of a surface of one grid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

from ..grid.layout import Layout, tile_bounds

__all__ = ["CORE_POINTS", "Band", "Bands"]

#: Levels of at most so many points are one piece, the core.
CORE_POINTS = 1 << 20


@dataclass(frozen=True)
class Band:
    """Neighbouring rows of tiles of one level.

    Attributes
    ----------
    level, number : int
        The level, and which of its bands this is, from the first row down.
    tiles : range
        Numbers of its tiles.
    nodes, details : (int, int)
        The rows of nodes, of the level below, and of details that its tiles cover, half-open; the latter counted from
        the first detail.
    """

    level: int
    number: int
    tiles: range
    nodes: tuple[int, int]
    details: tuple[int, int]


class Bands:
    """The bands of a layout of one grid.

    Parameters
    ----------
    layout : Layout
        Of one grid.
    points : int
        About so many points of its level make a band, but at least one row of tiles.
    core_points : int
        Levels of at most so many points belong to the core.

    Attributes
    ----------
    core : int
        The finest level of the core, which has no bands.
    """

    def __init__(self, layout: Layout, points: int, core_points: int = CORE_POINTS) -> None:
        if len(layout.grids) != 1:
            raise ValueError(f"expected a layout of one grid, got {len(layout.grids)}")
        self.layout, self._points = layout, points
        self.core = max((level for level in range(layout.levels + 1) if layout.points(level) <= core_points), default=0)
        self._levels = [self._bands(level) for level in range(self.core + 1, layout.levels + 1)]

    def of(self, level: int) -> tuple[Band, ...]:
        """The bands of a level finer than the core."""
        return self._levels[level - self.core - 1]

    @property
    def levels(self) -> range:
        """The levels that have bands, coarsest first."""
        return range(self.core + 1, self.layout.levels + 1)

    @cached_property
    def core_tiles(self) -> range:
        """Numbers of the tiles of the core."""
        return range(self.layout.tiles_of(self.core).stop)

    def samples(self, level: int) -> list[tuple[int, int]]:
        """The rows of each piece of a level's samples, half-open.

        Those of the finest level go with its bands, or are one piece where it belongs to the core; those of the others
        are the nodes of the next finer level's.
        """
        if level < self.layout.levels:
            return [band.nodes for band in self.of(level + 1)]
        rows = self.layout.shape(0, level)[0]
        if level == self.core:
            return [(0, rows)]
        each = 2 if self.layout.steps(0, level)[0].midpoints else 1
        ends = [min(each * band.nodes[1], rows) for band in self.of(level)]
        ends[-1] = rows
        return list(pairwise([0, *ends]))

    def _bands(self, level: int) -> tuple[Band, ...]:
        layout = self.layout
        (rows, columns), (fine, _) = layout.shape(0, level - 1), layout.shape(0, level)
        down, across = (tile_bounds(n, e) for n, e in zip((rows, columns), layout.tile, strict=True))
        width, first, details = len(across) - 1, layout.tiles_of(level).start, fine - rows
        area = down[-1] / (len(down) - 1) * layout.points(level) / rows  # points of a row of tiles
        each = max(1, round(self._points / area))
        found = []
        for number, start in enumerate(range(0, len(down) - 1, each)):
            stop = min(start + each, len(down) - 1)
            last = stop == len(down) - 1
            nodes = down[start], down[stop]
            own = min(nodes[0], details), details if last else min(nodes[1], details)
            found.append(Band(level, number, range(first + start * width, first + stop * width), nodes, own))
        return tuple(found)
