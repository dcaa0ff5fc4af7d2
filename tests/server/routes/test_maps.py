"""Tiles over HTTP: what is told, what is kept for how long, and what is refused."""

from __future__ import annotations

import gzip
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import lodestream as ls
from lodestream_server import running_server
from lodestream_server.builds import tiles
from lodestream_server.builds.answers import Refusal
from lodestream_server.builds.tiles import MadeTile, TileOrder
from tests.server.helpers import PATIENCE, hills, npy, problem, push

pytest.importorskip("pyproj")
maps = pytest.importorskip("lodestream.maps")


def terrain(seed: int = 0) -> bytes:
    """A container of heights with a position: 100 x 120 nodes, 0.01 degrees apart, around 46 N 7 E."""
    surface = ls.Surface(hills(100, 120, seed=seed) * 100)
    surface.metadata |= {"crs": maps.crs_wkt("EPSG:4326"), "geotransform": [7, 0.01, 0, 46, 0, -0.01]}
    return ls.encode(surface)


@pytest.fixture(scope="module")
def http(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    with (
        running_server(tmp_path_factory.mktemp("maps"), workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as made,
    ):
        yield made


@pytest.fixture(scope="module")
def hill(http: httpx.Client) -> dict[str, Any]:
    return push(http, terrain(), filename="hill.lode")


@pytest.fixture(scope="module")
def field(tmp_path_factory: pytest.TempPathFactory) -> Any:
    path = tmp_path_factory.mktemp("field") / "hill.lode"
    path.write_bytes(terrain())
    return maps.HeightField.open(path)


def test_a_map_finds_its_tiles_by_the_document(http: httpx.Client, hill: dict[str, Any], field: Any) -> None:
    for encoding in ("terrain-rgb", "terrarium", "shade"):
        described = http.get(f"{hill['url']}/map.json", params={"encoding": encoding}).raise_for_status()
        assert described.headers["cache-control"] == "private, no-cache"
        told = described.json()
        assert told["bounds"] == pytest.approx([7, 45, 8.2, 46], abs=0.01)
        z = told["maxzoom"]
        x, y = int((7.5 + 180) / 360 * 2**z), int((1 - np.arcsinh(np.tan(np.radians(45.5))) / np.pi) / 2 * 2**z)
        address = told["tiles"][0].format(z=z, x=x, y=y)
        assert address.startswith(str(http.base_url))
        tile = http.get(address).raise_for_status()
        assert tile.headers["content-type"] == "image/png"
        assert tile.headers["cache-control"] == "private, max-age=31536000, immutable"
        assert tile.content == maps.web_tile(field, z, x, y, encoding=encoding)
        assert http.get(address, headers={"if-none-match": tile.headers["etag"]}).status_code == 304


def test_a_globe_finds_its_meshes_by_the_document(http: httpx.Client, hill: dict[str, Any], field: Any) -> None:
    told = http.get(f"{hill['url']}/terrain/layer.json").raise_for_status().json()
    place = f"{hill['url']}/terrain/" + told["tiles"][0]
    (tiles,) = told["available"][6]
    for z, x, y in ((0, 0, 0), (0, 1, 0), (6, tiles["startX"], tiles["startY"])):
        plain = http.get(place.format(z=z, x=x, y=y), headers={"accept-encoding": "identity"}).raise_for_status()
        assert plain.content == maps.mesh_tile(field, z, x, y, normals=False)
        assert "content-encoding" not in plain.headers
        headers = {"accept": "application/vnd.quantized-mesh;extensions=octvertexnormals"}
        with http.stream("GET", place.format(z=z, x=x, y=y), headers=headers) as packed:
            assert packed.headers["content-encoding"] == "gzip"
            assert gzip.decompress(b"".join(packed.iter_raw())) == maps.mesh_tile(field, z, x, y)
        assert packed.headers["etag"] != plain.headers["etag"]
        assert packed.headers["vary"] == "accept, accept-encoding"
        unwanted = http.get(place.format(z=z, x=x, y=y), headers={"accept-encoding": "br, gzip;q=0"})
        assert "content-encoding" not in unwanted.headers


def test_options_reach_the_tiles(http: httpx.Client, hill: dict[str, Any], field: Any) -> None:
    options: dict[str, Any] = {"encoding": "terrarium", "size": "512", "nodata": "-12.5", "scale": "2.0"}
    told = http.get(f"{hill['url']}/map.json", params=options).raise_for_status().json()
    tile = http.get(told["tiles"][0].format(z=7, x=66, y=45)).raise_for_status()
    plain = http.get(f"{hill['url']}/tiles/7/66/45.png", params={"encoding": "terrarium"}).raise_for_status()
    assert tile.content != plain.content
    lifted = http.get(f"{hill['url']}/terrain/0/1/0.terrain", params={"offset": 40}).raise_for_status()
    assert lifted.content == maps.mesh_tile(field, 0, 1, 0, offset=40.0, normals=False)


@pytest.mark.parametrize("of", ["surfaces", "names"])
def test_tiles_may_be_off_by_an_error(http: httpx.Client, hill: dict[str, Any], field: Any, of: str) -> None:
    http.put("/v1/names/hilly", json={"surface": hill["id"]}).raise_for_status()
    place = hill["url"] if of == "surfaces" else "/v1/names/hilly"
    off = field.with_options(error=20.0)
    (address,) = http.get(f"{place}/map.json", params={"error": 20}).raise_for_status().json()["tiles"]
    assert "&error=20.0&v=" in address
    tile = http.get(address.format(z=7, x=66, y=45)).raise_for_status()
    assert "immutable" in tile.headers["cache-control"]
    assert tile.content == maps.web_tile(off, 7, 66, 45) != maps.web_tile(field, 7, 66, 45)
    exact = http.get(f"{place}/tiles/7/66/45.png").raise_for_status()
    assert exact.content == maps.web_tile(field, 7, 66, 45)
    assert exact.headers["etag"] != tile.headers["etag"]
    (address,) = http.get(f"{place}/terrain/layer.json", params={"error": 20}).raise_for_status().json()["tiles"]
    assert address.endswith("&error=20.0")
    mesh = http.get(f"{place}/terrain/{address.format(z=6, x=66, y=48)}").raise_for_status()
    assert mesh.content == maps.mesh_tile(off, 6, 66, 48, normals=False)
    assert mesh.content != maps.mesh_tile(field, 6, 66, 48, normals=False)


def test_the_error_of_tiles_may_be_relative(http: httpx.Client, hill: dict[str, Any], field: Any) -> None:
    off = field.with_options(error="5%")
    for place in ("map.json", "terrain/layer.json"):
        told = http.get(f"{hill['url']}/{place}", params={"error": "5.0%"}).raise_for_status().json()
        assert "error=5%25" in told["tiles"][0]
    (address,) = http.get(f"{hill['url']}/map.json", params={"error": "5%"}).json()["tiles"]
    tile = http.get(address.format(z=7, x=66, y=45)).raise_for_status()
    assert tile.content == maps.web_tile(off, 7, 66, 45) != maps.web_tile(field, 7, 66, 45)
    other = http.get(f"{hill['url']}/tiles/7/66/45.png", params={"error": "0.5e1%", "encoding": "terrain-rgb"})
    assert other.headers["etag"] == tile.headers["etag"]
    refused = http.get(f"{hill['url']}/map.json", params={"error": "5 m"}).json()["detail"]
    assert refused.startswith(
        "The parameter error of the query must be 0 or more metres, or 0.1% of the range of all heights, and is '5 m'"
    )


def test_documents_name_the_surface_as_lists_do_or_as_it_was_asked_for(http: httpx.Client) -> None:
    named = push(http, terrain(seed=5), filename="alps.lode", name="The Alps")
    http.put("/v1/names/alps", json={"surface": named["id"]}).raise_for_status()
    unnamed = push(http, terrain(seed=6), filename="hills.lode")
    for url, name in ((named["url"], "The Alps"), ("/v1/names/alps", "alps"), (unnamed["url"], "hills.lode")):
        for document in ("map.json", "terrain/layer.json"):
            assert http.get(f"{url}/{document}").raise_for_status().json()["name"] == name


def test_gdal_reads_terrarium_by_its_driver_of_tiles(http: httpx.Client) -> None:
    """At pixels of a tilted plane, in the zoom of its cells."""
    fields = pytest.importorskip("tests.core.maps.fields")
    heights = fields.plane_height(*np.mgrid[0:321, 0:598]).astype(np.float32)
    placed = fields.utm(fields.PLANE_CODE, *fields.PLANE_CORNER, fields.PLANE_STEP)
    surface = push(http, ls.encode(ls.Surface(heights, metadata=placed)), filename="plane.lode")
    told = http.get(f"{surface['url']}/map.json", params={"encoding": "terrarium"}).raise_for_status().json()
    errors = fields.errors_by_gdal(told["tiles"][0], told["maxzoom"])
    assert len(errors) >= 200
    assert np.abs(errors).max() <= 0.01


def test_a_name_has_tiles_of_the_version_to_which_it_leads(http: httpx.Client, hill: dict[str, Any]) -> None:
    other = push(http, terrain(seed=3), filename="other.lode")
    seen = set[str]()
    for surface in (hill, other):
        http.put("/v1/names/place", json={"surface": surface["id"]}).raise_for_status()
        (address,) = http.get("/v1/names/place/map.json").raise_for_status().json()["tiles"]
        assert "/v1/names/place/tiles/" in address
        tile = http.get(address.format(z=7, x=66, y=45)).raise_for_status()
        assert "immutable" in tile.headers["cache-control"]
        seen.add(address)
    # What was told of the surface before is not kept as if it were that.
    kept = sorted(http.get(each.format(z=7, x=66, y=45)).headers["cache-control"] for each in seen)
    assert kept == ["private, max-age=31536000, immutable", "private, no-cache"]


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("tiles/7/0/0.png", (404, "not-found")),
        ("tiles/30/0/0.png", (422, "bad-option")),
        ("tiles/7/66/4500.png", (422, "bad-option")),
        ("tiles/7/66/-1.png", (422, "bad-option")),
        ("tiles/99999999999999999999/0/0.png", (422, "bad-option")),
        (f"tiles/7/{'9' * 4200}/45.png", (422, "bad-option")),
        (f"terrain/7/-{'9' * 4200}/45.terrain", (422, "bad-option")),
        ("tiles/7/66/45.gif", (422, "bad-option")),
        ("tiles/7/66/45.png?size=300", (422, "bad-option")),
        ("tiles/7/66/45.png?nodata=nan", (422, "bad-option")),
        ("tiles/7/66/45.png?scale=0", (422, "bad-option")),
        ("tiles/7/66/45.png?scale=inf", (422, "bad-option")),
        ("tiles/7/66/45.png?error=-1", (422, "bad-option")),
        ("tiles/7/66/45.png?error=nan", (422, "bad-option")),
        ("terrain/6/66/48.terrain?error=much", (422, "bad-option")),
        ("map.json?encoding=jpeg", (422, "bad-option")),
        ("terrain/6/0/0.terrain", (404, "not-found")),
        ("terrain/40/0/0.terrain", (422, "bad-option")),
        ("terrain/6/0/0.terrain?offset=1e9", (422, "bad-option")),
    ],
)
def test_what_is_no_tile_is_refused(
    http: httpx.Client, hill: dict[str, Any], path: str, expected: tuple[int, str]
) -> None:
    assert problem(http.get(f"{hill['url']}/{path}")) == expected


