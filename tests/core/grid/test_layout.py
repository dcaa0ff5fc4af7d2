from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.encoding.tiling import chunk_exponents, tile_exponents
from lodestream.entropy.tiles import TileTable, gather
from lodestream.errors import InputError
from lodestream.grid.layout import Layout, tile_bounds

from ..entropy.coding import shapes_of
from ..surfaces import index_of
from ..transform import reference_steps as reference

closures = st.tuples(st.booleans(), st.booleans())
layouts = st.builds(
    Layout.single,
    st.tuples(st.integers(1, 120), st.integers(1, 120)),
    closures,
    st.tuples(st.integers(1, 5), st.integers(1, 5)),
)


@given(layouts)
def test_levels_count_back_from_the_surface(layout: Layout) -> None:
    assert shapes_of(layout) == reference.shapes(layout.grids[0].shape, layout.grids[0].closed)
    assert layout.levels == len(shapes_of(layout)) - 1
    for level in range(1, layout.levels + 1):
        rows, columns = layout.steps(0, level)
        assert (rows.length, columns.length) == shapes_of(layout)[level]
        assert (rows.coarse, columns.coarse) == shapes_of(layout)[level - 1]


@given(layouts)
def test_tiles_partition_the_array(layout: Layout) -> None:
    held = np.zeros(layout.grids[0].shape, np.int32)
    for tile in layout.tiles:
        for band in tile.bands:
            assert min(band.shape) > 0
            held[slice(*band.rows), slice(*band.columns)] += 1
            assert band.rows[1] <= shapes_of(layout)[tile.level][0]
            assert band.columns[1] <= shapes_of(layout)[tile.level][1]
            if tile.level:
                coarse = shapes_of(layout)[tile.level - 1]
                for span, nodes, detail in zip((band.rows, band.columns), coarse, band.kind, strict=True):
                    assert (span[0] >= nodes) == detail
                    assert detail or span[1] <= nodes
    assert (held == 1).all()


@given(layouts)
def test_tiles_are_numbered_by_level_and_row_by_row(layout: Layout) -> None:
    order = [(tile.level, *tile.place) for tile in layout.tiles]
    assert order == sorted(order)
    for level in range(layout.levels + 1):
        assert [n for n, tile in enumerate(layout.tiles) if tile.level == level] == list(layout.tiles_of(level))


@given(layouts)
def test_a_parent_contains_its_children_s_family(layout: Layout) -> None:
    """The coefficient over the same place one level up lies in the parent's tile, or just beyond its band's end."""
    table = TileTable.of(layout)
    for number, tile in enumerate(layout.tiles):
        if tile.level < 2:
            assert tile.parent == -1
            continue
        parent = layout.tiles[tile.parent]
        assert parent.level == tile.level - 1
        bands = {band.kind: (band, row) for band, row in zip(parent.bands, table.of_tile(tile.parent), strict=True)}
        halved = [a != b for a, b in zip(*shapes_of(layout)[tile.level - 2 : tile.level], strict=True)]
        for band, row in zip(tile.bands, table.of_tile(number), strict=True):
            place, stride, down, right = (int(x) for x in row[5:9])
            if band.kind not in bands:
                assert (place, down, right) == (1, 31, 31)
                continue
            above, its = bands[band.kind]
            for i in (0, band.shape[0] - 1):
                for j in (0, band.shape[1] - 1):
                    at = place + (i >> down) * stride + (j >> right)
                    y, x = divmod(at - int(its[0]), int(its[1]))
                    expected = [
                        (o + n >> h) - p for o, n, h, p in zip(band.origin, (i, j), halved, above.origin, strict=True)
                    ]
                    assert expected == [y, x]
                    assert 0 <= y <= above.shape[0]
                    assert 0 <= x <= above.shape[1]


@given(layouts)
def test_flat_arrays_hold_every_coefficient_once_in_a_frame_of_zeros(layout: Layout) -> None:
    table = TileTable.of(layout)
    shape = layout.grids[0].shape
    values = np.arange(1, 1 + shape[0] * shape[1], dtype=np.int32).reshape(shape)
    flat = gather(table, [values])
    assert flat.size == table.size
    np.testing.assert_array_equal(np.sort(flat[flat != 0]), values.ravel())
    for number, tile in enumerate(layout.tiles):
        for band, row in zip(tile.bands, table.of_tile(number), strict=True):
            place, stride, height = (int(x) for x in row[:3])
            frame = flat[place - stride - 1 :][: (height + 2) * stride].reshape(height + 2, stride)
            np.testing.assert_array_equal(frame[1:-1, 1:-1], values[slice(*band.rows), slice(*band.columns)])
            assert not frame[[0, -1]].any()
            assert not frame[:, [0, -1]].any()


def test_the_last_tile_takes_up_to_half_a_tile_with_it() -> None:
    assert tile_bounds(128, 7) == [0, 128]
    assert tile_bounds(192, 7) == [0, 192]
    assert tile_bounds(193, 7) == [0, 128, 193]
    assert tile_bounds(1, 7) == [0, 1]
    for length in range(1, 2000):
        sizes = np.diff(tile_bounds(length, 7))
        assert (sizes[:-1] == 128).all()
        assert sizes[-1] <= 192


@pytest.mark.parametrize(
    ("shape", "tile"),
    [((5000, 5000), (6, 6)), ((65, 4000), (6, 6)), ((64, 4000), (5, 7)), ((1, 9), (1, 11)), ((900, 3), (11, 1))],
)
def test_tiles_of_narrow_surfaces_are_long(shape: tuple[int, int], tile: tuple[int, int]) -> None:
    assert tile_exponents(shape) == tile


@pytest.mark.parametrize(
    ("shape", "chunks"),
    [
        ((5000, 5000), [(6, 6), (8, 8)]),
        ((33, 4000), [(6, 6), (6, 10)]),
        ((32, 4000), [(5, 7), (5, 11)]),
        ((900, 1), [(11, 1), (15, 1)]),
    ],
)
def test_chunks_of_narrow_surfaces_are_long(shape: tuple[int, int], chunks: list[tuple[int, int]]) -> None:
    assert chunk_exponents(shape) == chunks


def test_small_surfaces_take_small_tiles_where_points_have_many_bytes() -> None:
    assert tile_exponents((512, 512), 11) == (5, 6)
    assert tile_exponents((20_000, 20_000), 16) == (8, 8)  # as large as a container holds: none has more columns
    assert chunk_exponents((512, 512), (10, 12, 16)) == [(5, 5), (6, 6), (8, 8)]
    noise = np.random.default_rng(4).normal(size=(70, 150)).astype(np.float32)
    for values, tile in ((noise, (5, 6)), (np.rint(100 * noise), (6, 6)), (noise > 0, (6, 6))):
        container = ls.encode(values.astype(np.float32 if values.dtype == bool else values.dtype))
        assert index_of(container).header.tile == tile
    assert index_of(ls.encode(noise, precision=1e-3)).header.tile == (6, 6)


def test_an_empty_grid_is_refused() -> None:
    with pytest.raises(InputError, match="0 x 5"):
        Layout.single((0, 5), (False, False), (7, 7))
