"""Tiles and bands of a layout by arithmetic: arrays for any requested tiles, nothing stored for each tile.

All tiles of a grid's level are alike except those at its ends. So level, grid and place of a tile follow from its
number, and its bands and its parent from these.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["AT_ONCE", "BandArrays", "TileArrays", "runs_of"]

#: Tiles whose arrays are computed together in a loop over all tiles.
AT_ONCE = 1 << 12

#: The three bands of a tile above level 0: whether they hold details along the rows' axis, and along the columns' axis.
_DOWN, _ACROSS = np.array([0, 1, 1]), np.array([1, 0, 1])

Ints = NDArray[np.int64]


class _Grid(Protocol):
    """The properties of a grid that matter here, see `layout.Grid`."""

    @property
    def taken(self) -> tuple[bool, bool, bool, bool]: ...

    @property
    def interface(self) -> bool: ...


class BandArrays(NamedTuple):
    """The bands of some tiles, tile by tile, in a tile by grid and kind; none is empty.

    Attributes
    ----------
    tile : int64, shape (band,)
        Index of the tile in the request, from 0.
    level, grid : int64, shape (band,)
    kind : int64, shape (band,)
        1 for details along the columns' axis plus 2 for details along the rows' axis.
    start, shape : int64, shape (band, axis)
        First row and column in the array of coefficients; rows and columns.
    origin : int64, shape (band, axis)
        Row and column of the first coefficient within the whole band of its level.
    halved : int64, shape (band, axis)
        1 where the axis steps from the level below to the one below that.
    """

    tile: Ints
    level: Ints
    grid: Ints
    kind: Ints
    start: Ints
    shape: Ints
    origin: Ints
    halved: Ints


class TileArrays:
    """Levels, places, parents and bands of tiles, by their numbers.

    Parameters
    ----------
    grids : sequence of `layout.Grid`
    shapes : int64, shape (level, grid, axis)
        Rows and columns of each grid at each level.
    exponents : (int, int)
        Binary logarithms of a tile's rows and columns, in coefficients of one band.

    Attributes
    ----------
    count : int
        Tiles.
    starts : int64, shape (level + 1,)
        The first tile of each level, and ``count``.
    """

    def __init__(self, grids: Sequence[_Grid], shapes: Ints, exponents: tuple[int, int]) -> None:
        # Arrays below have one entry for each level and grid, level by level, or one for each group of grids whose
        # tiles are common: neighbours of a level.
        levels, self._grids, _ = shapes.shape
        coarse = np.concatenate([shapes[:1], shapes[:-1]])
        self._halved = np.concatenate([np.zeros_like(coarse[:1]), coarse[1:] != coarse[:-1]]).reshape(-1, 2)
        self._details = (shapes - coarse).reshape(-1, 2)
        self._coarse = coarse.reshape(-1, 2)
        self._taken = np.array([grid.taken for grid in grids])
        self._interface = np.array([grid.interface for grid in grids])
        self._size = np.array([1 << exponent for exponent in exponents])
        leads = _leads(self._interface, shapes, exponents).ravel()
        self._leader = np.flatnonzero(leads)
        self._members = np.concatenate([self._leader[1:], [leads.size]]) - self._leader
        self._group = np.cumsum(leads) - 1
        cut = (self._members[self._group] == 1).reshape(levels, -1) & ~self._interface
        cut[0] = False  # level 0 is one tile
        # The last tile includes the remainder, up to half a tile.
        down_across = np.maximum((self._coarse + self._size // 2 - 1) // self._size, 1)
        self._counts = np.where(cut.reshape(-1, 1), down_across, 1)
        ends = np.cumsum(self._counts[self._leader].prod(axis=1))
        self._first = np.concatenate([[0], ends[:-1]])
        self.count = int(ends[-1])
        self.starts = np.concatenate([self._first[self._group[:: self._grids]], ends[-1:]])

    def levels(self, tiles: Ints) -> Ints:
        """Return the level of each tile, int64, shape (tile,)."""
        return self.starts.searchsorted(tiles, side="right") - 1

    def groups(self, level: int) -> tuple[Ints, Ints]:
        """Return the grids and tiles of a level by groups of grids that share tiles, int64, shape (group + 1,) each.

        The first grid and the first tile of each group, then how many grids there are and where the next level begins.
        """
        first, last = self._group[[level * self._grids, (level + 1) * self._grids - 1]]
        groups = np.arange(first, last + 1)
        grids = self._leader[groups] - level * self._grids
        return np.append(grids, self._grids), np.append(self._first[groups], self.starts[level + 1])

    def places(self, tiles: Ints) -> Ints:
        """Return row and column of each tile among those of its level and grid, int64, shape (tile, axis)."""
        return self._located(tiles)[1]

    def parents(self, tiles: Ints) -> Ints:
        """Return the number of each tile's parent, -1 where it has none; int64, shape (tile,)."""
        leader, place = self._located(tiles)
        above = leader - self._grids
        # Because the last tile includes the remainder, a level may have one tile fewer than twice those of the level
        # below, or one more, which then also has the last parent.
        up = np.minimum(place >> self._halved[leader], self._counts[above] - 1)
        parent = self._first[self._group[above]] + up[:, 0] * self._counts[above, 1] + up[:, 1]
        return np.where(leader >= 2 * self._grids, parent, -1)

    def bands(self, tiles: Ints, coordinate: bool) -> BandArrays:
        """Return the bands of tiles in channels of coordinates, or in channels that take no points from interfaces.

        ``tiles`` are numbers, int64, shape (tile,). Without ``coordinate``, interfaces have no bands.
        """
        leader, place = self._located(tiles)
        number = np.arange(len(tiles))
        pair = leader
        if self._grids > 1:
            members = self._members[self._group[leader]]
            number, place = np.repeat(number, members), np.repeat(place, members, axis=0)
            begins = np.cumsum(members) - members
            pair = np.repeat(leader - begins, members) + np.arange(len(number))
        grid = pair % self._grids
        rows, columns = (self._spans(pair, grid, place[:, axis], axis, coordinate) for axis in range(2))
        # Level 0 has nodes in place of details along the columns' axis, and no others.
        lowest = pair < self._grids
        columns[:, 1, lowest] = columns[:, 0, lowest]
        kept = (rows[0, _DOWN] > 0) & (columns[0, _ACROSS] > 0)
        if not coordinate:
            kept &= ~self._interface[grid]
        cell, slot = kept.T.nonzero()
        extents = np.array([rows[:, _DOWN[slot], cell], columns[:, _ACROSS[slot], cell]])
        shape, start, origin = extents.transpose(1, 2, 0)
        pair = pair[cell]
        kind = np.where(lowest[cell], 0, slot + 1)
        return BandArrays(number[cell], pair // self._grids, grid[cell], kind, start, shape, origin, self._halved[pair])

    def _located(self, tiles: Ints) -> tuple[Ints, Ints]:
        """Return for each tile level and first grid as one number, and its place, shape (tile, axis)."""
        group = self._first.searchsorted(tiles, side="right") - 1
        leader = self._leader[group]
        return leader, np.array(np.divmod(tiles - self._first[group], self._counts[leader, 1])).T

    def _spans(self, pair: Ints, grid: Ints, place: Ints, axis: int, coordinate: bool) -> Ints:
        """Return length, start, and start within the whole band of the tiles' nodes and details along an axis.

        Shape (3, 2, tile and grid).
        """
        coarse, details = self._coarse[pair, axis], self._details[pair, axis]
        last = place == self._counts[pair, axis] - 1
        start = place * self._size[axis]
        stop = np.where(last, coarse, start + self._size[axis])
        # There are up to two details fewer than nodes, as many where an axis wraps, and none on a stopped axis.
        first = np.minimum(start, details)
        count = np.where(last, details, np.minimum(stop, details)) - first
        if coordinate:
            # A side that comes from an interface is coded there: the first and the last band omit its nodes.
            start = start + (self._taken[grid, 2 * axis] & (place == 0))
            stop = stop - (self._taken[grid, 2 * axis + 1] & last)
        return np.array([[stop - start, count], [start, coarse + first], [start, first]])


def runs_of(count: int) -> Iterator[range]:
    """Yield the numbers below ``count`` in runs of `AT_ONCE`."""
    for start in range(0, count, AT_ONCE):
        yield range(start, min(start + AT_ONCE, count))


def _leads(interface: NDArray[np.bool_], shapes: Ints, exponents: tuple[int, int]) -> NDArray[np.bool_]:
    """Find the grids that are the first of a group that shares tiles, bool, shape (level, grid).

    All interfaces form a group, and so do neighbouring patches that are small at the level. Grids that share a tile
    also share one at the coarser levels; level 0 of all grids is one tile.
    """
    levels, grids, _ = shapes.shape
    most = 4 << sum(exponents)  # points of a tile's three bands, and of the nodes under them
    leads = np.zeros((levels, grids), np.bool_)
    groups = [(number, number + 1) for number in range(grids)]
    for level in range(levels - 1, 0, -1):
        points = np.concatenate([[0], np.cumsum(shapes[level].prod(axis=1))]).tolist()
        merged: list[tuple[int, int]] = []
        size = 0
        for start, stop in groups:
            group_size = points[stop] - points[start]
            joins = merged and interface[start] == interface[merged[-1][0]]
            if joins and (interface[start] or size + group_size <= most):
                merged[-1] = merged[-1][0], stop
                size += group_size
            else:
                merged.append((start, stop))
                size = group_size
        groups = merged
        leads[level, [start for start, _ in groups]] = True
    leads[0, 0] = True
    return leads
