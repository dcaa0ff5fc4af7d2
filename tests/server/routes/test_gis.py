"""What GDAL opens by an address, as docs/gis.md and docs/maps.md say: levels with ranges, place, holes; map tiles."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from tests.patience import PATIENCE
from tests.server.helpers import Keys, hills, push
from tests.server.programs import server

rasterio = pytest.importorskip("rasterio")

DOCS = Path(__file__).parents[3] / "docs"
PAGE = (DOCS / "gis.md").read_text()
ADDRESS = "https://maps.example.org/v1/surfaces/5f1c0a9b3d7e42a68c10/levels/7?format=cog"
PLACE = [500000.0, 30.0, 0.0, 4100000.0, 0.0, -30.0]


@pytest.fixture(autouse=True)
def _no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1,localhost")


def terrain() -> ls.Surface:
    """Heights that need several tiles, with a hole and a place."""
    heights = hills(700, 600) + np.random.default_rng(1).normal(size=(700, 600)).astype(np.float32)
    mask = np.ones(heights.shape, np.bool_)
    mask[5:60, 10:80] = False
    crs = rasterio.crs.CRS.from_epsg(32611).to_wkt()
    return ls.Surface(heights, mask=mask, metadata={"geotransform": PLACE, "crs": crs, "unit": "m", "name": "hill"})


@pytest.fixture(scope="module")
def place(keys: Keys) -> Iterator[tuple[str, str]]:
    """A server that asks for tokens, and the address of a surface's finest level on it."""
    # In a process of its own: rasterio holds the interpreter's lock while it opens an address.
    with server(keys.folder / "gis", token_file=str(keys.folder / "tokens.json")) as running:
        url = running.url
        headers = {"authorization": f"Bearer {keys.tokens['admin']}"}
        with httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE, headers=headers) as http:
            surface = push(http, ls.encode(terrain()))
            yield f"{url}{surface['url']}/levels/{len(surface['levels']) - 1}", keys.tokens["read"]


@pytest.fixture
def authorised(place: tuple[str, str]) -> Iterator[str]:
    """The address of the level, while GDAL sends the token."""
    address, token = place
    with rasterio.Env(GDAL_HTTP_HEADERS=f"Authorization: Bearer {token}"):
        yield address


def read(address: str) -> tuple[Any, NDArray[Any], NDArray[Any]]:
    with rasterio.open(f"/vsicurl/{address}") as dataset:
        return dataset.profile, dataset.read(1), dataset.read_masks(1) > 0


@pytest.mark.parametrize("name", ["tif", "tiff", "geotiff", "cog", "cog.tif"])
def test_gdal_opens_a_level_by_its_address(authorised: str, name: str) -> None:
    profile, heights, valid = read(f"{authorised}?format={name}")
    surface = terrain()
    assert surface.mask is not None
    np.testing.assert_array_equal(valid, surface.mask)
    np.testing.assert_array_equal(heights[valid], surface.points[surface.mask])
    assert profile["crs"] == rasterio.crs.CRS.from_epsg(32611)
    assert list(profile["transform"].to_gdal()) == PLACE
    assert profile["tiled"]


def test_a_cog_is_read_by_ranges_and_has_overviews(authorised: str, place: tuple[str, str]) -> None:
    address = f"{authorised}?format=cog"
    with rasterio.open(f"/vsicurl/{address}") as dataset:
        assert dataset.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert dataset.overviews(1) == [2]
        coarse = dataset.read(1, out_shape=(350, 300))
    assert abs(np.nanmean(coarse) - np.mean(terrain().points[terrain().mask])) < 0.5
    with httpx.Client(trust_env=False, timeout=PATIENCE, headers={"authorization": f"Bearer {place[1]}"}) as http:
        head = http.head(address)
        assert (head.status_code, head.content, head.headers["accept-ranges"]) == (200, b"", "bytes")
        assert head.headers["content-type"] == "image/tiff; application=geotiff; profile=cloud-optimized"
        assert '.cog.tif"' in head.headers["content-disposition"]
        part = http.get(address, headers={"range": "bytes=0-15"})
        assert (part.status_code, part.content[:4]) == (206, b"II*\0")
        assert part.headers["content-range"] == f"bytes 0-15/{head.headers['content-length']}"
        same = http.get(address.replace("cog", "cog.tif"), headers={"if-none-match": head.headers["etag"]})
        assert same.status_code == 304


@pytest.mark.skipif("netCDF" not in rasterio.drivers.raster_driver_extensions().values(), reason="GDAL has no netCDF")
def test_a_netcdf_has_its_place_where_its_address_ends_like_one(authorised: str) -> None:
    assert "?format=nc&name=level.nc" in PAGE
    profile, heights, valid = read(f"{authorised}?format=nc&name=level.nc")
    surface = terrain()
    assert surface.mask is not None
    assert profile["crs"] == rasterio.crs.CRS.from_epsg(32611)
    assert list(profile["transform"].to_gdal()) == PLACE
    np.testing.assert_array_equal(heights[valid], surface.points[surface.mask])


