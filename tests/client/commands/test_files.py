"""Containers on web servers of others: the same surface in steps, or a clear refusal."""

from __future__ import annotations

import asyncio
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.errors import RemoteError, RemoteProtocolError
from lodestream.transfer.receiver_state import ReceiverState
from lodestream_client import AsyncClient, AsyncStream, Client
from lodestream_client.stream.reconnecting import Transport
from lodestream_server import running_server
from tests.links import Fault, linked
from tests.patience import PATIENCE

from ..asked import asked
from ..conftest import Run
from ..files import Ranged, nginx, plain, ranged

Terrain = NDArray[np.float32]


@pytest.fixture(scope="module")
def folder(container_file: Path) -> Path:
    return container_file.parent


@pytest.fixture
def web(folder: Path) -> Iterator[Ranged]:
    with ranged(folder) as server:
        yield server


@pytest.fixture
def url(web: Ranged, container_file: Path) -> str:
    return f"{web.url}/{container_file.name}"


TARGETS = [
    ls.Target(),
    ls.Target(until_rms=ls.Tolerance(1e-2, relative=True)),
    ls.Target(max_bytes=1500),
    ls.Target(level=3),
    ls.Target(order="level", max_bytes=3000),
]


@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
@pytest.mark.parametrize("target", TARGETS, ids=repr)
def test_a_file_is_the_same_surface_as_a_stream(surface: str, url: str, target: ls.Target, asynchronous: bool) -> None:
    with Client(surface).connect(surface, target=target, transport="ws") as stream:
        by_socket = list(stream)

    async def loop() -> tuple[list[ls.View], AsyncStream]:
        async with AsyncClient(url) as client, client.connect(url, target=target) as stream:
            return [view async for view in stream], stream

    if asynchronous:
        views, followed = asyncio.run(loop())
        reception: ReceiverState = followed._reception
    else:
        with Client(url).connect(url, target=target) as stream_of_file:
            views = list(stream_of_file)
        reception = stream_of_file._reception
    assert [view.bytes for view in views] == [view.bytes for view in by_socket]
    assert (reception.ended, views[-1].rms) == (stream.ended, by_socket[-1].rms)
    assert np.array_equal(views[-1].points, by_socket[-1].points)
    assert reception.data_bytes == reception.cached.total
    assert reception.decoder.metadata == stream.decoder.metadata


def test_few_requests_are_made(web: Ranged, url: str, terrain: Terrain) -> None:
    with Client(url).connect(url) as stream:
        views = list(stream)
    assert np.array_equal(views[-1].points, terrain)
    assert (stream.ended, stream.transport) == ("complete", "http")
    assert [method for method, _ in web.requests] == ["GET"]
    assert stream.connections == 1
    with Client(url).connect(url, target=ls.Target(until_rms=ls.Tolerance(1e-2, True))) as stream:
        list(stream)
    assert stream.ended == "rms"
    assert stream.decoder.metadata is not None
    assert stream.connections == 2
    assert [method for method, _ in web.requests] == ["GET"] * 3


def test_the_surface_of_a_server_by_range(surface: str, terrain: Terrain) -> None:
    with Client(surface).connect(surface, transport="http") as stream:
        views = list(stream)
    assert np.array_equal(views[-1].points, terrain)
    assert stream.transport == "http"
    assert stream._reception.container == Client(surface).get(surface).details["container_sha256"]


@pytest.mark.usefixtures("paced")
def test_stop_and_seconds_and_leaving(url: str) -> None:
    with Client(url).connect(url) as stream:
        next(stream)
        stream.stop()
        assert list(stream) == []
    assert stream.ended == "stopped"
    with Client(url).connect(url, target=ls.Target(seconds=0.3), limit_rate=8000.0) as stream:
        views = list(stream)
    assert stream.ended == "seconds"
    assert not stream.decoder.complete
    assert len(views) < len(stream.decoder.layers) + 1
    with Client(url).connect(url) as stream:
        first = next(stream)
    assert stream.ended == "stopped"
    assert first.number == 0


def test_a_query_may_be_part_of_a_files_address(web: Ranged, url: str) -> None:
    with Client(f"{url}?signature=a%2Fb").connect(f"{url}?signature=a%2Fb", target=ls.Target(max_bytes=1500)) as stream:
        list(stream)
    assert stream.ended == "bytes"


def test_progress_is_told(url: str, surface: str) -> None:
    told: list[tuple[int, int | None]] = []

    def progress(received: int, planned: int | None) -> None:
        told.append((received, planned))

    for address in (url, surface):
        told.clear()
        with (
            linked(address, Fault(rate=200_000.0)) as link,
            Client(link.url).connect(link.url, progress=progress, window=4096) as stream,
        ):
            list(stream)
        assert told[-1] == (stream.planned, stream.planned)
        assert [received for received, _ in told] == sorted(received for received, _ in told)
        assert len({received for received, _ in told}) > 2


def test_a_server_that_ignores_range_is_reported_and_not_obeyed(
    folder: Path, container_file: Path, run: Run, tmp_path: Path
) -> None:
    with plain(folder) as server:
        address = f"{server}/{container_file.name}"
        with pytest.raises(RemoteProtocolError, match="does not support Range"):
            Client(address).connect(address)
        for command in (("pull", address, tmp_path / "o.npy"), ("info", address)):
            code, stdout, stderr = run(*command)
            assert (code, stdout) == (1, "")
            assert "does not support Range" in stderr
            assert stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
