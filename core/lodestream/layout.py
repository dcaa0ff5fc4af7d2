"""Where the levels, bands and tiles of a surface lie: pure geometry, the same for writer and reader.

The coefficients of one channel fill an array of the surface's own shape. Level l occupies the first rows and columns
of it, as many as its grid has; a step splits that corner into the nodes of level l - 1 and up to three *bands* of
details around it, as is usual for wavelets. A *tile* is a piece of all bands of one level over the same part of the
surface; level 0 is one tile with one band.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from .axis import AxisStep, axis_lengths, axis_step
from .errors import InputError
from .surface import Closed

__all__ = ["Band", "Layout", "Tile", "tile_bounds"]


@dataclass(frozen=True)
class Band:
    """A tile's part of one band.

    Attributes
    ----------
    kind : (bool, bool)
        Whether it holds details along the rows' axis and along the columns' axis; (False, False) only at level 0.
    rows, columns : (int, int)
        First and past-the-last index in the array of coefficients.
    origin : (int, int)
        Index of the first coefficient within the whole band of its level.
    """

    kind: tuple[bool, bool]
    rows: tuple[int, int]
    columns: tuple[int, int]
    origin: tuple[int, int]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]


@dataclass(frozen=True)
class Tile:
    """A tile: its level, its place in the level's grid of tiles, its bands (none empty), its parent's number or -1."""

    level: int
    place: tuple[int, int]
    bands: tuple[Band, ...]
    parent: int


def tile_bounds(length: int, exponent: int) -> list[int]:
    """Where tiles of 2**exponent coefficients begin along an axis of so many nodes, and where the last one ends.

    The last tile takes what is left with it, up to half a tile.
    """
    size = 1 << exponent
    count = max(1, (length + size // 2 - 1) // size)
    return [size * i for i in range(count)] + [length]


class Layout:
    """Levels, bands and tiles of a grid.

    Parameters
    ----------
    shape : (rows, columns)
    closed : (bool, bool)
    tile : (int, int)
        Exponents of two of a tile's rows and columns, in coefficients of one band.
    """

    def __init__(self, shape: tuple[int, int], closed: Closed, tile: tuple[int, int]) -> None:
        if min(shape) < 1:
            raise InputError(f"expected a grid of at least one row and column, got {shape[0]} x {shape[1]}")
        self.shape, self.closed, self.tile = shape, closed, tile
        lengths = [axis_lengths(n, c) for n, c in zip(shape, closed, strict=True)]
        self.levels = max(map(len, lengths)) - 1
        for axis in lengths:
            axis[:0] = [axis[0]] * (self.levels + 1 - len(axis))
        self.shapes = list(zip(*lengths, strict=True))

    def steps(self, level: int) -> tuple[AxisStep, AxisStep]:
        """The steps along axis 0 and axis 1 from ``level`` (at least 1) to the level below."""
        rows, columns = self.shapes[level]
        return axis_step(rows, self.closed[0]), axis_step(columns, self.closed[1])

    @cached_property
    def tiles(self) -> tuple[Tile, ...]:
        """All tiles, coarsest level first, row by row."""
        rows, columns = self.shapes[0]
        tiles = [Tile(0, (0, 0), (Band((False, False), (0, rows), (0, columns), (0, 0)),), -1)]
        grids = {0: (0, 1, 1)}  # level -> number of its first tile, tiles down, tiles across
        for level in range(1, self.levels + 1):
            coarse, fine = self.shapes[level - 1], self.shapes[level]
            bounds = [tile_bounds(n, e) for n, e in zip(coarse, self.tile, strict=True)]
            down, across = (len(b) - 1 for b in bounds)
            grids[level] = len(tiles), down, across
            first, parents_down, parents_across = grids[level - 1]
            halves = [c != f for c, f in zip(*self.shapes[max(level - 2, 0) : level], strict=True)] if level > 1 else []
            for i in range(down):
                for j in range(across):
                    bands = self._bands(coarse, fine, bounds, (i, j))
                    parent = -1
                    if level > 1:
                        up = min(i >> halves[0], parents_down - 1), min(j >> halves[1], parents_across - 1)
                        parent = first + up[0] * parents_across + up[1]
                    tiles.append(Tile(level, (i, j), bands, parent))
        return tuple(tiles)

    @staticmethod
    def _bands(
        coarse: tuple[int, int], fine: tuple[int, int], bounds: list[list[int]], place: tuple[int, int]
    ) -> tuple[Band, ...]:
        bands = []
        for kind in ((False, True), (True, False), (True, True)):
            spans = []
            for axis in range(2):
                start, stop = bounds[axis][place[axis]], bounds[axis][place[axis] + 1]
                if kind[axis]:
                    details = fine[axis] - coarse[axis]
                    last = place[axis] == len(bounds[axis]) - 2
                    start, stop = min(start, details), details if last else min(stop, details)
                    spans.append((coarse[axis] + start, coarse[axis] + stop, start))
                else:
                    spans.append((start, stop, start))
            rows, columns = spans
            if rows[1] > rows[0] and columns[1] > columns[0]:
                bands.append(Band(kind, rows[:2], columns[:2], (rows[2], columns[2])))
        return tuple(bands)

    def tiles_of(self, level: int) -> range:
        """Numbers of the tiles of a level."""
        return self._tile_ranges[level]

    @cached_property
    def _tile_ranges(self) -> list[range]:
        numbers: list[list[int]] = [[] for _ in range(self.levels + 1)]
        for number, tile in enumerate(self.tiles):
            numbers[tile.level].append(number)
        return [range(found[0], found[-1] + 1) for found in numbers]
