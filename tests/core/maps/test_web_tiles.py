"""Tiles of Web Mercator, as clients and GDAL read them."""

from __future__ import annotations

import math
import warnings
from pathlib import Path

import numpy as np
import pytest

from lodestream.errors import OptionError
from lodestream.maps import png, shaded, terrain_rgb, terrarium, web_tile, webp
from lodestream.maps.tile_grids import box_of_web, web_grid
from lodestream.maps.web_tiles import Encoding

from .fields import (
    PLANE_CODE,
    PLANE_CORNER,
    PLANE_STEP,
    WORLD,
    Mosaic,
    bigtujunga,
    decoded,
    errors_by_gdal,
    image,
    nodes_of,
    on_earth,
    pixel_of,
    plane,
    plane_height,
    tiles_of_plane,
)


@pytest.mark.parametrize(("encoding", "within"), [("terrain-rgb", 0.06), ("terrarium", 0.01)])
@pytest.mark.parametrize("size", [256, 512])
def test_a_plane_at_200_nodes(encoding: Encoding, within: float, size: int) -> None:
    field = plane()
    rows, columns = nodes_of(field, 200)
    places = [
        on_earth(PLANE_CODE, PLANE_CORNER[0] + PLANE_STEP * c, PLANE_CORNER[1] - PLANE_STEP * r)
        for r, c in zip(rows, columns, strict=True)
    ]
    mosaic = Mosaic(field, field.placement.web_zoom(size), encoding, size=size)
    found = mosaic.heights(*np.array(places).T)
    assert np.abs(found - plane_height(rows, columns)).max() <= within


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_a_plane_from_coarser_levels(steps: int) -> None:
    """Whose nodes are not even: as even ones they would be up to 3 m off."""
    field = plane()
    rows, columns = nodes_of(field, 50, margin=40)
    places = [
        on_earth(PLANE_CODE, PLANE_CORNER[0] + PLANE_STEP * c, PLANE_CORNER[1] - PLANE_STEP * r)
        for r, c in zip(rows, columns, strict=True)
    ]
    z = field.placement.web_zoom() - steps
    assert field.level_for(web_grid(z, 0, (1 << z) * 2 // 5).metres) <= field.levels - steps + 1
    found = Mosaic(field, z, "terrarium").heights(*np.array(places).T)
    assert np.abs(found - plane_height(rows, columns)).max() <= 0.01


@pytest.mark.parametrize("encoding", ["terrain-rgb", "terrarium"])
def test_mountains_at_200_nodes(encoding: Encoding) -> None:
    field, heights = bigtujunga()
    rows, columns = nodes_of(field, 200)
    transform = [376313.6554542635, 30.0, 3807917.8276283755, -30.0]
    places = [
        on_earth("EPSG:32611", transform[0] + (c + 0.5) * transform[1], transform[2] + (r + 0.5) * transform[3])
        for r, c in zip(rows, columns, strict=True)
    ]
    found = Mosaic(field, field.placement.web_zoom(), encoding).heights(*np.array(places).T)
    assert np.isfinite(found).all()
    assert np.sqrt(((found - heights[rows, columns]) ** 2).mean()) <= 1.0


@pytest.mark.parametrize("driver_zoom", [10, 12])
@pytest.mark.long
def test_gdal_reads_terrarium_by_its_driver_of_tiles(driver_zoom: int, tmp_path: Path) -> None:
    """With numbers of rows and columns of its own, from files, as its WMS driver for TMS does from servers."""
    field = plane()
    for x, y in tiles_of_plane(driver_zoom):
        path = tmp_path / str(driver_zoom) / str(x) / f"{y}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(web_tile(field, driver_zoom, x, y, encoding="terrarium"))
    errors = errors_by_gdal(f"{tmp_path.as_uri()}/{{z}}/{{x}}/{{y}}.png", driver_zoom)
    assert len(errors) >= 200
    assert np.abs(errors).max() <= 0.01


def test_colours_are_those_of_their_specifications() -> None:
    heights = np.array([[-9999.9, -0.04, 0.0, 8848.86, 99999.0, -20000.0, np.nan]], np.float32)
    by_tenths = decoded(png(terrain_rgb(heights, nodata=7)), "terrain-rgb")
    np.testing.assert_allclose(by_tenths, [[-9999.9, 0, 0, 8848.9, 99999.0, -9999.9, 7]], rtol=0, atol=1e-6)
    fine = decoded(png(terrarium(heights[:, :4])), "terrarium")
    np.testing.assert_allclose(fine, heights[:, :4], rtol=0, atol=1 / 512 + 1e-3)
    assert terrarium(heights)[0, 4].tolist() == [255, 255, 255]  # as high as it goes


@pytest.mark.parametrize("bands", [1, 2, 3, 4])
def test_images_come_back_as_they_were(bands: int) -> None:
    pixels = np.random.default_rng(bands).integers(0, 256, (17, 33, bands)).astype(np.uint8)
    np.testing.assert_array_equal(image(png(pixels)), pixels)
    colours = pixels if bands > 2 else np.concatenate((np.repeat(pixels[..., :1], 3, axis=2), pixels[..., 1:]), axis=2)
    read = image(webp(colours if bands > 2 else pixels))
    opaque = colours[..., 3:] > 0 if bands in (2, 4) else np.True_
    np.testing.assert_array_equal(np.where(opaque, read, 0), np.where(opaque, colours, 0))


def test_a_webp_has_the_same_heights() -> None:
    field = plane()
    z = field.placement.web_zoom()
    west, south, east, north = field.bounds
    x, y = (int(place) // 256 for place in pixel_of((west + east) / 2, (south + north) / 2, z))
    plain, small = (web_tile(field, z, x, y, image=kind) for kind in ("png", "webp"))
    np.testing.assert_array_equal(image(plain), image(small))
    assert len(small) < len(plain)


def test_a_relief_is_lit_from_the_north_west() -> None:
    rows, columns = np.mgrid[0:9.0, 0:9.0]
    grey = {
        name: int(shaded(10 * slope, 30.0)[3, 3, 0])
        for name, slope in (
            ("level", 0 * rows),
            ("to the north-west", columns + rows),
            ("to the south-east", -columns - rows),
            ("to the north-east", rows - columns),
        )
    }
    assert grey["level"] == round(255 * math.sin(math.radians(45)))
    assert grey["to the north-west"] > grey["level"] > grey["to the south-east"]
    expected = math.cos(math.radians(45)) / math.sqrt(1 + 2 / 9)  # lit from its side
    assert grey["to the north-east"] == pytest.approx(255 * expected, abs=1)
    holed = np.full((5, 5), 1000.0)
    holed[2, 2] = np.nan
    picture = shaded(holed, 30.0)
    assert picture[1, 1].tolist() == [0, 0]
    assert (np.delete(picture.reshape(-1, 2), 4, axis=0) == [180, 255]).all()


def test_a_relief_goes_on_from_tile_to_tile() -> None:
    """One tile of 512 pixels is four of 256: no line shows where they meet."""
    field = plane()
    z = field.placement.web_zoom() - 2
    west, south, east, north = field.bounds
    x, y = (int(place) // 512 for place in pixel_of((west + east) / 2, (south + north) / 2, z, 512))
    whole = image(web_tile(field, z, x, y, encoding="shade", size=512))
    rows = [
        np.concatenate([image(web_tile(field, z + 1, 2 * x + j, 2 * y + i, encoding="shade")) for j in (0, 1)], axis=1)
        for i in (0, 1)
    ]
    np.testing.assert_allclose(np.concatenate(rows).astype(int), whole.astype(int), rtol=0, atol=1)


def test_grids_of_tiles() -> None:
    grid = web_grid(3, 5, 2, 4, margin=1)
    west, south, east, north = box_of_web(3, 5, 2)
    assert (west, east) == (45, 90)
    np.testing.assert_allclose(grid.longitudes, 45 + 45 / 4 * (np.arange(-1, 5) + 0.5))
    assert (np.diff(grid.latitudes) < 0).all()
    assert grid.latitudes[0] > north > grid.latitudes[1]
    assert grid.latitudes[-1] < south < grid.latitudes[-2]
    assert web_grid(0, 0, 0, 2).metres == pytest.approx(WORLD)  # at the equator


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"encoding": "colour"}, "expected an encoding of terrain-rgb, terrarium, shade, got 'colour'"),
        ({"image": "jpeg"}, "expected an image of png or webp, got 'jpeg'"),
        ({"size": 300}, "expected tiles of 256 or 512 pixels, got 300"),
    ],
)
def test_options_that_there_are_not(options: dict[str, object], words: str) -> None:
    with pytest.raises(OptionError, match=words), warnings.catch_warnings():
        web_tile(plane(), 0, 0, 0, **options)  # type: ignore[arg-type]
