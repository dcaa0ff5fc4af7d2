"""The rows, grids and tiles of each task, level by level: pure geometry of a layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

from ..grid.layout import Layout, tile_bounds

__all__ = ["CORE_POINTS", "Part", "Piece", "Pieces", "Rows"]

#: Levels of at most so many points are one piece, the core.
CORE_POINTS = 1 << 20


class Rows(NamedTuple):
    """Rows of a grid at a level, half-open."""

    grid: int
    start: int
    stop: int

    @property
    def height(self) -> int:
        """Number of rows."""
        return self.stop - self.start


class Part(NamedTuple):
    """What the tiles of a piece cover of a grid: rows of nodes, of the level below, and of details, half-open.

    Details are counted from the first one.
    """

    grid: int
    nodes: tuple[int, int]
    details: tuple[int, int]


@dataclass(frozen=True)
class Piece:
    """Neighbouring tiles of one level, and what they cover: a band of rows of a grid, or some whole grids.

    Attributes
    ----------
    level, number : int
        The level, and which of its pieces this is, from the first tile on.
    tiles : range
        Numbers of the tiles in the layout.
    parts : tuple of Part
        Of neighbouring grids, in their order.
    """

    level: int
    number: int
    tiles: range
    parts: tuple[Part, ...]


class Pieces:
    """The pieces of a layout. They decide about memory, not about bytes.

    The only grid of a layout is divided into bands of rows. Of several grids none is divided: the largest one says
    how much memory there must be.

    Parameters
    ----------
    layout : Layout
    points : int
        About so many points of its level make a piece, but at least one row of tiles, or one patch, or several small
        ones whose tiles are common.
    core_points : int
        Levels of at most so many points belong to the core.
    strips : sequence of (int, int), optional
        Rows of the only grid, half-open, whose samples are found together at the finest level; by default those of its
        pieces.

    Attributes
    ----------
    core : int
        The finest level of the core, which is one piece.
    has_strips : bool
        Whether strips are given.
    """

    def __init__(
        self,
        layout: Layout,
        points: int,
        core_points: int = CORE_POINTS,
        strips: Sequence[tuple[int, int]] | None = None,
    ) -> None:
        self.layout, self._points, self._strips = layout, points, strips
        self.has_strips = strips is not None
        self.core = max((level for level in range(layout.levels + 1) if layout.points(level) <= core_points), default=0)
        divided = self._bands if len(layout.grids) == 1 else self._runs
        self._levels = [divided(level) for level in self.levels]

    @property
    def levels(self) -> range:
        """The levels with pieces of their own, coarsest first."""
        return range(self.core + 1, self.layout.levels + 1)

    def of(self, level: int) -> tuple[Piece, ...]:
        """Return the pieces of a level finer than the core."""
        return self._levels[level - self.core - 1]

    @cached_property
    def core_tiles(self) -> range:
        """Numbers of the tiles of the core."""
        return range(self.layout.tiles_of(self.core).stop)

    def samples(self, level: int) -> list[tuple[Rows, ...]]:
        """Return the rows that each piece of a level's samples holds.

        Samples of the finest level are in strips, or as its pieces need them; those of the others are the nodes of the
        pieces of the next finer level.
        """
        layout = self.layout
        if level < layout.levels:
            return [tuple(Rows(part.grid, *part.nodes) for part in piece.parts) for piece in self.of(level + 1)]
        if self._strips is not None:
            return [(Rows(0, *strip),) for strip in self._strips]
        if level == self.core:
            return [tuple(Rows(grid, 0, layout.shape(grid, level)[0]) for grid in range(len(layout.grids)))]
        return [tuple(self._sampled(part, level) for part in piece.parts) for piece in self.of(level)]

    def _sampled(self, part: Part, level: int) -> Rows:
        """Return the samples beside the nodes of a part; each sample is in one part."""
        rows, coarse = self.layout.shape(part.grid, level)[0], self.layout.shape(part.grid, level - 1)[0]
        spacing = 2 if self.layout.steps(part.grid, level)[0].midpoints else 1
        start, stop = (rows if end == coarse else min(spacing * end, rows) for end in part.nodes)
        return Rows(part.grid, start, stop)

    def _bands(self, level: int) -> tuple[Piece, ...]:
        layout = self.layout
        (rows, columns), (fine, _) = layout.shape(0, level - 1), layout.shape(0, level)
        down, across = (tile_bounds(n, e) for n, e in zip((rows, columns), layout.tile, strict=True))
        width, first, details = len(across) - 1, layout.tiles_of(level).start, fine - rows
        area = down[-1] / (len(down) - 1) * layout.points(level) / rows  # points of a row of tiles
        height = max(1, round(self._points / area))
        bands = []
        for number, start in enumerate(range(0, len(down) - 1, height)):
            stop = min(start + height, len(down) - 1)
            nodes = down[start], down[stop]
            last = stop == len(down) - 1
            below = min(nodes[0], details), details if last else min(nodes[1], details)
            tiles = range(first + start * width, first + stop * width)
            bands.append(Piece(level, number, tiles, (Part(0, nodes, below),)))
        return tuple(bands)

    def _runs(self, level: int) -> tuple[Piece, ...]:
        grids, tiles = (ends.tolist() for ends in self.layout.tile_arrays.groups(level))
        runs: list[Piece] = []
        first, size = 0, 0
        for group in range(len(grids)):
            points = 0
            if group < len(grids) - 1:
                shapes = [self.layout.shape(grid, level) for grid in range(grids[group], grids[group + 1])]
                points = sum(rows * columns for rows, columns in shapes)
            if group == len(grids) - 1 or (group > first and size + points > self._points):
                parts = tuple(self._whole(grid, level) for grid in range(grids[first], grids[group]))
                runs.append(Piece(level, len(runs), range(tiles[first], tiles[group]), parts))
                first, size = group, 0
            size += points
        return tuple(runs)

    def _whole(self, grid: int, level: int) -> Part:
        rows, coarse = self.layout.shape(grid, level)[0], self.layout.shape(grid, level - 1)[0]
        return Part(grid, (0, coarse), (0, rows - coarse))
