"""The grids and tiles of a layout by the reference decoder."""

from __future__ import annotations

from lodestream.grid.layout import Grid, Layout, Source
from tests.reference import levels, tiles

__all__ = ["reference_grids", "reference_tiles", "with_sources"]


def reference_grids(layout: Layout) -> list[levels.Grid]:
    """All grids of a layout."""
    axes = [
        (levels.Axis(rows, grid.closed[0], grid.clamped[:2]), levels.Axis(columns, grid.closed[1], grid.clamped[2:]))
        for grid in layout.grids
        for rows, columns in [grid.shape]
    ]
    # A closed axis never stops early: no block has such a side in common with another one.
    stops = [(grid.stops[0] and not grid.closed[0], grid.stops[1] and not grid.closed[1]) for grid in layout.grids]
    return [
        levels.Grid(grid.interface, chain, grid.taken)
        for grid, chain in zip(layout.grids, levels.levels_of(axes, stops), strict=True)
    ]


def reference_tiles(layout: Layout) -> list[tiles.Tile]:
    """All tiles of a layout."""
    return tiles.tiles_of(reference_grids(layout), layout.tile)


def with_sources(grid: Grid, taken: tuple[bool, ...]) -> Grid:
    """The grid with some sides that come from the first grid of its layout."""
    first, last, left, right = (Source(0, False) if side else None for side in taken)
    return Grid(grid.shape, grid.closed, grid.clamped, grid.stops, (first, last, left, right), grid.interface)