@pytest.mark.long
def test_the_finest_level_has_the_columns_of_the_source_and_what_has_no_cog_says_why(keys: Keys) -> None:
    lon = np.linspace(0, 360, 37)
    lat = np.linspace(80, -80, 17)
    heights = np.cos(np.radians(lon)) * lat[:, None]
    heights[:, -1] = heights[:, 0]
    earth = ls.Surface(
        heights[:, :-1], (False, True), metadata={"seam": "cols", "geotransform": [-5, 10, 0, 85, 0, -10]}
    )
    y, x = np.mgrid[:9, :9].astype(np.float64)
    curved = ls.Surface(np.stack([x + y**2, y + x**2, x * y], axis=2))
    two = ls.Surface(blocks=[curved.blocks[0], ls.Block(curved.points + 99)])
    with (
        server(keys.folder / "seam") as running,
        httpx.Client(base_url=running.url, trust_env=False, timeout=PATIENCE) as http,
    ):
        surface = push(http, ls.encode(earth))
        for level, columns in ((-1, 37), (-2, 18)):
            number = surface["levels"][level]["level"]
            with rasterio.open(f"/vsicurl/{running.url}{surface['url']}/levels/{number}?format=cog") as dataset:
                assert dataset.width == columns
        for other, words in ((curved, "that are not"), (two, "one block")):
            answer = http.get(f"{push(http, ls.encode(other))['url']}/levels/0?format=cog")
            assert answer.status_code == 422
            assert answer.json()["title"] == "The file cannot be read, or the level not be written, in this format"
            assert words in answer.json()["detail"]
            assert answer.json()["title"] in PAGE


def test_a_coarser_level_covers_the_same_ground(authorised: str) -> None:
    finest = int(authorised.rsplit("/", 1)[1])
    bounds = []
    for level in (finest, finest - 2):
        with rasterio.open(f"/vsicurl/{authorised.rsplit('/', 1)[0]}/{level}?format=tif") as dataset:
            bounds.append(np.array(dataset.bounds))
            step = dataset.res[0]
    # Its cells are larger, and stand around the same outer nodes.
    np.testing.assert_allclose(bounds[1], bounds[0], atol=step)


def test_without_a_token_gdal_is_refused(place: tuple[str, str]) -> None:
    with pytest.raises(rasterio.errors.RasterioIOError):
        read(f"{place[0]}?format=tif&without=token")


def test_the_lines_of_the_page(place: tuple[str, str], capsys: pytest.CaptureFixture[str]) -> None:
    blocks = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert len(blocks) == 2
    assert ADDRESS in blocks[0]
    address, token = place
    names: dict[str, Any] = {"token": token}
    with rasterio.Env(GDAL_HTTP_HEADERS=f"Authorization: Bearer {token}"):
        exec(textwrap.dedent(blocks[0]).replace(ADDRESS, f"{address}?format=cog"), names)
    assert names["heights"].shape == names["coarse"].shape == (256, 256)
    assert "EPSG:32611" in capsys.readouterr().out
    exec(blocks[1], names)
    assert names["heights"].shape == (700, 600)


def test_the_formats_of_the_page_are_written() -> None:
    named = re.findall(r"^\| `(\w+)` ", PAGE, re.MULTILINE)
    assert named
    for name in named:
        assert ls.formats.written(name).write is not None


@pytest.mark.long
def test_gdal_reads_tiles_of_a_map_by_the_file_of_the_page(authorised: str, tmp_path: Path) -> None:
    maps, warp = pytest.importorskip("lodestream.maps"), pytest.importorskip("rasterio.warp")
    container = ls.encode(terrain())
    field = maps.HeightField(lambda offset, length: container[offset : offset + length], len(container))
    (text,) = re.findall(r"^```xml\n(.*?)^```", (DOCS / "maps.md").read_text(), re.DOTALL | re.MULTILINE)
    place, zoom = authorised.rpartition("/levels/")[0], field.placement.web_zoom()
    file = tmp_path / "hill.xml"
    text = text.replace("https://maps.example.org/v1/names/hill", place)
    file.write_text(text.replace("<TileLevel>12<", f"<TileLevel>{zoom}<"))
    west, south, east, north = field.bounds
    with rasterio.open(file) as dataset:
        ((x,), (y,)) = warp.transform("EPSG:4326", dataset.crs, [(west + east) / 2], [(south + north) / 2])
        row, column = dataset.index(x, y)
        red, green, blue = dataset.read(window=((row, row + 100), (column, column + 100))).astype(float)
        xs, _ = dataset.xy(np.full(100, row), column + np.arange(100))
        _, ys = dataset.xy(row + np.arange(100), np.full(100, column))
        longitudes, _ = warp.transform(dataset.crs, "EPSG:4326", xs, np.full(100, y))
        _, latitudes = warp.transform(dataset.crs, "EPSG:4326", np.full(100, x), ys)
    expected = field.heights(np.array(longitudes), np.array(latitudes))
    np.testing.assert_allclose(red * 256 + green + blue / 256 - 32768, expected, atol=0.01)
