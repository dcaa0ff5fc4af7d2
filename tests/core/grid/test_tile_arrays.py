from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lodestream.entropy.part_table import part_of
from lodestream.entropy.tiles import TileTable
from lodestream.grid.layout import Grid, Layout
from lodestream.grid.tile_arrays import AT_ONCE

from .plain_tiles import PlainTable, plain_table, plain_tiles, with_sources

CLOSED = [(False, False), (False, True), (True, False), (True, True)]
sides = st.tuples(*[st.booleans()] * 4)
exponents = st.tuples(st.integers(0, 4), st.integers(0, 4))


@st.composite
def layouts_of_several(draw: st.DrawFn) -> Layout:
    """Interfaces, then patches, any sides of which come from interfaces."""
    grids = []
    for _ in range(draw(st.integers(0, 3))):
        shape, stops = (draw(st.integers(1, 40)), 1), (draw(st.booleans()), False)
        grid = Grid(shape, (draw(st.booleans()), False), (True, True, False, False), stops, interface=True)
        grids.append(with_sources(grid, (draw(st.booleans()), draw(st.booleans()), False, False)))
    for _ in range(draw(st.integers(1, 6))):
        shape = draw(st.integers(1, 60)), draw(st.integers(1, 60))
        closed, stops = draw(st.sampled_from(CLOSED)), draw(st.sampled_from(CLOSED))
        grids.append(with_sources(Grid(shape, closed, draw(sides), stops), draw(sides)))
    return Layout(grids, draw(exponents))


def check_tiles(layout: Layout) -> None:
    expected = plain_tiles(layout)
    assert list(layout.tiles) == expected
    assert len(layout.tiles) == len(expected)
    assert layout.parents.tolist() == [tile.parent for tile in expected]
    assert layout.tile_levels.tolist() == [tile.level for tile in expected]
    for level in range(layout.levels + 1):
        own = [number for number, tile in enumerate(expected) if tile.level == level]
        assert list(layout.tiles_of(level)) == own
        assert layout.starts[level] == own[0]
        assert {layout.level_of(own[0]), layout.level_of(own[-1])} == {level}


def check_table(table: TileTable, expected: PlainTable) -> None:
    assert table.bands.tolist() == expected.bands
    assert table.origins.tolist() == expected.origins
    assert table.first.tolist() == expected.first
    assert table.starts.tolist() == expected.starts
    assert table.blocks == expected.blocks
    assert [len(table.of_tile(tile)) for tile in range(len(table.members))] == np.diff(expected.first).tolist()


@pytest.mark.parametrize("closed", CLOSED)
def test_tiles_of_every_small_size_are_those_made_one_by_one(closed: tuple[bool, bool]) -> None:
    for rows, columns in itertools.product(range(1, 19), repeat=2):
        for tile in ((0, 0), (1, 2), (3, 1)):
            layout = Layout([Grid((rows, columns), closed)], tile)
            check_tiles(layout)
            check_table(TileTable.of(layout), plain_table(layout, list(range(len(layout.tiles))), True))


@given(st.tuples(st.integers(1, 150), st.integers(1, 150)), st.sampled_from(CLOSED), exponents, st.data())
def test_tiles_of_one_grid_and_tables_of_some_of_them_are_those_made_one_by_one(
    shape: tuple[int, int], closed: tuple[bool, bool], tile: tuple[int, int], data: st.DataObject
) -> None:
    layout = Layout([Grid(shape, closed)], tile)
    check_tiles(layout)
    numbers = data.draw(st.lists(st.integers(0, len(layout.tiles)), min_size=2, max_size=6).map(sorted))
    part = part_of(TileTable.of(layout), _runs(numbers))
    check_table(part.table, plain_table(layout, part.tiles.tolist(), True))


def _runs(numbers: list[int]) -> list[range]:
    ends = zip(numbers[::2], numbers[1::2], strict=False)
    return [run for run in (range(*pair) for pair in ends) if run] or [range(1)]


@settings(deadline=None)
@given(layouts_of_several())
def test_tiles_of_several_grids_are_those_made_one_by_one(layout: Layout) -> None:
    check_tiles(layout)
    every = list(range(len(layout.tiles)))
    for coordinate in (True, False):
        check_table(TileTable.of(layout, coordinate), plain_table(layout, every, coordinate))
    numbers = [int(of) for grid in TileTable.of(layout).of_grid for of in grid]
    assert sorted(numbers) == list(range(len(TileTable.of(layout).bands)))


def test_many_tiles_are_made_in_runs() -> None:
    layout = Layout([Grid((260, 270))], (1, 1))
    assert len(layout.tiles) > AT_ONCE
    check_tiles(layout)
    expected = plain_tiles(layout)
    last = len(expected) - 1
    assert layout.tiles[last] == layout.tiles[-1] == expected[-1]
    assert list(layout.tiles[5:last:1000]) == expected[5:last:1000]
    with pytest.raises(IndexError):
        layout.tiles[last + 1]
    check_table(TileTable.of(layout), plain_table(layout, list(range(last + 1)), True))


def test_a_layout_of_ten_to_the_eleven_values_knows_its_tiles_without_listing_them() -> None:
    layout = Layout([Grid((1 << 18, 3 << 17))], (6, 6))
    count = sum(len(layout.tiles_of(level)) for level in range(layout.levels + 1))
    assert len(layout.tiles) == count > 8_000_000
    tile = layout.tiles[count - 1]
    assert (tile.level, tile.place) == (layout.levels, (2047, 3071))
    assert tile.parent == layout.tiles_of(layout.levels - 1).stop - 1
    # Of an even length the last tile has one node more than others, and one detail less.
    assert [band.shape for band in tile.bands] == [(65, 63), (63, 65), (63, 63)]
    assert [band.rows[1] for band in tile.bands] == [(1 << 17) + 1, 1 << 18, 1 << 18]
