"""Which coefficients a unit has, and which are their parents: section 5 of docs/format.md."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .levels import Grid


@dataclass(frozen=True)
class Share:
    """What a tile has of one subband.

    `grid` (int): number of the grid; `kind` ((int, int)): whether the band has details along axis 0 and along axis 1;
    `rows`, `columns` (slice): where it lies in the grid's array of coefficients; `origin` ((int, int)): its first row
    and column in the whole band, nodes that are left out counted.
    """

    grid: int
    kind: tuple[int, int]
    rows: slice
    columns: slice
    origin: tuple[int, int]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of coefficients."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start


@dataclass(frozen=True)
class Tile:
    """One tile.

    `level` (int): its level; `parent` (int): number of its parent tile; -1 where all parents are 0; `shares` ((list of
    Share, list of Share)): those of a coordinate's unit and those of an attribute's.
    """

    level: int
    parent: int
    shares: tuple[list[Share], list[Share]]


def groups_of(grids: list[Grid], points: int) -> list[list[list[int]]]:
    """Give the groups of grids of the levels 0 to L; `points` is the most that several patches may have together."""
    above = [[number] for number in range(len(grids))]
    found = []
    for level in range(len(grids[0].axes) - 1, 0, -1):
        size = [int(np.prod(grid.shape(level), dtype=object)) for grid in grids]
        groups: list[list[int]] = []
        for group in above:
            if groups and grids[group[0]].interface == grids[groups[-1][0]].interface:
                joined = groups[-1] + group
                if grids[group[0]].interface or sum(size[number] for number in joined) <= points:
                    groups[-1] = joined
                    continue
            groups.append(group)
        found.append(groups)
        above = groups
    return [[list(range(len(grids)))], *found[::-1]]


def tiles_of(grids: list[Grid], tile: tuple[int, int]) -> list[Tile]:
    """Divide all levels into tiles of 2^t0 rows and 2^t1 columns, (t0, t1) = `tile`."""
    whole = [(0, 1 << 62)]
    tiles = [Tile(0, -1, _shares(grids, range(len(grids)), 0, (0, 1 << 62), (0, 1 << 62)))]
    place: dict[tuple[int, int], tuple[int, int, int]] = {}
    for level, groups in enumerate(groups_of(grids, 1 << (sum(tile) + 2))):
        for group in groups if level else []:
            cuts = [whole, whole]
            if len(group) == 1 and not grids[group[0]].interface:
                nodes = grids[group[0]].shape(level - 1)
                cuts = [_cut(nodes[axis], 1 << tile[axis]) for axis in (0, 1)]
            for number in group:
                place[level, number] = (len(tiles), len(cuts[0]), len(cuts[1]))
            for i, rows in enumerate(cuts[0]):
                for j, columns in enumerate(cuts[1]):
                    parent = -1
                    if level > 1:
                        first, down, across = place[level - 1, group[0]]
                        s = [grids[group[0]].stepped(level - 1, axis) for axis in (0, 1)]
                        parent = first + min(i >> s[0], down - 1) * across + min(j >> s[1], across - 1)
                    tiles.append(Tile(level, parent, _shares(grids, group, level, rows, columns)))
    return tiles


def _cut(nodes: int, size: int) -> list[tuple[int, int]]:
    count = max(1, (nodes + size // 2 - 1) // size)
    ends = [*range(0, count * size, size), 1 << 62]
    return list(pairwise(ends))


def _shares(
    grids: list[Grid], group: range | list[int], level: int, rows: tuple[int, int], columns: tuple[int, int]
) -> tuple[list[Share], list[Share]]:
    """Cut nodes and details of `rows` and `columns`, first and behind the last, out of the bands of a group's grids."""
    found: tuple[list[Share], list[Share]] = ([], [])
    for attribute, shares in enumerate(found):
        for number in group:
            grid = grids[number]
            if attribute and grid.interface:
                continue
            for kind in ((0, 1), (1, 0), (1, 1)) if level else ((0, 0),):
                spans = []
                for axis, (first, end) in enumerate((rows, columns)):
                    nodes = grid.shape(max(level - 1, 0))[axis]
                    if kind[axis]:
                        low, high, base = 0, grid.shape(level)[axis] - nodes, nodes
                    else:
                        low, high = (0, nodes) if attribute else grid.kept(level, axis)
                        base = 0
                    low, high = max(low, first), min(high, end)
                    spans.append((low, slice(base + low, base + high)))
                (top, down), (left, across) = spans
                if down.start < down.stop and across.start < across.stop:
                    shares.append(Share(number, kind, down, across, (top, left)))
    return found


class Parents:
    """The parents of a share's coefficients.

    `grid` (Grid): the share's grid; `level` (int): the share's level, at least 2; `share`, `above` (Share): of the
    unit, and of its parent: the same band of the same grid, a level below.
    """

    def __init__(self, grid: Grid, level: int, share: Share, above: Share) -> None:
        self.index = []
        for axis in (0, 1):
            s = int(grid.stepped(level - 1, axis))
            first = ((share.origin[axis] + s) >> s) - above.origin[axis]
            row = first + (np.arange(share.shape[axis]) >> s)
            self.index.append(np.clip(row, -2, above.shape[axis] + 1) + 2)

    def look(self, magnitude: NDArray[np.int32], plane: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Read the parents at a plane.

        `magnitude` (int32 (rows, columns)): of the parent's share; `plane` (int): the plane of the pass. Returns
        `part` (int32 (rows, columns)): the parents' part of section 7.4, for each coefficient of the share; `parent`
        (int32 (rows, columns)): the parents' magnitudes, shifted right by the plane.
        """
        near = np.pad(magnitude >> plane, 2)
        part = 3 * np.minimum(near, 4)
        around = near[1:-1, :-2] + near[1:-1, 2:] + near[:-2, 1:-1] + near[2:, 1:-1]
        part[1:-1, 1:-1] += np.minimum(around, 12)
        place = np.ix_(*self.index)
        return part[place], near[place]
