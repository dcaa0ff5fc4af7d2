"""Where the levels, bands and tiles of a surface lie: pure geometry, the same for writer and reader.

A surface is coded as one or more *grids*: the patches of its blocks, and the interfaces along which patches meet. The
coefficients of one channel of a grid fill an array of the grid's own shape. Level l occupies the first rows and
columns of it, as many as its grid has; a step splits that corner into the nodes of level l - 1 and up to three *bands*
of details around it, as is usual for wavelets. A *tile* is a rectangle of all bands of one level over the same place in
a grid, or all bands of a level of several small grids; level 0 of all grids is one tile.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface import Closed
from .axis import AxisStep, axis_lengths, axis_step

__all__ = ["REMEMBERED", "Band", "Grid", "Layout", "Source", "Tile", "tile_bounds"]

#: Layouts, and tables of their tiles, that are remembered: that of a surface in hand is asked for again and again.
REMEMBERED = 4

Sides = tuple[bool, bool, bool, bool]
_NONE: Sides = (False, False, False, False)


class Source(NamedTuple):
    """Where a side's points come from: the grid of an interface, perhaps backwards.

    Of an interface's end: another interface's first point, or its last one if ``reversed``.
    """

    grid: int
    reversed: bool


class Band(NamedTuple):
    """A tile's part of one band.

    Attributes
    ----------
    kind : (bool, bool)
        Whether it holds details along the rows' axis and along the columns' axis; (False, False) only at level 0.
    rows, columns : (int, int)
        First and past-the-last index in the array of coefficients.
    origin : (int, int)
        Index of the first coefficient within the whole band of its level.
    grid : int
        Number of the grid in the layout.
    """

    kind: tuple[bool, bool]
    rows: tuple[int, int]
    columns: tuple[int, int]
    origin: tuple[int, int]
    grid: int = 0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]


class Tile(NamedTuple):
    """A tile: its level, its place in the level's grid of tiles, its bands (none empty), its parent's number or -1.

    ``whole`` are the bands of channels that take nothing from interfaces.
    """

    level: int
    place: tuple[int, int]
    bands: tuple[Band, ...]
    whole: tuple[Band, ...]
    parent: int


def tile_bounds(length: int, exponent: int) -> list[int]:
    """Where tiles of 2**exponent coefficients begin along an axis of so many nodes, and where the last one ends.

    The last tile takes what is left with it, up to half a tile.
    """
    size = 1 << exponent
    count = max(1, (length + size // 2 - 1) // size)
    return [size * i for i in range(count)] + [length]


@dataclass(frozen=True)
class Grid:
    """What is coarsened by itself: a patch of a block, or an interface of one column.

    Attributes
    ----------
    shape : (rows, columns)
    closed : (bool, bool)
    clamped : four bool
        First row, last row, first column, last column: that end of an axis keeps its node as it is.
    stops : (bool, bool)
        The axis is not coarsened further once its length is even.
    sources : four Source or None
        Of the same sides: where their points come from, as far as the channel is a coordinate. No tile holds those.
    interface : bool
    """

    shape: tuple[int, int]
    closed: Closed = (False, False)
    clamped: Sides = _NONE
    stops: tuple[bool, bool] = (False, False)
    sources: tuple[Source | None, Source | None, Source | None, Source | None] = (None, None, None, None)
    interface: bool = False

    @property
    def taken(self) -> Sides:
        """Which sides have a source."""
        first, last, left, right = (source is not None for source in self.sources)
        return first, last, left, right

    @cached_property
    def lengths(self) -> tuple[list[int], list[int]]:
        """Lengths of both axes at every level until they stop, coarsest first."""
        rows, columns = (axis_lengths(*axis) for axis in zip(self.shape, self.closed, self.stops, strict=True))
        return rows, columns

    def shape_at(self, above: int) -> tuple[int, int]:
        """The shape so many levels below the grid itself; an axis that has stopped stays."""
        rows, columns = (axis[max(len(axis) - 1 - above, 0)] for axis in self.lengths)
        return rows, columns

    def steps_at(self, above: int) -> tuple[AxisStep, AxisStep]:
        """The steps along axis 0 and axis 1 down from the level that is so many levels below the grid itself."""
        shape, ends = self.shape_at(above), (self.clamped[:2], self.clamped[2:])
        rows, columns = (axis_step(*a) for a in zip(shape, self.closed, ends, self.stops, strict=True))
        return rows, columns


class Layout:
    """Levels, bands and tiles of a surface.

    Parameters
    ----------
    grids : sequence of Grid
        Interfaces first. A surface of one block that shares no side is one grid.
    tile : (int, int)
        Exponents of two of a tile's rows and columns, in coefficients of one band.
    """

    def __init__(self, grids: Sequence[Grid], tile: tuple[int, int]) -> None:
        for grid in grids:
            if min(grid.shape) < 1:
                raise InputError(f"expected at least one row and column, got {grid.shape[0]} x {grid.shape[1]}")
        self.grids, self.tile = tuple(grids), tile
        self.levels = max(len(axis) for grid in grids for axis in grid.lengths) - 1
        self.shared = any(any(grid.taken) for grid in grids)
        above = range(self.levels, -1, -1)
        self._shapes = [[grid.shape_at(level) for level in above] for grid in grids]
        self._steps = [[grid.steps_at(level) for level in above] for grid in grids]

    @staticmethod
    @lru_cache(maxsize=REMEMBERED)
    def single(shape: tuple[int, int], closed: Closed, tile: tuple[int, int]) -> Layout:
        """The layout of one block that shares no side."""
        return Layout([Grid(shape, closed)], tile)

    @staticmethod
    @lru_cache(maxsize=REMEMBERED)
    def of(grids: tuple[Grid, ...], tile: tuple[int, int]) -> Layout:
        """The layout of some grids."""
        return Layout(grids, tile)

    def shape(self, grid: int, level: int) -> tuple[int, int]:
        """Rows and columns of a grid at a level."""
        return self._shapes[grid][level]

    def steps(self, grid: int, level: int) -> tuple[AxisStep, AxisStep]:
        """The steps along axis 0 and axis 1 of a grid from ``level`` (at least 1) to the level below."""
        return self._steps[grid][level]

    @cached_property
    def tiles(self) -> tuple[Tile, ...]:
        """All tiles, coarsest level first, then group by group (interfaces first), row by row."""
        every = range(len(self.grids))
        tiles = [Tile(0, (0, 0), *self._members(every, 0), -1)]
        parents: dict[int, tuple[int, int, int]] = {}  # grid -> number of its first tile, tiles down, tiles across
        groups = self._groups()
        for level in range(1, self.levels + 1):
            found = {}
            for group in groups[level]:
                first, bounds = len(tiles), self._bounds(group, level)
                down, across = (len(b) - 1 for b in bounds)
                before, parents_down, parents_across = parents.get(group[0], (0, 1, 1))
                halves = self._halves(group[0], level) if len(group) == 1 else (0, 0)
                for i in range(down):
                    for j in range(across):
                        parent = -1
                        if level > 1:
                            # The last tile takes what is left, so a level may have one tile fewer than twice those
                            # below it, or one more: that one has the last parent too.
                            up = min(i >> halves[0], parents_down - 1), min(j >> halves[1], parents_across - 1)
                            parent = before + up[0] * parents_across + up[1]
                        members = self._members(group, level, bounds, (i, j))
                        tiles.append(Tile(level, (i, j), *members, parent))
                found.update(dict.fromkeys(group, (first, down, across)))
            parents = found
        return tuple(tiles)

    def _groups(self) -> list[list[list[int]]]:
        """For each level the grids whose tiles are common: all interfaces, and neighbouring patches small there.

        Grids that have a tile in common have one at the coarser levels too.
        """
        groups = [[number] for number in range(len(self.grids))]
        most = 4 << sum(self.tile)  # points of a tile's three bands, and of the nodes under them
        levels = [groups]
        for level in range(self.levels, 0, -1):
            merged: list[list[int]] = []
            size = 0
            for group in groups:
                shapes = [self.shape(number, level) for number in group]
                points = sum(rows * columns for rows, columns in shapes)
                joins = merged and self.grids[group[0]].interface == self.grids[merged[-1][0]].interface
                if joins and (self.grids[group[0]].interface or size + points <= most):
                    merged[-1] = merged[-1] + group
                    size += points
                else:
                    merged.append(group)
                    size = points
            groups = merged
            levels.append(groups)
        levels.append([])  # of level 0, whose only tile is everybody's
        return levels[:0:-1]

    def _halves(self, grid: int, level: int) -> tuple[int, int]:
        """For each axis 1 if it steps from the level below to the one below that."""
        if level < 2:
            return 0, 0
        finer, coarser = self.shape(grid, level - 1), self.shape(grid, level - 2)
        return int(finer[0] != coarser[0]), int(finer[1] != coarser[1])

    def _bounds(self, group: list[int], level: int) -> tuple[list[int], list[int]]:
        coarse = self.shape(group[0], level - 1)
        if len(group) > 1 or self.grids[group[0]].interface:
            return [0, coarse[0]], [0, coarse[1]]  # one tile, of which only the number of bounds matters
        return tile_bounds(coarse[0], self.tile[0]), tile_bounds(coarse[1], self.tile[1])

    def _members(
        self,
        group: Sequence[int],
        level: int,
        bounds: tuple[list[int], list[int]] | None = None,
        place: tuple[int, int] = (0, 0),
    ) -> tuple[tuple[Band, ...], tuple[Band, ...]]:
        """The tile's bands of coordinates, and of channels that take nothing from interfaces and have none."""
        bands: list[Band] = []
        whole: list[Band] = []
        for number in group:
            grid = self.grids[number]
            coarse = self.shape(number, level - 1) if level else self.shape(number, 0)
            own = bounds if bounds and len(group) == 1 else ([0, coarse[0]], [0, coarse[1]])
            bands += self._bands(number, level, own, place, grid.taken)
            if self.shared and not grid.interface:
                whole += self._bands(number, level, own, place, _NONE)
        coordinate = tuple(bands)
        return coordinate, tuple(whole) if self.shared else coordinate

    def _bands(
        self, number: int, level: int, bounds: tuple[list[int], list[int]], place: tuple[int, int], taken: Sides
    ) -> list[Band]:
        fine = self.shape(number, level)
        coarse = self.shape(number, level - 1) if level else fine
        kinds = ((False, True), (True, False), (True, True)) if level else ((False, False),)
        spans = []  # of either axis: its nodes and its details, and where they begin within the whole band
        for axis in range(2):
            start, stop = bounds[axis][place[axis]], bounds[axis][place[axis] + 1]
            last = place[axis] == len(bounds[axis]) - 2
            # A side that comes from an interface is coded there: the first and the last band leave its nodes out.
            first = start + (taken[2 * axis] and place[axis] == 0)
            nodes = (first, stop - (taken[2 * axis + 1] and last)), first
            details = fine[axis] - coarse[axis]
            # There are up to two details fewer than nodes, and as many where an axis wraps; those of a stopped axis: 0.
            start, stop = min(start, details), details if last else min(stop, details)
            spans.append((nodes, ((coarse[axis] + start, coarse[axis] + stop), start)))
        bands = []
        for kind in kinds:
            (rows, top), (columns, left) = spans[0][kind[0]], spans[1][kind[1]]
            if rows[1] > rows[0] and columns[1] > columns[0]:
                bands.append(Band(kind, rows, columns, (top, left), number))
        return bands

    def tiles_of(self, level: int) -> range:
        """Numbers of the tiles of a level."""
        return self._tile_ranges[level]

    @cached_property
    def parents(self) -> list[int]:
        """The number of each tile's parent, -1 where it has none."""
        return [tile.parent for tile in self.tiles]

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """The first tile of each level, int64, shape (level,)."""
        return np.array([own.start for own in self._tile_ranges])

    def points(self, level: int) -> int:
        """Of all grids at a level."""
        return sum(rows * columns for rows, columns in (shapes[level] for shapes in self._shapes))

    def tiles_from(self, level: int) -> int:
        """The first tile of a level; the number of tiles where there is none, as for level 0."""
        return self.tiles_of(level).start if 0 < level <= self.levels else len(self.tiles)

    @cached_property
    def _tile_ranges(self) -> list[range]:
        numbers: list[list[int]] = [[] for _ in range(self.levels + 1)]
        for number, tile in enumerate(self.tiles):
            numbers[tile.level].append(number)
        return [range(found[0], found[-1] + 1) for found in numbers]
