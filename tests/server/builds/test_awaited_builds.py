"""Requests that wait for the end of a build: ``?wait=``."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from lodestream_server import running_server
from lodestream_server.builds import worker
from lodestream_server.builds.builder import Builder
from tests.patience import PATIENCE
from tests.server.builds import slow
from tests.server.helpers import eventually, hills, npy, problem

#: What is asked for; nobody waits so long here.
LONG = {"wait": "60"}


@pytest.fixture
def asking(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """How many requests wait now, or have waited."""
    begun = list[str]()
    settled = Builder.settled

    async def noted(self: Builder, surface: str, seconds: float) -> None:
        begun.append(surface)
        await settled(self, surface, seconds)

    monkeypatch.setattr(Builder, "settled", noted)
    monkeypatch.setattr(worker, "build", slow.wait)
    return lambda: len(begun)


@contextmanager
def running(data: Path, **options: int) -> Iterator[httpx.Client]:
    with (
        running_server(data, workers=1, **options) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        yield http


def begun(http: httpx.Client, seed: int = 1) -> str:
    return str(http.post("/v1/surfaces", content=npy(hills(seed=seed))).headers["location"])


def test_whoever_waits_is_answered_when_the_build_ends(tmp_path: Path, asking: Callable[[], int]) -> None:
    with running(tmp_path) as http, ThreadPoolExecutor(3) as threads:
        first, second = begun(http, 1), begun(http, 2)
        waits = [threads.submit(http.get, path, params=LONG) for path in (first, second, second)]
        eventually(lambda: asking() == 3, "the requests to wait")
        assert http.get(first, params={"wait": 0.01}).json()["state"] in ("queued", "building"), "the seconds are over"
        (tmp_path / "go").touch()
        assert [wait.result().json()["state"] for wait in waits] == ["ready"] * 3
        # Nobody waits for what is there.
        assert http.get(first, params=LONG).json()["state"] == "ready"
        http.put("/v1/names/dem", json={"surface": first.rpartition("/")[2]})
        assert http.get("/v1/names/dem", params=LONG).json()["url"] == first
        assert asking() == 4


def test_a_deletion_and_the_end_of_the_server_end_the_wait(tmp_path: Path, asking: Callable[[], int]) -> None:
    with ThreadPoolExecutor(2) as threads, httpx.Client(trust_env=False, timeout=PATIENCE) as http:
        with running_server(tmp_path, workers=1) as url:
            http.base_url = httpx.URL(url)
            first, second = begun(http, 1), begun(http, 2)
            waits = [threads.submit(http.get, path, params=LONG) for path in (first, second)]
            eventually(lambda: asking() == 2, "the requests to wait")
            assert http.delete(first).status_code == 204
            assert problem(waits[0].result()) == (404, "not-found")
        # The server has ended.
        assert waits[1].result().json()["state"] in ("queued", "building")


def test_requests_that_wait_are_shared_and_a_client_that_goes_is_not_counted(
    tmp_path: Path, asking: Callable[[], int]
) -> None:
    with running(tmp_path, max_streams=1) as http:
        location, place = begun(http), http.base_url
        with socket.create_connection((place.host, place.port or 80), PATIENCE) as leaves:
            leaves.sendall(f"GET {location}?wait=60 HTTP/1.1\r\nHost: {place.host}:{place.port}\r\n\r\n".encode())
            eventually(lambda: asking() == 1, "the request to wait")
            refused = http.get(location, params=LONG)
            assert problem(refused) == (503, "busy")
            assert "requests that wait for builds" in refused.json()["detail"]
        # It need not wait for the end of the build.
        eventually(lambda: http.get(location, params={"wait": 0.01}).status_code == 200, "the place to be free")
        (tmp_path / "go").touch()


def test_other_waits_are_refused(tmp_path: Path) -> None:
    with running(tmp_path) as http:
        for wait in ("-1", "61", "nan", "inf", "x"):
            assert problem(http.get("/v1/surfaces/any", params={"wait": wait})) == (422, "bad-option"), wait