def test_a_file_that_changes_meanwhile(tmp_path: Path, container_file: Path, asynchronous: bool) -> None:
    path = tmp_path / "changing.lode"
    shutil.copy(container_file, path)

    other = ls.encode(np.arange(60_000, dtype=np.float32).reshape(200, 300) ** 1.5)
    target = ls.Target(order="level")  # takes more than one request

    async def loop(address: str) -> None:
        async with AsyncClient(address) as client, client.connect(address, target=target) as stream:
            path.write_bytes(other)
            async for _ in stream:
                pass

    def follow(address: str) -> None:
        if asynchronous:
            asyncio.run(loop(address))
            return
        with Client(address).connect(address, target=target) as stream:
            path.write_bytes(other)
            list(stream)

    with ranged(tmp_path) as server, pytest.raises(RemoteError, match="changed") as caught:
        follow(f"{server.url}/changing.lode")
    assert caught.value.code == "other-container"


def test_what_is_no_container_and_what_is_not_there(web: Ranged, folder: Path, terrain_file: Path) -> None:
    (folder / "empty.lode").write_bytes(b"")
    for name, words in ((terrain_file.name, "expected"), ("empty.lode", "shorter file")):
        with (
            pytest.raises(ls.StreamError, match=words),
            Client(f"{web.url}/{name}").connect(f"{web.url}/{name}", deadline=0) as stream,
        ):
            list(stream)
    with pytest.raises(ls.NotFoundError, match="404"):
        Client(f"{web.url}/nothing.lode").connect(f"{web.url}/nothing.lode")


def test_info_of_a_file_elsewhere_is_that_of_the_file_here(
    run: Run, web: Ranged, url: str, container_file: Path
) -> None:
    here = json.loads(run("info", container_file, "--json")[1])
    assert json.loads(run("info", url, "--json")[1]) == here
    assert "97 x 70" in run("info", url)[1]
    assert all(text for _, text in web.requests)
    assert asyncio.run(asked(url, lambda it: it.describe_file(url))) == here


def test_pull_by_either_transport_writes_the_same(
    run: Run, surface: str, url: str, tmp_path: Path, terrain: Terrain
) -> None:
    found: list[dict[str, Any]] = []
    for number, (address, transport) in enumerate(
        [(surface, "auto"), (surface, "ws"), (surface, "http"), (url, "auto"), (url, "http")]
    ):
        out = tmp_path / f"{number}.npy"
        code, stdout, _ = run("pull", address, out, "--transport", transport, "--until-rms", "5", "--json")
        assert code == 0
        found.append(json.loads(stdout))
    figures = [{key: each[key] for key in ("bytes", "level", "rms", "max", "ended")} for each in found]
    assert all(each == figures[0] for each in figures)
    written = [np.load(path) for path in sorted(tmp_path.iterdir())]
    assert all(np.array_equal(each, written[0]) for each in written)


def test_a_file_has_no_stream(run: Run, url: str, tmp_path: Path) -> None:
    code, _, stderr = run("pull", url, tmp_path / "o.npy", "--transport", "ws")
    assert code == 2
    assert "the URL of a file has no WebSocket" in stderr
    with pytest.raises(ls.OptionError, match="surface's address for a WebSocket"):
        Client(url).connect(url, transport="ws")


WITHOUT_NGINX = shutil.which("nginx") is None and not Path("/usr/sbin/nginx").exists()


@pytest.mark.skipif(WITHOUT_NGINX, reason="nginx is not installed")
def test_a_server_below_a_path_behind_a_proxy(terrain_file: Path, terrain: Terrain, tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    options: dict[str, Any] = {"workers": 1, "root_path": "/maps", "insecure": True}
    with (
        running_server(tmp_path / "data", **options) as server,
        nginx(tmp_path, tmp_path / "work", server) as front,
    ):
        url = Client(f"{front}/maps").upload(terrain_file).url
        transports: tuple[Transport, ...] = ("ws", "http")
        for transport in transports:
            with Client(url).connect(url, transport=transport) as stream:
                views = list(stream)
            assert (stream.ended, stream.transport) == ("complete", transport)
            assert np.array_equal(views[-1].points, terrain)
        assert url.startswith(f"{front}/maps/v1/surfaces/")


@pytest.mark.skipif(WITHOUT_NGINX, reason="nginx is not installed")
def test_another_web_server(folder: Path, container_file: Path, terrain: Terrain, tmp_path: Path) -> None:
    (tmp_path / "work").mkdir()
    (tmp_path / "files").mkdir(mode=0o755)
    shutil.copy(container_file, tmp_path / "files" / "terrain.lode")
    with nginx(tmp_path / "files", tmp_path / "work") as server:
        address = f"{server}/terrain.lode"
        assert httpx.head(address, trust_env=False, timeout=PATIENCE).headers["accept-ranges"] == "bytes"
        with Client(address).connect(address) as stream:
            views = list(stream)
        assert stream.ended == "complete"
        assert np.array_equal(views[-1].points, terrain)
        assert stream._reception.data_bytes == stream._reception.cached.total
        with Client(address).connect(address, target=ls.Target(level=3)) as stream:
            list(stream)
        assert stream.ended == "level"
