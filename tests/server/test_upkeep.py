"""An index that is taken away while clients work: 503 for a moment, and nothing acknowledged is lost."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import httpx
import pytest

from lodestream.stores import Folder, StoreError
from lodestream_server import running_server
from lodestream_server.store.partial_uploads import PartialUploads
from lodestream_server.store.surfaces import Surfaces
from tests.server.helpers import PATIENCE, eventually, hills, listed, npy, problem, push, settled
from tests.stores.memory import memory

__all__ = ["memory"]

WORKERS = 3
MADE = "the index of the surfaces is made again"


def client(url: str) -> httpx.Client:
    return httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE)


def patiently(ask: Callable[[], httpx.Response]) -> httpx.Response:
    """The answer once the index is there; until then it says that the server is busy, and when to come back."""

    def answered() -> httpx.Response | None:
        answer = ask()
        if answer.status_code != 503:
            return answer
        assert problem(answer) == (503, "busy")
        assert answer.headers["retry-after"].isdecimal()
        return None

    return eventually(answered, "the index to be made again")


def test_an_index_that_is_lost_under_clients(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "lodestream_server.upkeep")
    index, over = tmp_path / "scratch" / "index.sqlite", threading.Event()

    def work(worker: int) -> list[str]:
        """Upload, look and delete until told; the addresses of what must be there."""
        left = list[str]()
        number = 0
        with client(url) as http:
            while number < 3 or not over.is_set():
                body = npy(hills(6, 5, seed=100 * worker + number % 10))
                name = f"{worker} {number}"
                answer = patiently(partial(http.post, "/v1/surfaces", content=body, params={"name": name}))
                assert answer.status_code in (200, 202), answer.text
                where = answer.headers["location"]
                assert patiently(partial(http.get, where)).json()["name"] == name
                assert patiently(partial(http.get, "/v1/surfaces")).status_code == 200
                if number % 2:
                    # What was deleted although the answer was lost is not there the next time.
                    assert patiently(partial(http.delete, where)).status_code in (204, 404)
                    assert patiently(partial(http.get, where)).status_code == 404
                else:
                    left.append(where)
                number += 1
        return left

    with running_server(tmp_path, workers=1) as url, client(url) as http, ThreadPoolExecutor(WORKERS) as threads:
        made = push(http, npy(hills()))
        working = [threads.submit(work, worker) for worker in range(WORKERS)]
        try:
            for _ in range(2):
                before = caplog.messages.count(MADE)
                index.unlink()
                eventually(lambda n=before: caplog.messages.count(MADE) > n, "another index")  # type: ignore[misc]
                assert patiently(lambda: http.get(made["url"])).json() == made
        finally:
            over.set()
        left = [where for done in working for where in done.result(PATIENCE)]
        eventually(lambda: http.get("/readyz").status_code == 200, "the server to be ready")
        assert http.get(made["url"]).json() == made
        for where in left:
            assert settled(http, where)["state"] == "ready"
        assert sorted(listed(http)) == sorted(where.rpartition("/")[2] for where in [*left, made["url"]])
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        assert sorted(listed(http)) == sorted(where.rpartition("/")[2] for where in [*left, made["url"]])


def test_while_an_index_cannot_be_made_again_everything_about_surfaces_is_busy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        made = push(http, npy(hills()))
        eventually(lambda: http.get("/readyz").status_code == 200, "the server to be ready")
        monkeypatch.setattr("lodestream_server.upkeep._AGAIN_SECONDS", 0.01)

        def unreadable(store: Folder, prefix: str, after: str = "") -> None:
            raise StoreError(f"{tmp_path}: Input/output error")

        monkeypatch.setattr(Folder, "entries", unreadable)
        (tmp_path / "scratch" / "index.sqlite").unlink()
        container = f"/v1/containers/{made['container_sha256']}.lode"
        for answer in (
            http.get("/v1/surfaces"),
            http.get(made["url"]),
            http.get(f"{made['url']}/levels/0"),
            http.get(container),
            http.post("/v1/surfaces", content=npy(hills(seed=2))),
            http.post(f"{made['url']}/retry"),
            http.delete(made["url"]),
        ):
            assert problem(answer) == (503, "busy"), answer.url
            assert answer.headers["retry-after"].isdecimal()
            assert str(tmp_path) not in answer.text
        assert http.get("/healthz").status_code == 200
        assert http.get("/readyz").status_code == 503
        assert http.get("/readyz").json()["index"] == "being made again"
        monkeypatch.undo()
        assert patiently(lambda: http.get(made["url"])).json() == made
        assert patiently(lambda: http.get(container)).status_code == 200
        eventually(lambda: http.get("/readyz").status_code == 200, "the server to be ready")
        assert listed(http) == [made["id"]]


def test_a_server_is_ready_once_all_surfaces_are_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with running_server(tmp_path, workers=1) as url, client(url) as http:
        made = push(http, npy(hills()))
    go, sync = threading.Event(), Surfaces.sync

    def late(surfaces: Surfaces) -> int:
        assert go.wait(PATIENCE)
        return sync(surfaces)

    monkeypatch.setattr(Surfaces, "sync", late)
    try:
        # With an index it answers at once, whatever else there may be in the store.
        with running_server(tmp_path, workers=1) as url, client(url) as http:
            try:
                assert http.get(made["url"]).json() == made
                answer = http.get("/readyz")
                assert (answer.status_code, answer.json()["status"]) == (503, "starting")
                assert answer.json()["index"] == "being brought up to date"
                assert push(http, npy(hills(seed=2)))["state"] == "ready"
                assert http.get("/readyz").status_code == 503
            finally:
                go.set()
            eventually(lambda: http.get("/readyz").status_code == 200, "the server to be ready")
            assert http.get("/readyz").json()["index"] == "current"
    finally:
        go.set()


def test_a_server_whose_bucket_cannot_be_listed_says_so(
    memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("lodestream_server.upkeep._AGAIN_SECONDS", 0.01)

    sync = Surfaces.sync

    def unlisted(surfaces: Surfaces, progress: Callable[[int], None] = lambda _: None) -> int:
        if surfaces.lease is not None and surfaces.lease.held:
            raise StoreError("there is an odd key")
        return sync(surfaces, progress)

    with monkeypatch.context() as broken:
        broken.setattr(Surfaces, "sync", unlisted)
        with running_server(memory, scratch=tmp_path, workers=1) as url, client(url) as http:
            eventually(lambda: http.get("/readyz").json()["index"] == "failing", "the list to fail")
            eventually(lambda: "there is an odd key; this server has the lease" in caplog.text, "the log to say so")
            assert http.get("/readyz").json()["role"] == "waiting"
            broken.undo()
            eventually(lambda: http.get("/readyz").json()["index"] == "current", "the list")
            eventually(lambda: http.get("/readyz").json()["role"] == "writer", "it to write")


def test_uploads_in_parts_are_removed_again_after_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("lodestream_server.upkeep._EXPIRE_SECONDS", 0.01)
    failures, expire = [RuntimeError("can't start new thread")], PartialUploads.expire

    async def failing(uploads: PartialUploads) -> None:
        if failures:
            raise failures.pop()
        await expire(uploads)

    with running_server(tmp_path, workers=1, partial_seconds=0.01) as url, client(url) as http:
        monkeypatch.setattr(PartialUploads, "expire", failing)
        eventually(lambda: not failures, "an error")
        headers = {"tus-resumable": "1.0.0", "upload-length": "9"}
        assert http.post("/v1/uploads", headers=headers).status_code == 201
        eventually(lambda: not list((tmp_path / "scratch" / "partial").iterdir()), "the upload to be removed")
    assert "can't start new thread" in caplog.text
