"""Unmodified MapLibre GL JS and CesiumJS with surfaces of a server of another origin."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote
from xml.etree import ElementTree

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import expect

from lodestream_client import Client
from lodestream_server.access.tokens import TokenFile
from tests.client.files import ranged
from tests.server.programs import server

from .browser import Tab
from .conftest import Tabs
from .map_pages import MAPS, VIEW, Nodes, greys, heights_at, maplibre, mountains, plane
from .shown import Shelf
from .test_page_use import violations

_CESIUM = MAPS / "node_modules" / "cesium" / "Build" / "Cesium"

#: Metres from a globe's camera to the middle of a field.
_AWAY = 15_000

#: Says the heights of a globe at places, which it asks of the finest tiles there.
_SAMPLED = """places => Cesium.sampleTerrainMostDetailed(
  viewer.terrainProvider, places.map(([x, y]) => Cesium.Cartographic.fromDegrees(x, y)),
).then((found) => found.map(({ height }) => height ?? null))"""


class Served(NamedTuple):
    """A surface on a server, and the host of the pages that show it."""

    url: str
    pages: str
    folder: Path
    nodes: Nodes


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Served]]:
    """Surfaces, by name, on a server that anybody may read and that knows the origin of the pages."""
    assert _CESIUM.is_dir(), "expected CesiumJS: npm install --no-save in tests/web/maps"
    folder, data = tmp_path_factory.mktemp("pages"), tmp_path_factory.mktemp("server") / "data"
    for path in (MAPS / "served.html", MAPS / "globe.html", *maplibre()):
        shutil.copy(path, folder)
    (folder / "cesium").symlink_to(_CESIUM)
    (folder / "favicon.ico").write_bytes(b"")
    token, _ = TokenFile(data / "tokens.json").create("tests", ("read", "write"))
    kept: dict[str, Served] = {}
    with ranged(folder) as pages, server(data, public_reads=True, origins=[pages.url]) as running:

        def made(name: str) -> Served:
            if name not in kept:
                path = folder / f"{name}.lode"
                nodes = {"plane": plane, "bigtujunga": mountains}[name](path)
                kept[name] = Served(Client(running.url, token=token).upload(path).url, pages.url, folder, nodes)
            return kept[name]

        yield made


def on_a_map(tabs: Tabs, surface: Served, encoding: str, **camera: Any) -> Tab:
    """The page of MapLibre, once it has drawn all."""
    asked = {"url": f"{surface.url}/map.json?encoding={encoding}", **camera}
    tab = tabs(f"{surface.pages}/served.html#{quote(json.dumps(asked))}", size=VIEW)
    tab.page.wait_for_function("window.idle")
    assert tab.page.evaluate("window.errors") == []
    return tab


def on_a_globe(tabs: Tabs, surface: Served) -> Tab:
    """The page of CesiumJS, which looks at the middle of the nodes."""
    nodes = surface.nodes
    asked = {"url": f"{surface.url}/terrain", "place": nodes.middle, "height": nodes.heights.mean(), "away": _AWAY}
    tab = tabs(f"{surface.pages}/globe.html#{quote(json.dumps(asked))}", size=VIEW)
    tab.page.wait_for_function("window.ready")
    return tab


def sampled(tab: Tab, places: NDArray[np.float64]) -> NDArray[np.float64]:
    """What a globe says of places, as longitudes and latitudes, shape (N, 2)."""
    found = np.array(tab.page.evaluate(_SAMPLED, places.tolist()), np.float64)
    assert tab.page.evaluate("window.errors") == []
    return found


@pytest.mark.parametrize(("encoding", "within"), [("terrain-rgb", 0.06), ("terrarium", 0.01)])
def test_a_plane_on_a_map_at_200_nodes(
    tabs: Tabs, served: Callable[[str], Served], encoding: str, within: float
) -> None:
    surface = served("plane")
    nodes = surface.nodes
    tab = on_a_map(tabs, surface, encoding, center=nodes.middle, zoom=nodes.zoom)
    assert np.abs(heights_at(tab, nodes.places) - nodes.heights).max() <= within


@pytest.mark.parametrize("encoding", ["terrain-rgb", "terrarium"])
def test_mountains_on_a_map_at_200_nodes(tabs: Tabs, served: Callable[[str], Served], encoding: str) -> None:
    surface = served("bigtujunga")
    nodes = surface.nodes
    tab = on_a_map(tabs, surface, encoding, center=nodes.middle, zoom=nodes.zoom)
    assert _rms(heights_at(tab, nodes.places), nodes) <= 1.0


def test_a_plane_on_a_globe_at_200_nodes(tabs: Tabs, served: Callable[[str], Served]) -> None:
    surface = served("plane")
    found = sampled(on_a_globe(tabs, surface), surface.nodes.places)
    assert np.abs(found - surface.nodes.heights).max() <= 0.01


def test_mountains_on_a_globe_at_200_nodes(tabs: Tabs, served: Callable[[str], Served]) -> None:
    surface = served("bigtujunga")
    found = sampled(on_a_globe(tabs, surface), surface.nodes.places)
    assert _rms(found, surface.nodes) <= 1.0


def _rms(found: NDArray[np.float64], nodes: Nodes) -> float:
    assert np.isfinite(found).all()
    return float(np.sqrt(((found - nodes.heights) ** 2).mean()))


def test_mountains_are_seen(tabs: Tabs, served: Callable[[str], Served], tmp_path: Path) -> None:
    """Lit from one side, so that there are many greys."""
    surface = served("bigtujunga")
    for tab, name in (
        (on_a_map(tabs, surface, "terrarium", center=surface.nodes.middle, zoom=12, pitch=70), "map"),
        (on_a_globe(tabs, surface), "globe"),
    ):
        _wait_for_relief(tab)
        tab.page.screenshot(path=tmp_path / f"{name}.png")


def test_the_page_saves_what_opens_a_surface_elsewhere(
    tabs: Tabs, served: Callable[[str], Served], tmp_path: Path
) -> None:
    """The pages load a library from where the user says, and show the surface."""
    surface = served("bigtujunga")
    server, id_ = surface.url.split("/v1/surfaces/")
    tab = tabs(f"{server}/#s={id_}", size=(360, 600))
    page = tab.page
    page.get_by_role("button", name="Open in", exact=True).click()
    dialog = page.get_by_role("dialog", name="Open in")
    addresses = [dialog.locator("input[readonly]").nth(k).input_value() for k in range(4)]
    tiles = f"{surface.url}/tiles/{{z}}/{{x}}/{{y}}.png?encoding="
    expected = [f"{surface.url}/map.json", f"{surface.url}/terrain", f"{tiles}terrarium", f"{tiles}shade"]
    assert addresses == expected
    assert violations(tab) == []
    page.screenshot(path=tmp_path / "narrow.png")
    page.set_viewport_size({"width": 1000, "height": 800})
    page.screenshot(path=tmp_path / "dialog.png")
    dialog.get_by_label("Folder of MapLibre").fill("maplibre")  # no module has such an address
    dialog.get_by_role("button", name="Save a MapLibre page").click()
    assert dialog.locator("input:invalid").count() == 2
    for label, folder, button in (("MapLibre GL JS", ".", "MapLibre"), ("CesiumJS", "./cesium/", "CesiumJS")):
        dialog.get_by_label(f"Folder of {label}").fill(folder)
        with page.expect_download() as saved:
            dialog.get_by_role("button", name=f"Save a {button} page").click()
        name = saved.value.suggested_filename
        saved.value.save_as(surface.folder / name)
        elsewhere = tabs(f"{surface.pages}/{name}", size=VIEW)
        _wait_for_relief(elsewhere)
        elsewhere.page.screenshot(path=tmp_path / f"{name}.png")
    with page.expect_download() as saved:
        dialog.get_by_role("button", name="Save a QGIS connection").click()
    saved.value.save_as(tmp_path / "connection.xml")
    (connection,) = ElementTree.parse(tmp_path / "connection.xml").getroot()
    assert connection.get("url") == expected[2]
    assert connection.get("interpretation") == "terrariumterrain"
    dialog.get_by_role("button", name="Close").click()
    expect(dialog).to_have_count(0)


def test_what_has_no_place_on_the_earth_is_opened_nowhere_else(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("terrain"))
    tab.everything_is_here()
    expect(tab.page.get_by_role("button", name="Copy link")).to_be_visible()
    expect(tab.page.get_by_role("button", name="Open in", exact=True)).to_be_hidden()


def _wait_for_relief(tab: Tab) -> None:
    tab.until(lambda: len(greys(tab)) > 100)
