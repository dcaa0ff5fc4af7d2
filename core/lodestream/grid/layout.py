"""Positions of the levels, bands and tiles of a surface: pure geometry, the same for encoder and decoder.

A surface is coded as one or more *grids*: the patches of its blocks, and the interfaces along which patches meet. The
coefficients of one channel of a grid fill an array of the grid's own shape. Level l occupies the first rows and
columns of it, as many as its grid has; a step splits that corner into the nodes of level l - 1 and up to three *bands*
of details around it, as is usual for wavelets. A *tile* is a rectangle of all bands of one level over the same place in
a grid, or all bands of a level of several small grids; level 0 of all grids is one tile.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface import Closed
from .axis import AxisStep, axis_lengths, axis_step
from .tile_arrays import BandArrays, TileArrays, runs_of

__all__ = ["REMEMBERED", "Band", "Grid", "Layout", "Source", "Tile", "tile_bounds"]

#: Entries of the caches of layouts and tables of tiles: the surface that is being processed needs its own repeatedly.
REMEMBERED = 4

Sides = tuple[bool, bool, bool, bool]
_NONE: Sides = (False, False, False, False)


class Source(NamedTuple):
    """The grid of an interface from which a side takes its points, in reverse order if ``reversed``.

    For an end of an interface: the first point of another interface, or its last one if ``reversed``.
    """

    grid: int
    reversed: bool


class Band(NamedTuple):
    """The part of one band that lies in a tile.

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

    ``whole`` are the bands of channels that take no points from interfaces.
    """

    level: int
    place: tuple[int, int]
    bands: tuple[Band, ...]
    whole: tuple[Band, ...]
    parent: int


def tile_bounds(length: int, exponent: int) -> list[int]:
    """Return the starts of tiles of 2**exponent coefficients along an axis of ``length`` nodes, and the last end.

    The last tile includes the remainder, up to half a tile.
    """
    size = 1 << exponent
    count = max(1, (length + size // 2 - 1) // size)
    return [size * i for i in range(count)] + [length]


@dataclass(frozen=True)
class Grid:
    """A grid that is coarsened by itself: a patch of a block, or an interface of one column.

    Attributes
    ----------
    shape : (rows, columns)
    closed : (bool, bool)
    clamped : four bool
        First row, last row, first column, last column: whether the node at that end of an axis keeps its value.
    stops : (bool, bool)
        The axis is not coarsened further once its length is even.
    sources : four Source or None
        For the same sides: where their points come from in channels of coordinates. No tile holds these points.
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
        """Return the shape ``above`` levels below the grid itself; an axis that has stopped keeps its length."""
        rows, columns = (axis[max(len(axis) - 1 - above, 0)] for axis in self.lengths)
        return rows, columns

    def steps_at(self, above: int) -> tuple[AxisStep, AxisStep]:
        """Return the steps along axis 0 and axis 1 from the level that is ``above`` levels below the grid itself."""
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
        Binary logarithms of a tile's rows and columns, in coefficients of one band.
    levels : int, optional
        The finest level, at least that of the grids; by default that of the grids.
    """

    def __init__(self, grids: Sequence[Grid], tile: tuple[int, int], levels: int | None = None) -> None:
        for grid in grids:
            if min(grid.shape) < 1:
                raise InputError(f"expected at least one row and column, got {grid.shape[0]} x {grid.shape[1]}")
        self.grids, self.tile = tuple(grids), tile
        self.levels = max(len(axis) for grid in grids for axis in grid.lengths) - 1 if levels is None else levels
        self.shared = any(any(grid.taken) for grid in grids)
        above = range(self.levels, -1, -1)
        self._shapes = [[grid.shape_at(level) for level in above] for grid in grids]
        self._steps = [[grid.steps_at(level) for level in above] for grid in grids]

    @staticmethod
    @lru_cache(maxsize=REMEMBERED)
    def single(shape: tuple[int, int], closed: Closed, tile: tuple[int, int]) -> Layout:
        """Return the layout of one block that shares no side."""
        return Layout([Grid(shape, closed)], tile)

    @staticmethod
    @lru_cache(maxsize=REMEMBERED)
    def of(grids: tuple[Grid, ...], tile: tuple[int, int]) -> Layout:
        """Return the layout of some grids."""
        return Layout(grids, tile)

    def part(self, patches: Sequence[int]) -> tuple[Layout, list[int]]:
        """Return the layout of some patches and the interfaces that they need, and its grids' numbers in this one.

        ``patches`` are numbers of grids, and come last. The levels are those of this layout; tiles are numbered anew.
        """
        needed: set[int] = set()
        waiting = list(patches)
        while waiting:
            new = {source.grid for source in self.grids[waiting.pop()].sources if source is not None} - needed
            needed |= new
            waiting += new
        chosen = [*sorted(needed), *patches]
        number_in_part = {number: place for place, number in enumerate(chosen)}
        grids = []
        for number in chosen:
            first, last, left, right = (
                None if source is None else source._replace(grid=number_in_part[source.grid])
                for source in self.grids[number].sources
            )
            grids.append(replace(self.grids[number], sources=(first, last, left, right)))
        return Layout(grids, self.tile, self.levels), chosen

    def shape(self, grid: int, level: int) -> tuple[int, int]:
        """Return rows and columns of a grid at a level."""
        return self._shapes[grid][level]

    def steps(self, grid: int, level: int) -> tuple[AxisStep, AxisStep]:
        """Return the steps along axis 0 and axis 1 of a grid from ``level`` (at least 1) to the level below."""
        return self._steps[grid][level]

    @cached_property
    def tile_arrays(self) -> TileArrays:
        """Levels, places, parents and bands of any tiles as arrays."""
        return TileArrays(self.grids, np.array(self._shapes, np.int64).transpose(1, 0, 2), self.tile)

    @property
    def tiles(self) -> Sequence[Tile]:
        """All tiles, coarsest level first, then group by group (interfaces first), row by row.

        Tiles are computed on access. Code that works on many tiles uses `tile_levels`, `parents` or `tile_arrays`.
        """
        return _Tiles(self)

    def level_of(self, tile: int) -> int:
        """Return the level of a tile."""
        return bisect_right(self._starts, tile) - 1

    def tiles_of(self, level: int) -> range:
        """Return the numbers of the tiles of a level."""
        return range(self._starts[level], self._starts[level + 1])

    @cached_property
    def tile_levels(self) -> NDArray[np.uint8]:
        """The level of each tile, uint8, shape (tile,)."""
        return np.repeat(np.arange(self.levels + 1, dtype=np.uint8), np.diff(self.tile_arrays.starts))

    @cached_property
    def parents(self) -> NDArray[np.int64]:
        """The number of each tile's parent, -1 where it has none; int64, shape (tile,)."""
        arrays = self.tile_arrays
        return np.concatenate([arrays.parents(np.arange(run.start, run.stop)) for run in runs_of(arrays.count)])

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """The first tile of each level, int64, shape (level,)."""
        return self.tile_arrays.starts[:-1]

    def points(self, level: int) -> int:
        """Return the number of points of all grids at a level."""
        return sum(rows * columns for rows, columns in (shapes[level] for shapes in self._shapes))

    def tiles_from(self, level: int) -> int:
        """Return the first tile of a level; the number of tiles where there is none, as for level 0."""
        return self._starts[level] if 0 < level <= self.levels else self._starts[-1]

    @cached_property
    def _starts(self) -> list[int]:
        """The first tile of each level, and the number of tiles."""
        starts: list[int] = self.tile_arrays.starts.tolist()
        return starts