def test_a_long_host_is_refused(tmp_path: Path) -> None:
    with (
        running_server(tmp_path, workers=1, public_reads=True) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        place = push(http, terrain(), filename="hill.lode")["url"]
        assert problem(http.get(f"{place}/map.json", headers={"host": "a" * 8000})) == (413, "too-large")
        assert http.get(f"{place}/map.json", headers=[(b"host", b"\xff" * 250)]).status_code == 200


def test_heights_beyond_all_numbers_are_no_failure(http: httpx.Client) -> None:
    surface = ls.Surface((hills(100, 120) - hills(100, 120).mean()) * 100)
    surface.metadata |= {"crs": maps.crs_wkt("EPSG:4326"), "geotransform": [7, 0.01, 0, 46, 0, -0.01]}
    url = push(http, ls.encode(surface), filename="hill.lode")["url"]
    for power in (30, 35, 36, 37, 300, -300):
        for path in ("terrain/6/66/48.terrain", "tiles/7/66/45.png"):
            http.get(f"{url}/{path}", params={"scale": f"1e{power}"}).raise_for_status()


def test_a_surface_without_a_place_says_what_it_lacks(http: httpx.Client) -> None:
    surface = push(http, npy(hills(30, 20)))
    answer = http.get(f"{surface['url']}/map.json")
    assert problem(answer) == (422, "bad-input")
    assert "CRS" in answer.json()["detail"]


def test_of_what_is_not_there_nothing_is_made(http: httpx.Client, tmp_path: Path) -> None:
    assert problem(http.get("/v1/surfaces/0123/map.json")) == (404, "not-found")
    assert problem(http.get("/v1/names/nobody/map.json")) == (404, "not-found")


def test_files_that_were_removed_take_no_room_for_long(tmp_path: Path) -> None:
    one, other = (tmp_path / name for name in ("one", "other"))
    fields = tiles._Fields(1 << 20, 1 << 20)

    def made(path: Path) -> MadeTile | Refusal:
        with path.open("rb") as file:
            return tiles.answer(fields, path.name, list(TileOrder("tile", 7, 66, 45)), file.fileno())

    def held() -> set[str]:
        found = set[str]()
        for name in os.listdir("/proc/self/fd"):
            with suppress(FileNotFoundError):  # a server of these tests may have closed it since
                found.add(Path(os.readlink(f"/proc/self/fd/{name}")).name)
        return found & {"one (deleted)"}

    for number, path in enumerate((one, other)):
        path.write_bytes(terrain(seed=number))
    first = made(one)
    assert isinstance(first, MadeTile)
    one.unlink()
    assert held()
    assert made(other) != first
    assert not held()
    one.write_bytes(terrain())
    assert made(one) == first
    for _, descriptor in fields._open.values():
        os.close(descriptor)
