"""Unmodified MapLibre GL JS with containers of a host of files, by `addProtocol`."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

from lodestream.maps import HeightField, crs_wkt, terrain_rgb, terrarium
from lodestream.maps.tile_grids import web_grid
from lodestream_client.demo import site
from tests.client.files import Ranged, ranged
from tests.core.maps.fields import pixel_of
from tests.core.surfaces import terrain

from .browser import Tab
from .conftest import WEB, Tabs
from .map_pages import MAPS, VIEW, greys, heights_at, maplibre, mountains, plane, write


@pytest.fixture(scope="module")
def host(tmp_path_factory: pytest.TempPathFactory, library: Path) -> Iterator[Ranged]:
    """A host of files with pages, the packages, and hills with a hole."""
    folder = tmp_path_factory.mktemp("maps")
    pages = (MAPS / "terrain.html", WEB / "examples" / "map.html")
    packages = (*library.glob("*.js"), WEB / "node_modules/proj4/dist/proj4.js")
    for path in (*pages, *packages, *maplibre()):
        shutil.copy(path, folder)
    (folder / "favicon.ico").write_bytes(b"")
    hills = terrain((481, 611), 4)
    hills[40:90, 200:300] = np.nan
    write(folder / "surface.lode", hills, {"crs": crs_wkt("EPSG:4326"), "geotransform": [8, 3e-4, 0, 47, 0, -3e-4]})
    with ranged(folder) as server:
        yield server


def shown(tabs: Tabs, host: Ranged, dem: dict[str, Any], **camera: Any) -> Tab:
    """The page with terrain, once it has drawn all."""
    asked = quote(json.dumps({"dem": {"type": "raster-dem", **dem}, **camera}))
    tab = tabs(f"{host.url}/terrain.html#{asked}", size=VIEW)
    tab.page.wait_for_function("window.idle")
    assert tab.page.evaluate("window.errors") == []
    return tab


def in_address(tab: Tab) -> list[float]:
    """Zoom, latitude and longitude of a map, which come into its address a moment after they are seen."""
    return [float(number) for number in (tab.page.url.partition("#")[2] or "0/0/0").split("/")[:3]]


def field_of(path: Path) -> HeightField:
    return HeightField.open(path)


@pytest.mark.parametrize(("encoding", "within"), [("terrain-rgb", 0.06), ("terrarium", 0.01)])
def test_a_plane_at_200_nodes(tabs: Tabs, host: Ranged, encoding: str, within: float) -> None:
    nodes = plane(host.folder / "plane.lode")
    dem = {"url": f"lode://{host.url}/plane.lode?encoding={encoding}"}
    tab = shown(tabs, host, dem, center=nodes.middle, zoom=nodes.zoom)
    assert np.abs(heights_at(tab, nodes.places) - nodes.heights).max() <= within


@pytest.mark.parametrize("encoding", ["terrain-rgb", "terrarium"])
def test_mountains_at_200_nodes(tabs: Tabs, host: Ranged, encoding: str) -> None:
    nodes = mountains(host.folder / "bigtujunga.lode")
    dem = {"url": f"lode://{host.url}/bigtujunga.lode?encoding={encoding}"}
    tab = shown(tabs, host, dem, center=nodes.middle, zoom=nodes.zoom)
    found = heights_at(tab, nodes.places)
    assert np.isfinite(found).all()
    assert np.sqrt(((found - nodes.heights) ** 2).mean()) <= 1.0


# As a page reads a picture, and as MapLibre's workers do.
_PIXELS = """async ([address, where]) => {
  const { data } = await lode({ url: address, type: "image", headers: {} }, new AbortController());
  const { width, height } = data;
  const canvas = new OffscreenCanvas(width, height);
  const own = Object.assign(document.createElement("canvas"), { width, height });
  const context = (where === "page" ? own : canvas).getContext("2d");
  context.drawImage(data, 0, 0);
  const pixels = context.getImageData(0, 0, width, height).data;
  return btoa(Array.from(pixels, (byte) => String.fromCharCode(byte)).join(""));
}"""


@pytest.mark.parametrize("where", ["page", "worker"])
def test_pictures_have_the_bytes_of_the_python_library(tabs: Tabs, host: Ranged, where: str) -> None:
    """Which a canvas gives back as they are: nothing is premultiplied, no colour is converted."""
    field = field_of(host.folder / "surface.lode")
    west, south, east, north = field.bounds
    z = field.placement.web_zoom()
    x, y = (int(place) // 256 for place in pixel_of(west + 0.45 * (east - west), north - 0.1 * (north - south), z))
    tab = shown(tabs, host, {"url": f"lode://{host.url}/surface.lode"}, center=[8.1, 46.9], zoom=8)
    grid = web_grid(z, x, y)
    heights = field.heights(grid.longitudes, grid.latitudes, metres=grid.metres)
    assert np.isnan(heights).any()
    for encoding, colours in (("terrain-rgb", terrain_rgb), ("terrarium", terrarium)):
        address = f"lode://{host.url}/surface.lode/{z}/{x}/{y}?encoding={encoding}&nodata=12.5"
        pixels = np.frombuffer(base64.b64decode(tab.page.evaluate(_PIXELS, [address, where])), np.uint8)
        assert (pixels[3::4] == 255).all()
        other = pixels.reshape(256, 256, 4)[..., :3] != colours(heights, 12.5)
        assert np.count_nonzero(other) <= 2  # a millionth of a metre may be another step


def test_ten_lines_of_html_show_a_container_on_a_map(tabs: Tabs, host: Ranged) -> None:
    example = (WEB / "examples" / "map.html").read_text()
    assert len([line for line in example.splitlines() if line]) == 10
    assert f"```html\n{example}```" in (WEB.parents[1] / "docs" / "maps.md").read_text()
    host.requests.clear()
    tab = tabs(f"{host.url}/map.html", size=VIEW)
    tab.until(lambda: len(greys(tab)) > 100)
    tab.until(lambda: in_address(tab)[0] > 10)
    assert in_address(tab)[1:] == pytest.approx([46.93, 8.09], abs=0.02)
    assert any(asked is not None for _, asked in host.requests)


def test_the_public_demo_has_a_map(tabs: Tabs, library: Path, tmp_path: Path) -> None:
    pages = tmp_path / "map"
    pages.mkdir()
    for path in (WEB / "examples" / "map.html", *library.glob("*.js"), *maplibre()):
        shutil.copy(path, pages)
    assert site.main([str(tmp_path / "site"), str(pages)]) == 0
    (tmp_path / "site" / "favicon.ico").write_bytes(b"")
    with ranged(tmp_path / "site") as server:
        tab = tabs(f"{server.url}/map/index.html", size=VIEW)
        tab.until(lambda: len(greys(tab)) > 100)
        tab.until(lambda: in_address(tab)[0] > 9)


def test_what_is_missing_is_an_error_of_the_map(tabs: Tabs, host: Ranged) -> None:
    write(host.folder / "nowhere.lode", terrain((40, 40), 4), {})
    asked = quote(json.dumps({"dem": {"type": "raster-dem", "url": f"lode://{host.url}/nowhere.lode"}}))
    tab = tabs(f"{host.url}/terrain.html#{asked}", size=VIEW)
    tab.page.wait_for_function("window.errors?.length")
    assert "expected heights with a CRS" in tab.page.evaluate("window.errors")[0]
