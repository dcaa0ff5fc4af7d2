"""Tiles and the table of their bands made one by one, as plainly as they can be."""

from __future__ import annotations

from typing import NamedTuple

from lodestream.grid.layout import Band, Grid, Layout, Source, Tile, tile_bounds

#: What a table says of a band without a parent.
NO_PARENT = [1, 0, 31, 31]

Pair = tuple[int, int]


def plain_tiles(layout: Layout) -> list[Tile]:
    """All tiles of a layout."""
    every = list(range(len(layout.grids)))
    tiles = [Tile(0, (0, 0), *_members(layout, every, 0, [0, 1], [0, 1], (0, 0)), -1)]
    below: dict[int, tuple[int, list[int], list[int]]] = {}  # of each grid: its first tile, bounds of rows and columns
    for level, groups in enumerate(_groups(layout), start=1):
        found = {}
        for group in groups:
            rows, columns = ([0, 1], [0, 1])
            if len(group) == 1 and not layout.grids[group[0]].interface:
                shape = layout.shape(group[0], level - 1)
                rows, columns = (tile_bounds(n, e) for n, e in zip(shape, layout.tile, strict=True))
            first = len(tiles)
            for i in range(len(rows) - 1):
                for j in range(len(columns) - 1):
                    parent = -1
                    if level > 1:
                        before, down, across = below[group[0]]
                        half = _halves(layout, group[0], level)
                        row, column = min(i >> half[0], len(down) - 2), min(j >> half[1], len(across) - 2)
                        parent = before + row * (len(across) - 1) + column
                    members = _members(layout, group, level, rows, columns, (i, j))
                    tiles.append(Tile(level, (i, j), *members, parent))
            found.update(dict.fromkeys(group, (first, rows, columns)))
        below = found
    return tiles


def _groups(layout: Layout) -> list[list[list[int]]]:
    """Of each level from 1 on: the grids that have their tiles in common."""
    levels: list[list[list[int]]] = []
    groups = [[number] for number in range(len(layout.grids))]
    for level in range(layout.levels, 0, -1):
        merged: list[list[int]] = []
        for group in groups:
            interface = layout.grids[group[0]].interface
            if merged and layout.grids[merged[-1][0]].interface == interface:
                points = sum(a * b for a, b in (layout.shape(number, level) for number in merged[-1] + group))
                if interface or points <= 4 << sum(layout.tile):
                    merged[-1] = merged[-1] + group
                    continue
            merged.append(group)
        groups = merged
        levels.insert(0, groups)
    return levels


def _halves(layout: Layout, grid: int, level: int) -> list[bool]:
    finer, coarser = layout.shape(grid, level - 1), layout.shape(grid, level - 2)
    return [a != b for a, b in zip(finer, coarser, strict=True)]


def _members(
    layout: Layout, group: list[int], level: int, rows: list[int], columns: list[int], place: Pair
) -> tuple[tuple[Band, ...], tuple[Band, ...]]:
    bands: list[Band] = []
    whole: list[Band] = []
    for number in group:
        grid, coarse = layout.grids[number], layout.shape(number, max(level - 1, 0))
        bounds = (
            (rows, columns) if len(group) == 1 and level and not grid.interface else ([0, coarse[0]], [0, coarse[1]])
        )
        bands += _bands(layout, number, level, bounds, place, grid.taken)
        if layout.shared and not grid.interface:
            whole += _bands(layout, number, level, bounds, place, (False,) * 4)
    return tuple(bands), tuple(whole) if layout.shared else tuple(bands)


def _bands(
    layout: Layout, number: int, level: int, bounds: tuple[list[int], list[int]], place: Pair, taken: tuple[bool, ...]
) -> list[Band]:
    fine, coarse = layout.shape(number, level), layout.shape(number, max(level - 1, 0))
    spans: list[tuple[tuple[Pair, int], tuple[Pair, int]]] = []
    for axis in range(2):
        own = bounds[axis]
        start, stop = own[place[axis]], own[place[axis] + 1]
        last = stop == own[-1]
        nodes = start, stop
        if taken[2 * axis] and start == 0:
            nodes = 1, nodes[1]
        if taken[2 * axis + 1] and last:
            nodes = nodes[0], stop - 1
        count = fine[axis] - coarse[axis]
        details = min(start, count), count if last else min(stop, count)
        placed = coarse[axis] + details[0], coarse[axis] + details[1]
        spans.append(((nodes, nodes[0]), (placed, details[0])))
    found = []
    for kind in ((False, True), (True, False), (True, True)) if level else ((False, False),):
        (rows, top), (columns, left) = spans[0][kind[0]], spans[1][kind[1]]
        if rows[0] < rows[1] and columns[0] < columns[1]:
            found.append(Band(kind, rows, columns, (top, left), number))
    return found


class PlainTable(NamedTuple):
    """What `TileTable` says, one by one."""

    bands: list[list[int]]
    origins: list[list[int]]
    first: list[int]
    starts: list[int]
    blocks: int


def plain_table(layout: Layout, chosen: list[int], coordinate: bool) -> PlainTable:
    """The table of some tiles of a layout, in this order."""
    tiles = plain_tiles(layout)
    rows: list[list[int]] = []
    origins: list[list[int]] = []
    first, starts, size, blocks = [0], [3], 3, 0
    known: dict[tuple[int, int, tuple[bool, bool]], tuple[int, int, Band]] = {}
    for local, number in enumerate(chosen):
        tile = tiles[number]
        for band in tile.bands if coordinate else tile.whole:
            height, width = band.shape
            place = size + 2 * (width + 2) + 2
            joined = NO_PARENT
            if (tile.parent, band.grid, band.kind) in known:
                at, stride, parent = known[tile.parent, band.grid, band.kind]
                down, right = (int(half) for half in _halves(layout, band.grid, tile.level))
                row = (band.origin[0] + down >> down) - parent.origin[0]
                column = (band.origin[1] + right >> right) - parent.origin[1]
                joined = [at + row * stride + column, stride, down, right]
            across = (width + 7) // 8
            kind = 2 * band.kind[0] + band.kind[1]
            rows.append([place, width + 2, height, width, blocks + across + 2, *joined, kind])
            origins.append([local, band.rows[0], band.columns[0]])
            known[number, band.grid, band.kind] = place, width + 2, band
            size += (height + 4) * (width + 2) + 2
            blocks += ((height + 7) // 8 + 2) * (across + 1) + 1
        first.append(len(rows))
        starts.append(size)
    return PlainTable(rows, origins, first, starts, blocks)


def with_sources(grid: Grid, taken: tuple[bool, ...]) -> Grid:
    """The grid with some sides that come from the first grid of its layout."""
    first, last, left, right = (Source(0, False) if side else None for side in taken)
    return Grid(grid.shape, grid.closed, grid.clamped, grid.stops, (first, last, left, right), grid.interface)
