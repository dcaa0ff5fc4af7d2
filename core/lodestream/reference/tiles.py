"""Section 5 of docs/format.md: tiles and their parents, and the units of which the file is made."""

from __future__ import annotations

from itertools import pairwise, product

from .header import Header
from .levels import GridLevels, Levels
from .passes import Band, Unit

__all__ = ["units_of"]

UNCUT = 2**40  # rows or columns of a tile where a group is not cut

Tiles = list[list[list[Unit]]]  # by row and column of tiles, then channel
Share = tuple[range, range]  # of an axis of a level: nodes and details


def units_of(header: Header, levels: Levels) -> list[Unit]:
    """All units, in the order of their numbers."""
    units: list[Unit] = []
    coarser: dict[int, Tiles] = {}  # by the number of a grid
    for level, groups in enumerate(levels.groups()):
        finer: dict[int, Tiles] = {}
        for group in groups:
            tiles = _tiles(header, level, group, coarser.get(group[0].number) if level > 1 else None)
            finer.update({grid.number: tiles for grid in group})
            units += [unit for row in tiles for tile in row for unit in tile]
        coarser = finer
    return units


def _tiles(header: Header, level: int, group: list[GridLevels], below: Tiles | None) -> Tiles:
    """The tiles of a group at a level; `below` are those of the next coarser one, in which their parents are."""
    first = group[0]
    is_cut = level > 0 and len(group) == 1 and not first.is_curve
    sizes = [2**t if is_cut else UNCUT for t in header.tile]
    shares = [[_shares(grid, level, axis, sizes[axis]) for axis in (0, 1)] for grid in group]
    tiles: Tiles = []
    for i in range(len(shares[0][0])):
        tiles.append([])
        for j in range(len(shares[0][1])):
            parents: list[Unit] | None = None
            if below is not None:
                down, along = (int(axis.steps) for axis in first.axes[level - 1])
                parents = below[min(i >> down, len(below) - 1)][min(j >> along, len(below[0]) - 1)]
            tile = []
            for channel in range(header.channels):
                is_coordinate = channel < header.coordinates
                inherited = [] if parents is None else parents[channel].bands
                bands: list[Band] = []
                for grid, (rows, columns) in zip(group, shares, strict=True):
                    if is_coordinate or not grid.is_curve:
                        bands += _bands(grid, level, is_coordinate, rows[i], columns[j], inherited)
                tile.append(Unit(level, bands, header.base > 0 and is_coordinate))
            tiles[-1].append(tile)
    return tiles


def _shares(grid: GridLevels, level: int, axis: int, size: int) -> list[Share]:
    """How an axis of a level is cut: the nodes and details of each tile."""
    nodes = grid.shape(max(level - 1, 0))[axis]
    details = grid.shape(level)[axis] - nodes
    starts = range(0, size * max(1, (nodes + size // 2 - 1) // size), size)
    return list(zip(_cut(starts, nodes), _cut(starts, details), strict=True))


def _cut(starts: range, count: int) -> list[range]:
    edges = [*(min(start, count) for start in starts), count]
    return [range(a, b) for a, b in pairwise(edges)]


def _bands(
    grid: GridLevels, level: int, is_coordinate: bool, rows: Share, columns: Share, inherited: list[Band]
) -> list[Band]:
    """The bands of a tile of one grid, where it has any coefficient in them."""
    nodes = grid.shape(max(level - 1, 0))
    if is_coordinate and not (grid.is_curve and level):
        first_row, last_row, first_column, last_column = grid.lacks
        rows = _without(rows[0], nodes[0], first_row, last_row), rows[1]
        columns = _without(columns[0], nodes[1], first_column, last_column), columns[1]
    down, along = (int(axis.steps) for axis in grid.axes[max(level - 1, 0)])
    bands = []
    for axis0, axis1 in product((0, 1), repeat=2):
        r, c = rows[axis0], columns[axis1]
        if r and c and (level == 0) == (axis0 == axis1 == 0):
            kind = axis1 + 2 * axis0
            place = r.start + axis0 * nodes[0], c.start + axis1 * nodes[1]
            parent = next((band for band in inherited if (band.grid, band.kind) == (grid.number, kind)), None)
            bands.append(Band(kind, grid.number, r, c, place, parent, (down, along)))
    return bands


def _without(nodes: range, count: int, first: bool, last: bool) -> range:
    return range(max(nodes.start, int(first)), min(nodes.stop, count - int(last)))