class _Tiles(Sequence[Tile]):
    """The tiles of a layout, computed on access."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout

    def __len__(self) -> int:
        return self._layout.tile_arrays.count

    @overload
    def __getitem__(self, number: int) -> Tile: ...

    @overload
    def __getitem__(self, number: slice) -> Sequence[Tile]: ...

    def __getitem__(self, number: int | slice) -> Tile | Sequence[Tile]:
        chosen = range(len(self))[number]
        return tuple(self._tiles(chosen)) if isinstance(chosen, range) else next(self._tiles(range(chosen, chosen + 1)))

    def __iter__(self) -> Iterator[Tile]:
        for run in runs_of(len(self)):
            yield from self._tiles(run)

    def _tiles(self, numbers: range) -> Iterator[Tile]:
        """Yield the tiles of these numbers."""
        tiles, arrays = np.arange(numbers.start, numbers.stop, numbers.step), self._layout.tile_arrays
        bands = _bands(arrays.bands(tiles, True), len(tiles))
        whole = _bands(arrays.bands(tiles, False), len(tiles)) if self._layout.shared else bands
        columns = arrays.levels(tiles), arrays.places(tiles), arrays.parents(tiles)
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for (level, (row, column), parent), tile_bands, whole_bands in zip(rows, bands, whole, strict=True):
            yield Tile(level, (row, column), tile_bands, whole_bands, parent)


def _bands(arrays: BandArrays, count: int) -> list[tuple[Band, ...]]:
    """Return the bands of each of ``count`` tiles."""
    bands: list[list[Band]] = [[] for _ in range(count)]
    for tile, _, grid, kind, start, shape, origin, _ in zip(*(of.tolist() for of in arrays), strict=True):
        rows, columns = ((first, first + length) for first, length in zip(start, shape, strict=True))
        bands[tile].append(Band((kind > 1, kind % 2 == 1), rows, columns, tuple(origin), grid))
    return [tuple(tile_bands) for tile_bands in bands]
