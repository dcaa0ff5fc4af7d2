"""Tiles, meshes and levels of what is in a bucket, at the server that writes and at one that only reads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

import lodestream as ls
from lodestream_server import running_server
from tests.patience import PATIENCE
from tests.server.helpers import eventually, hills, npy, problem, push
from tests.stores.emulators import Emulator, ministack, s3
from tests.stores.faults import FaultProxy, fault_proxy
from tests.stores.memory import memory

__all__ = ["memory", "ministack", "s3"]

pytest.importorskip("pyproj")
maps = pytest.importorskip("lodestream.maps")


def terrain() -> bytes:
    """A container of heights with a position: 100 x 120 nodes, 0.01 degrees apart, around 46 N 7 E."""
    surface = ls.Surface(hills(100, 120) * 100)
    surface.metadata |= {"crs": maps.crs_wkt("EPSG:4326"), "geotransform": [7, 0.01, 0, 46, 0, -0.01]}
    return ls.encode(surface)


@pytest.fixture
def bucket(s3: Emulator, monkeypatch: pytest.MonkeyPatch) -> Iterator[FaultProxy]:
    """What all requests to the bucket go through."""
    with fault_proxy(s3.port) as proxy:
        for name, value in s3.at(proxy.port).items():
            monkeypatch.setenv(name, value)
        yield proxy


@contextmanager
def serving(address: str, scratch: Path, **settings: Any) -> Iterator[httpx.Client]:
    """A server of a bucket."""
    usual = {"workers": 1, "look_seconds": 0.2, "scratch": scratch}
    with (
        running_server(address, **(usual | settings)) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        yield http


def writes(http: httpx.Client) -> bool:
    return bool(http.get("/readyz").json()["role"] == "writer")


def asked(bucket: FaultProxy, container: str) -> int:
    """How often bytes of a container were asked for."""
    return sum(each.startswith("GET ") and container in each for each in bucket.seen)


def expected(path: Path) -> dict[str, bytes]:
    """The addresses below a surface, and what is to be found there."""
    field = maps.HeightField.open(path)
    return {
        "tiles/7/66/45.png": maps.web_tile(field, 7, 66, 45),
        "tiles/6/33/22.png?encoding=shade": maps.web_tile(field, 6, 33, 22, encoding="shade"),
        "terrain/6/66/48.terrain": maps.mesh_tile(field, 6, 66, 48, normals=False),
        f"levels/{field.levels}?format=npy": npy(hills(100, 120) * 100),
    }


@pytest.mark.long
def test_tiles_meshes_and_levels_are_those_of_the_container(s3: Emulator, bucket: FaultProxy, tmp_path: Path) -> None:
    path = tmp_path / "hill.lode"
    path.write_bytes(terrain())
    address, known = s3.address(), expected(path)
    with serving(address, tmp_path / "writer") as writer:
        eventually(lambda: writes(writer), "the server to write")
        hill = push(writer, path.read_bytes(), filename="hill.lode")
        with serving(address, tmp_path / "reader", read_only=True) as reader:
            for http in (writer, reader):
                bucket.seen.clear()
                told = http.get(f"{hill['url']}/map.json").raise_for_status().json()
                assert told["bounds"] == pytest.approx([7, 45, 8.2, 46], abs=0.01)
                assert http.get(f"{hill['url']}/terrain/layer.json").raise_for_status().json()["format"]
                for place, data in known.items():
                    answer = http.get(f"{hill['url']}/{place}", headers={"accept-encoding": "identity"})
                    assert answer.raise_for_status().content == data, place
                assert asked(bucket, hill["container_sha256"]) == 1, "it was fetched once for all of them"


def test_one_that_fills_the_cache_is_fetched_once_and_a_larger_one_is_refused(
    memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import obstore

    data, fetched = terrain(), list[str]()
    get_range = obstore.get_range

    def counted(store: Any, path: str, **named: Any) -> Any:
        fetched.append(path)
        return get_range(store, path, **named)

    monkeypatch.setattr(obstore, "get_range", counted)
    with serving(memory, tmp_path / "writer", cache_bytes=len(data)) as http:
        eventually(lambda: writes(http), "the server to write")
        hill = push(http, data, filename="hill.lode")
        shapes = [f"{hill['url']}/{path}" for path in ("map.json", "tiles/7/66/45.png", "levels/0?format=npy")]
        fetched.clear()
        assert [http.get(shape).status_code for shape in shapes] == [200] * 3
        assert len(fetched) == 1
    with serving(memory, tmp_path / "reader", read_only=True, cache_bytes=len(data) - 1) as http:
        for shape in shapes:
            answer = http.get(shape)
            assert problem(answer) == (413, "too-large")
            assert f"{len(data) - 1} at most (cache_bytes)" in answer.json()["detail"]
        assert http.get(f"{hill['url']}/container").content == data
