"""Levels, windows, blocks: what is decoded for a tile, and what it costs."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.errors import CorruptStreamError, InputError, OptionError
from lodestream.maps import BlockCache, HeightField, web_tile
from lodestream.maps.grid_places import GridPlaces
from lodestream.maps.windows import HeightWindows

from .fields import at, degrees, field_of, pixel_of, plane, utm


def windows_of(surface: ls.Surface) -> HeightWindows:
    container = ls.encode(surface)
    return HeightWindows(lambda offset, length: container[offset : offset + length], len(container))


def terrain(rows: int, columns: int, hole: bool, dtype: str) -> ls.Surface:
    heights = np.random.default_rng(rows).normal(0, 50, (rows, columns)).cumsum(0).cumsum(1)
    if hole:
        heights[rows // 3 : rows // 3 + 9, columns // 2 :] = np.nan
        return ls.Surface(heights.astype("f4"))
    return ls.Surface(heights.round().astype(dtype))


@pytest.mark.parametrize("hole", [False, True])
@pytest.mark.parametrize("dtype", ["int32", "float32"])
def test_a_window_of_a_level_is_that_part_of_the_level(hole: bool, dtype: str) -> None:
    surface = terrain(83, 70, hole, dtype)
    windows = windows_of(surface)
    whole = ls.Decoder()
    whole.feed(ls.encode(surface))
    for level in range(windows.header.levels + 1):
        made = whole.surface(level)
        expected = made.points.astype(float)
        if made.mask is not None:
            expected[~made.mask] = np.nan
        rows, columns = expected.shape
        for window in (
            ((0, rows), (0, columns)),
            ((rows // 3, rows // 3 + 1), (columns // 2, columns)),
            ((rows - 1, rows), (columns - 1, columns)),
            ((0, 1), (0, 1)),
            ((0, 1), (columns - 1, columns)),
        ):
            part = windows.heights(level, window)
            np.testing.assert_array_equal(part, expected[slice(*window[0]), slice(*window[1])])


def test_the_level_is_the_coarsest_whose_cells_are_no_larger_than_the_pixels() -> None:
    field = plane()
    cell = field.placement.cell
    assert abs(cell - 30) < 0.1
    for metres, steps in ((0, 0), (cell, 0), (1.99 * cell, 0), (2 * cell, 1), (3.99 * cell, 1), (4 * cell, 2)):
        assert field.level_for(metres) == field.levels - steps
    assert field.level_for(1e9) == 0
    with pytest.raises(OptionError, match=f"expected a level of 0 to {field.levels}"):
        at(field, 0, 0, level=field.levels + 1)
    with pytest.raises(OptionError, match="expected a level as an integer"):
        at(field, 0, 0, level="fine")


def test_blocks_are_kept_and_only_those_that_a_tile_needs_are_read() -> None:
    heights = np.random.default_rng(0).integers(0, 1000, (700, 700)).astype(np.int16)
    surface = ls.Surface(heights, metadata=utm("EPSG:32633", 5e5, 5e6, 10))
    container = ls.encode(surface)
    read = 0

    def reading(offset: int, length: int) -> bytes:
        nonlocal read
        read += length
        return container[offset : offset + length]

    cache = BlockCache(1 << 20)
    field = HeightField(reading, len(container), cache=cache)
    opened = read
    longitudes, latitudes = np.linspace(15.001, 15.002, 8), np.linspace(45.149, 45.15, 8)
    first = field.heights(longitudes, latitudes)
    once = read
    assert 0 < once - opened < len(container) / 2
    assert cache.bytes == 256 * 256 * 4
    np.testing.assert_array_equal(field.heights(longitudes, latitudes), first)
    assert read == once
    other = HeightField(reading, len(container), cache=cache)
    before = read
    np.testing.assert_array_equal(other.heights(longitudes, latitudes), first)
    assert read > before  # the other field has blocks of its own
    assert cache.bytes == 2 * 256 * 256 * 4


def test_the_cache_is_bounded_and_forgets_what_was_used_least_recently() -> None:
    cache = BlockCache(100)
    made: list[str] = []

    def block(name: str, count: int = 10) -> Any:
        def make() -> Any:
            made.append(name)
            return np.zeros(count, np.float32)

        return cache.get(name, make)

    block("a"), block("b"), block("a"), block("c")
    assert (made, cache.bytes) == (["a", "b", "c"], 80)
    block("a"), block("b")
    assert made == ["a", "b", "c", "b"]
    assert len(block("large", 26)) == 26
    assert cache.bytes <= 100
    block("large", 26)
    assert made[-2:] == ["large", "large"]
    with pytest.raises(OptionError, match="0 bytes or more"):
        BlockCache(-1)


@pytest.mark.long
def test_threads_share_a_field() -> None:
    container = ls.encode(terrain(600, 500, True, "float32"))
    metadata = degrees(10, 50, 0.01)
    surface = ls.decode(container)
    surface.metadata |= metadata
    field, other = field_of(surface), field_of(surface)
    z = field.placement.web_zoom()
    tiles = [(z, *(int(place) // 256 for place in pixel_of(x, 47.5, z))) for x in (11.0, 12.0, 13.0, 14.0)]
    expected = [web_tile(other, *tile) for tile in tiles]
    found: dict[int, list[bytes]] = {}

    def work(number: int) -> None:
        found[number] = [web_tile(field, *tile) for tile in tiles]

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [found[number] == expected for number in range(4)] == [True] * 4


def test_a_file_is_read_where_it_is_needed(tmp_path: Path) -> None:
    path = tmp_path / "a.lode"
    surface = terrain(90, 80, False, "int16")
    surface.metadata |= degrees(10, 50, 0.1) | {"name": "Hill"}
    path.write_bytes(ls.encode(surface))
    field = HeightField.open(path)
    assert field.name == "Hill"
    assert at(field, 12.5, 48) == surface.points[20, 25]
    (tmp_path / "empty.lode").touch()
    with pytest.raises(InputError, match="got the empty file"):
        HeightField.open(tmp_path / "empty.lode")
    (tmp_path / "other.lode").write_bytes(b"no container" * 100)
    with pytest.raises(CorruptStreamError, match="lodestream encode makes a container") as other:
        HeightField.open(tmp_path / "other.lode")
    assert other.value.__notes__ == [f"in {tmp_path / 'other.lode'}"]
    with pytest.raises(FileNotFoundError):
        HeightField.open(tmp_path / "nothing.lode")


def test_damage_is_an_error_of_the_tile_that_needs_it() -> None:
    surface = terrain(600, 500, False, "int16")
    surface.metadata |= degrees(10, 50, 0.01)
    container = bytearray(ls.encode(surface))
    field = HeightField(lambda offset, length: bytes(container[offset : offset + length]), len(container))
    container[len(container) // 4 : len(container) * 3 // 4] = bytes(len(container) // 2)
    with pytest.raises(CorruptStreamError):
        at(field, 12, 48)


def test_a_window_of_too_many_nodes_takes_a_coarser_level() -> None:
    surface = ls.Surface(np.zeros((1500, 1500), np.int16), metadata=degrees(10, 50, 0.001))
    cache = BlockCache()
    field = field_of(surface, cache=cache)
    longitudes, latitudes = np.linspace(10, 11.499, 50), np.linspace(50, 48.501, 50)
    assert np.isfinite(field.heights(longitudes, latitudes, level=field.levels)).all()
    assert cache.bytes <= 4 * 751 * 751


def test_surfaces_that_are_no_heights_are_refused() -> None:
    blocks = ls.Surface(blocks=[ls.Block(np.random.default_rng(i).random((5, 5, 3))) for i in range(2)])
    with pytest.raises(InputError, match="expected one block of heights for a map, got 2 blocks"):
        windows_of(blocks)
    ball = np.random.default_rng(0).random((9, 8, 3))
    ball[0], ball[-1] = ball[0, 0], ball[-1, 0]
    with pytest.raises(InputError, match="got a block that meets itself"):
        windows_of(ls.Surface(ball, (False, True)))


def test_attributes_are_not_read() -> None:
    random = np.random.default_rng(0)
    heights = random.integers(0, 500, (90, 80)).astype(np.int16)
    plain = ls.Surface(heights)
    more = ls.Surface(heights, attributes={"colour": random.integers(0, 256, (90, 80, 3)).astype(np.uint8)})
    taken = []
    for surface in (plain, more):
        container, read = ls.encode(surface), [0]

        def reading(offset: int, length: int, container: bytes = container, read: list[int] = read) -> bytes:
            read[0] += length
            return container[offset : offset + length]

        windows = HeightWindows(reading, len(container))
        before = read[0]
        part = windows.heights(windows.header.levels, ((20, 60), (30, 80)))
        np.testing.assert_array_equal(part, heights[20:60, 30:80])
        taken.append(read[0] - before)
    assert taken[1] < 1.2 * taken[0]


@given(
    st.tuples(st.floats(-170, 170), st.floats(-80, 80)),
    st.tuples(st.floats(0.01, 5), st.floats(-5, -0.01)),
    st.floats(-0.4, 0.4),
    st.lists(st.floats(0.1, 3), min_size=6, max_size=6),
    st.integers(0, 3),
)
def test_places_are_where_positions_are(
    corner: tuple[float, float], steps: tuple[float, float], turned: float, gaps: list[float], kind: int
) -> None:
    """Of all rules of coordinates, each beside an even one; a turned grid has a geotransform."""
    line = (corner[0] + np.cumsum(gaps)).tolist()
    x = [
        [corner[0], steps[0]],
        [*line, "values"],
        [*line[::-1], "values"],
        [corner[0], corner[0] + 6 * steps[0], True],
    ][kind]
    rules = {"axes": {"x": x, "y": [corner[1], steps[1], False]}}
    rotated = {"geotransform": [corner[0], steps[0], turned * steps[0], corner[1], turned * steps[1], steps[1]]}
    for metadata in (rules, rotated):
        grid = GridPlaces.of(metadata, (9, 6), (False, False), None)
        rows, columns = (values.astype(float) + 0.3 for values in np.mgrid[0:8, 0:5])
        found = grid.places(*grid.positions(rows, columns))
        np.testing.assert_allclose(found[0], rows, atol=1e-6)
        np.testing.assert_allclose(found[1], columns, atol=1e-6)
        assert grid.inside(*found, (False, False)).all()
        outside = grid.places(*grid.positions(rows - 20, columns))
        assert not grid.inside(*outside, (False, False)).any()
