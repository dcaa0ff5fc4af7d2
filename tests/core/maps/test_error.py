"""Heights that may be off by so many metres: from fewer layers, of which alone bytes are read."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.errors import OptionError
from lodestream.maps import BlockCache, HeightField, mesh_tile, web_tile
from lodestream.maps.windows import HeightWindows

from .fields import bigtujunga, decoded, field_of, pixel_of, utm

#: How much further off than the finest level's heights those of a coarser one may be: 1.13 times was measured.
COARSER = 1.25


@functools.cache
def container() -> bytes:
    """Heights of 10 m in decimetres, 600 x 520, rough in the west and flat in the east, with a hole."""
    heights = np.random.default_rng(4).normal(0, 9, (600, 520)).cumsum(0).cumsum(1)
    heights[:, 256:] = heights[:, 256:257] + np.linspace(0, 40, 264)
    heights = heights.round().astype("f4")
    heights[100:130, 60:90] = np.nan
    return ls.encode(ls.Surface(heights, metadata=utm("EPSG:32633", 5e5, 5e6, 10) | {"scale": 0.1}))


def opened(**options: float | str) -> tuple[HeightField, list[int]]:
    """A field, and the numbers of bytes that are read from now on."""
    data, lengths = container(), list[int]()

    def read(offset: int, length: int) -> bytes:
        lengths.append(length)
        return data[offset : offset + length]

    field = HeightField(read, len(data), **options)  # type: ignore[arg-type]
    lengths.clear()
    return field, lengths


def every(field: HeightField, level: int) -> NDArray[np.float32]:
    """Heights at places all over the field, shape (row, column)."""
    west, south, east, north = field.bounds
    return field.heights(np.linspace(west, east, 400), np.linspace(north, south, 300), level=level)


@pytest.mark.parametrize("coarser", [0, 1, 3])
def test_heights_are_no_further_off_and_fewer_bytes_are_read(coarser: int) -> None:
    exact, lengths = opened()
    expected, whole = every(exact, exact.levels - coarser), sum(lengths)
    read, most = [], []
    for error in (0.05, 0.5, 2.0, 20.0, 1e6):
        field, lengths = opened(error=error)
        found = every(field, field.levels - coarser)
        read.append(sum(lengths))
        most.append(float(np.nanmax(np.abs(found - expected))))
        assert most[-1] <= error * (COARSER if coarser else 1) + 1e-4  # in float32
        np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    assert read == sorted(read, reverse=True)
    assert read[0] <= whole + 4096  # and the errors of windows
    assert read[3] < whole / 2
    assert read[4] < whole / 20
    assert most[3] > 0.1


def test_a_window_needs_the_layers_that_it_is_told_to_need() -> None:
    """At the finest level a flat part is near enough after fewer layers than the whole."""
    data = container()
    windows = HeightWindows(lambda offset, length: data[offset : offset + length], len(data))
    finest = windows.header.levels
    rough, flat = (windows.layers_within(20.0, finest, ((0, 256), columns)) for columns in ((0, 256), (256, 512)))
    coarser = windows.layers_within(20.0, finest - 1, ((0, 128), (128, 256)))
    assert flat is not None
    assert rough is not None
    assert coarser is not None
    assert flat < rough <= coarser
    assert windows.layers_within(0.0, finest, ((0, 256), (0, 256))) in (None, windows.header.layer_count)
    assert windows.layers_within(1e9, finest, ((0, 256), (0, 256))) == 1
    decoder = ls.Decoder()
    view = decoder.feed(data)[flat - 1]
    part = windows.heights(finest, ((0, 256), (256, 512)), flat)
    np.testing.assert_array_equal(part, view.points[:256, 256:512])


def test_fields_with_other_options_share_what_was_read_but_no_blocks() -> None:
    exact, lengths = opened()
    level = exact.levels
    expected, once = every(exact, level), len(lengths)
    coarse = every(exact.with_options(error=50.0), level)
    assert np.nanmax(np.abs(coarse - expected)) > 1
    np.testing.assert_allclose(every(exact.with_options(scale=-2.0), level), -2 * expected, rtol=1e-5, atol=1e-4)
    read = len(lengths)
    assert read > once
    np.testing.assert_array_equal(every(exact, level), expected)  # which are still kept
    np.testing.assert_array_equal(every(exact.with_options(error=50.0), level), coarse)
    np.testing.assert_array_equal(every(exact.with_options(error=1e-9), level), expected)
    assert len(lengths) > read
    with pytest.raises(OptionError, match="expected a scale that is not 0"):
        exact.with_options(scale=0.0)


def test_the_error_is_of_metres_whatever_the_unit() -> None:
    """Heights in feet: as many layers as for the same number of metres."""
    heights = np.random.default_rng(1).integers(-9, 10, (150, 140)).cumsum(0).cumsum(1).astype(np.int16)
    place = utm("EPSG:32633", 5e5, 5e6, 10)
    metres, feet = field_of(heights, place), field_of(heights, place | {"unit": "ft"})
    for error in (5.0, 30.0):
        found = every(metres.with_options(error=error), metres.levels)
        in_feet = every(feet.with_options(error=error * 0.3048), feet.levels)
        np.testing.assert_allclose(in_feet, found * 0.3048, rtol=1e-5, atol=1e-4)
        assert np.nanmax(np.abs(found - every(metres, metres.levels))) <= error


def test_tiles_of_mountains() -> None:
    """Of the zoom of the cells, which takes the finest level, and of a coarser one; and meshes."""
    field, _ = bigtujunga()
    west, south, east, north = field.bounds
    finest = field.placement.web_zoom()
    for zoom, factor in ((finest, 1.0), (finest - 2, COARSER)):
        x, y = (int(place) // 256 for place in pixel_of((west + east) / 2, (south + north) / 2, zoom))
        exact = decoded(web_tile(field, zoom, x, y, encoding="terrarium"), "terrarium")
        sizes = []
        for error in (2.0, 10.0, 100.0):
            off = field.with_options(error=error)
            tile = web_tile(off, zoom, x, y, encoding="terrarium")
            assert np.abs(decoded(tile, "terrarium") - exact).max() <= error * factor + 1 / 128
            sizes.append(len(tile))
        assert sizes == sorted(sizes, reverse=True)  # what is smoother takes fewer bytes
    zoom = field.placement.mesh_zoom()
    x, y = int((west + east + 360) / 360 * 2**zoom), int((south + north + 180) / 360 * 2**zoom)
    assert mesh_tile(field.with_options(error=10.0), zoom, x, y) != mesh_tile(field, zoom, x, y)


def test_an_error_may_be_relative_to_the_range_of_all_heights() -> None:
    """Whatever metres one unit of the heights has."""
    field, _ = opened()
    heights = every(field, field.levels)
    extent = float(np.nanmax(heights) - np.nanmin(heights))
    found = []
    for percent in (0.1, 1.0, 10.0):
        found.append(every(field.with_options(error=f"{percent}%"), field.levels))
        np.testing.assert_array_equal(found[-1], every(field.with_options(error=percent / 100 * extent), field.levels))
        relative = ls.Tolerance(percent / 100, relative=True)
        in_feet = every(field.with_options(error=relative, scale=0.3048), field.levels)
        np.testing.assert_allclose(in_feet, found[-1] * np.float32(0.3048), rtol=1e-6, atol=1e-3)
    assert not np.array_equal(found[0], found[-1])


@pytest.mark.parametrize("error", [-1.0, float("nan"), float("inf"), "much", "-1%"])
def test_an_error_that_is_none_is_refused(error: float | str) -> None:
    with pytest.raises(OptionError, match=r"expected an error of 0 or more|is not an error bound: write 0 or more"):
        opened(error=error)


def test_a_cache_that_fields_share_tells_their_errors_apart() -> None:
    data, cache = container(), BlockCache()

    def read(offset: int, length: int) -> bytes:
        return data[offset : offset + length]

    made = [every(HeightField(read, len(data), error=error, cache=cache), 5) for error in (0.0, 100.0, 0.0)]
    assert (made[0] == made[2])[np.isfinite(made[0])].all()
    assert np.nanmax(np.abs(made[0] - made[1])) > 1
