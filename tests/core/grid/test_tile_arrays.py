from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.entropy.band_fields import (
    COLUMN_SHIFT,
    COLUMNS,
    FLAGS,
    KIND,
    PARENT,
    PARENT_STRIDE,
    ROW_SHIFT,
    ROWS,
)
from lodestream.entropy.part_table import part_of
from lodestream.entropy.tiles import TileTable
from lodestream.grid.layout import Band, Grid, Layout
from lodestream.grid.tile_arrays import AT_ONCE
from tests.examples import examples
from tests.reference import tiles as reference
from tests.reference.tiles import Share

from ..entropy.reference_units import places_of
from .reference_tiles import reference_grids, reference_tiles, with_sources

Ints = NDArray[np.int64]
Span = tuple[int, int]

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


def shown(bands: Sequence[Band | Share]) -> list[tuple[Any, ...]]:
    """What a band says, of the package and of the reference decoder."""
    return [
        (band.grid, tuple(map(int, band.kind)), *map(_span, (band.rows, band.columns)), tuple(band.origin))
        for band in bands
    ]


def _span(span: Span | slice) -> Span:
    return (span.start, span.stop) if isinstance(span, slice) else span


def check_tiles(layout: Layout) -> list[reference.Tile]:
    expected = reference_tiles(layout)
    assert len(layout.tiles) == len(expected)
    for found, tile in zip(layout.tiles, expected, strict=True):
        assert (found.level, found.parent, shown(found.bands)) == (tile.level, tile.parent, shown(tile.shares[0]))
        assert shown(found.whole) == shown(tile.shares[1] if layout.shared else tile.shares[0])
    assert layout.parents.tolist() == [tile.parent for tile in expected]
    assert layout.tile_levels.tolist() == [tile.level for tile in expected]
    for level in range(layout.levels + 1):
        own = [number for number, tile in enumerate(expected) if tile.level == level]
        assert list(layout.tiles_of(level)) == own
        assert layout.starts[level] == own[0]
        assert {layout.level_of(own[0]), layout.level_of(own[-1])} == {level}
    return expected


def flags_of(row: list[int], margin: int = 0) -> Ints:
    """The same of the flags of its blocks."""
    rows, columns = (np.arange(-margin, -(-row[axis] // 8) + margin) for axis in (ROWS, COLUMNS))
    return np.asarray(row[FLAGS] + rows[:, None] * (-(-row[COLUMNS] // 8) + 1) + columns)


def check_table(
    layout: Layout,
    table: TileTable,
    tiles: list[reference.Tile],
    chosen: list[int] | None = None,
    coordinate: bool = True,
) -> None:
    """Bands of some tiles: none stands in the margin of another, and each knows where its parents stand."""
    grids, attribute = reference_grids(layout), layout.shared and not coordinate
    chosen = list(range(len(tiles))) if chosen is None else chosen
    own = [(local, share) for local, number in enumerate(chosen) for share in tiles[number].shares[attribute]]
    bands, counts = table.bands.tolist(), np.bincount([local for local, _ in own], minlength=len(chosen))
    assert table.first.tolist() == [0, *counts.cumsum().tolist()]
    assert [len(table.of_tile(tile)) for tile in range(len(table.members))] == counts.tolist()
    assert table.origins.tolist() == [[local, share.rows.start, share.columns.start] for local, share in own]
    taken, flags = np.zeros(table.size, np.int64), np.zeros(table.blocks, np.int64)
    for row, (local, share) in zip(bands, own, strict=True):
        assert (row[ROWS], row[COLUMNS], row[KIND]) == (*share.shape, 2 * share.kind[0] + share.kind[1])
        around = places_of(row, 2)
        assert table.starts[local] <= around.min() <= around.max() < table.starts[local + 1]
        taken[places_of(row)] += 1
        flags[flags_of(row)] += 1
    assert max(taken.max(), flags.max()) <= 1
    places = {
        (chosen[local], share.grid, share.kind): (share, row) for row, (local, share) in zip(bands, own, strict=True)
    }
    for row, (local, share) in zip(bands, own, strict=True):
        assert taken[places_of(row, 2)].sum() == row[ROWS] * row[COLUMNS]
        assert flags[flags_of(row, 1)].sum() == flags_of(row).size
        rows, columns = np.arange(row[ROWS])[:, None], np.arange(row[COLUMNS])
        found = row[PARENT] + (rows >> row[ROW_SHIFT]) * row[PARENT_STRIDE] + (columns >> row[COLUMN_SHIFT])
        tile = tiles[chosen[local]]
        if (tile.parent, share.grid, share.kind) not in places:
            assert not taken[found].any()
            continue
        other, above = places[tile.parent, share.grid, share.kind]
        down, across = reference.Parents(grids[share.grid], tile.level, share, other).index
        expected = places_of(above, 2)[np.ix_(down, across)]
        inside = taken[expected] > 0
        np.testing.assert_array_equal(found[inside], expected[inside])
        assert not taken[found[~inside]].any()


@pytest.mark.parametrize("closed", CLOSED)
@pytest.mark.long
def test_tiles_of_every_small_size_are_those_made_one_by_one(closed: tuple[bool, bool]) -> None:
    for rows, columns in itertools.product(range(1, 14), repeat=2):
        layout = Layout([Grid((rows, columns), closed)], ((0, 0), (1, 2), (3, 1))[(rows + columns) % 3])
        check_table(layout, TileTable.of(layout), check_tiles(layout))


@given(st.tuples(st.integers(1, 150), st.integers(1, 150)), st.sampled_from(CLOSED), exponents, st.data())
def test_tiles_of_one_grid_and_tables_of_some_of_them_are_those_made_one_by_one(
    shape: tuple[int, int], closed: tuple[bool, bool], tile: tuple[int, int], data: st.DataObject
) -> None:
    layout = Layout([Grid(shape, closed)], tile)
    tiles = check_tiles(layout)
    numbers = data.draw(st.lists(st.integers(0, len(layout.tiles)), min_size=2, max_size=6).map(sorted))
    part = part_of(TileTable.of(layout), _runs(numbers))
    check_table(layout, part.table, tiles, part.tiles.tolist())


def _runs(numbers: list[int]) -> list[range]:
    ends = zip(numbers[::2], numbers[1::2], strict=False)
    return [run for run in (range(*pair) for pair in ends) if run] or [range(1)]


@examples(10)
@given(layouts_of_several())
def test_tiles_of_several_grids_are_those_made_one_by_one(layout: Layout) -> None:
    tiles = check_tiles(layout)
    for coordinate in (True, False):
        check_table(layout, TileTable.of(layout, coordinate), tiles, coordinate=coordinate)
    numbers = [int(of) for grid in TileTable.of(layout).of_grid for of in grid]
    assert sorted(numbers) == list(range(len(TileTable.of(layout).bands)))


@pytest.mark.long
def test_many_tiles_are_made_in_runs() -> None:
    layout = Layout([Grid((260, 270))], (1, 1))
    assert len(layout.tiles) > AT_ONCE
    expected = check_tiles(layout)
    last = len(expected) - 1
    assert layout.tiles[last] == layout.tiles[-1]
    assert [shown(tile.bands) for tile in layout.tiles[5:last:1000]] == [
        shown(tile.shares[0]) for tile in expected[5:last:1000]
    ]
    with pytest.raises(IndexError):
        layout.tiles[last + 1]
    check_table(layout, TileTable.of(layout), expected)


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
