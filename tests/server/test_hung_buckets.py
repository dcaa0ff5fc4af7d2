"""A bucket that does not answer: what needs none goes on, and a server that is to end does."""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from lodestream import Target
from lodestream.container import read_index
from lodestream.planning.window_errors import window_section
from lodestream.stores import StoreError, open_store
from lodestream.stores.bucket import Bucket, BucketBlob
from lodestream_client import Client
from lodestream_server import running_server
from lodestream_server.builds import worker
from lodestream_server.store import layout
from lodestream_server.store.lease import Lease
from lodestream_server.store.surfaces import Surfaces
from tests.patience import PATIENCE
from tests.server.builds import slow
from tests.server.helpers import eventually, hills, npy, push
from tests.stores.memory import memory

from .store.test_surfaces import build
from .store.world import upload

__all__ = ["memory"]


@pytest.fixture
def stored(memory: str, tmp_path: Path) -> str:
    """The hash of a container in the bucket."""
    store = open_store(memory)
    lease = Lease(store)
    surfaces = Surfaces(store, tmp_path / "index.sqlite", lease=lease)
    lease.tend()
    surfaces.sync()
    manifest, files = upload(tmp_path, 0)
    surfaces.accept(manifest, files)
    build(surfaces, manifest, tmp_path)
    lease.close()
    sha256 = surfaces.get(manifest.id).container
    surfaces.close()
    assert sha256 is not None
    return sha256


class Hanging:
    """Calls that wait until they are let go; how many do, and whether one gave up."""

    def __init__(self) -> None:
        self.count = 0
        self.over = threading.Event()
        self.gave_up = False
        self._lock = threading.Lock()

    def __call__(self, *_: Any, **__: Any) -> bytes:
        with self._lock:
            self.count += 1
        self.gave_up |= not self.over.wait(PATIENCE)
        return b""


@pytest.fixture
def hanging() -> Iterator[Hanging]:
    it = Hanging()
    yield it
    it.over.set()


def test_what_the_index_knows_is_told_while_many_wait_for_the_bucket(
    stored: str, memory: str, hanging: Hanging, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        running_server(memory, scratch=tmp_path / "scratch", workers=1, read_only=True, cache_bytes=0) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
        ThreadPoolExecutor(40) as readers,
    ):
        monkeypatch.setattr("lodestream.stores.bucket.BucketBlob.read", hanging)
        answers = [readers.submit(http.get, f"/v1/containers/{stored}.lode") for _ in range(40)]
        eventually(lambda: hanging.count >= 32, "many to wait")
        try:
            assert len(http.get("/v1/surfaces").json()["surfaces"]) == 1
            assert not any(answer.done() for answer in answers)
        finally:
            hanging.over.set()


@pytest.fixture
def built(memory: str, tmp_path: Path) -> list[dict[str, Any]]:
    """Two surfaces that a server has built in the bucket."""
    with (
        running_server(memory, scratch=tmp_path / "writer", workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        eventually(lambda: http.get("/readyz").json()["role"] == "writer", "the server to write")
        return [push(http, npy(hills(600, 600, seed))) for seed in (1, 2)]


def hang(monkeypatch: pytest.MonkeyPatch, hanging: Hanging, container: str) -> None:
    """Let all reads of a container wait."""
    read, range_ = BucketBlob.read, Bucket._range

    def read_of(self: BucketBlob, offset: int, length: int) -> bytes:
        if container in self._extent.name:
            hanging()
        return read(self, offset, length)

    def range_of(self: Bucket, key: str, offset: int, length: int) -> bytes:
        if container in key:
            hanging()
        return range_(self, key, offset, length)

    monkeypatch.setattr(BucketBlob, "read", read_of)
    monkeypatch.setattr(Bucket, "_range", range_of)


def test_what_is_a_file_of_the_server_is_answered_while_many_wait_for_the_bucket(
    built: list[dict[str, Any]], memory: str, hanging: Hanging, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, away = built
    with (
        running_server(memory, scratch=tmp_path / "reader", workers=1, read_only=True) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
        ThreadPoolExecutor(42) as readers,
    ):
        place = f"/v1/containers/{here['container_sha256']}.lode"
        whole = http.get(place).content
        http.get(f"{here['url']}/levels/0?format=npy").raise_for_status()
        hang(monkeypatch, hanging, away["container_sha256"])
        level = readers.submit(http.get, f"{away['url']}/levels/0?format=npy")
        eventually(lambda: hanging.count == 1, "the level to wait")
        try:
            http.get(f"{here['url']}/levels/1?format=npy").raise_for_status()
            others = f"/v1/containers/{away['container_sha256']}.lode"
            answers = [level, *(readers.submit(http.get, others) for _ in range(40))]
            eventually(lambda: hanging.count >= 32, "many to wait")
            assert http.get(place).content == whole
            http.get(f"{here['url']}/levels/2?format=npy").raise_for_status()
            with Client(url).connect(here["id"]) as stream:
                for _ in stream:
                    pass
            assert stream.ended == "complete"
            assert not any(answer.done() for answer in answers)
        finally:
            hanging.over.set()


def test_a_plan_that_needs_the_bucket_keeps_no_other_from_its_turn(
    built: list[dict[str, Any]], memory: str, hanging: Hanging, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, away = built
    with (
        running_server(memory, scratch=tmp_path / "reader", workers=1, read_only=True) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
        ThreadPoolExecutor(1) as readers,
    ):
        data = http.get(f"/v1/containers/{away['container_sha256']}.lode").content
        section = window_section(read_index(lambda offset, length: data[offset : offset + length], len(data)))
        assert section is not None
        read = BucketBlob.read

        def read_of(self: BucketBlob, offset: int, length: int) -> bytes:
            if away["container_sha256"] in self._extent.name and offset == section.offset:
                hanging()
            return read(self, offset, length)

        def window_of(surface: dict[str, Any]) -> str | None:
            target = Target(region=((100, 300), (100, 300)), until_max=5.0)
            with Client(url).connect(surface["id"], target=target) as stream:
                for _ in stream:
                    pass
            return stream.ended

        monkeypatch.setattr(BucketBlob, "read", read_of)
        waiting = readers.submit(window_of, away)
        eventually(lambda: hanging.count == 1, "the first one to wait")
        try:
            assert window_of(here) == "max"
            assert not waiting.done()
        finally:
            hanging.over.set()
        assert waiting.result() == "max"


def test_a_look_that_fails_when_nobody_waits_for_it_any_more_is_no_error_of_the_server(
    stored: str, memory: str, hanging: Hanging, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: Any
) -> None:
    def get(*_: Any) -> None:
        hanging()
        raise StoreError("it does not answer")

    monkeypatch.setattr("lodestream_server.following._PATIENCE", 0.01)
    with (
        running_server(memory, scratch=tmp_path / "scratch", workers=1, read_only=True) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        monkeypatch.setattr("lodestream.stores.bucket.Bucket.get", get)
        for number in range(101, 104):  # of which there is no surface
            assert http.get(f"/v1/surfaces/{number:020x}").status_code == 503
        assert http.get("/readyz").json()["unseen"] >= 0
        hanging.over.set()
        eventually(lambda: hanging.count == 3, "all looks to have failed")
    gc.collect()
    assert "never retrieved" not in caplog.text


def test_a_server_tells_for_how_long_the_bucket_has_not_answered_and_lets_nobody_wait_for_it(
    stored: str, memory: str, hanging: Hanging, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    often: dict[str, Any] = {"workers": 1, "lease_seconds": 3.0, "look_seconds": 0.2}
    with (
        running_server(memory, scratch=tmp_path / "a", **often) as writer,
        httpx.Client(base_url=writer, trust_env=False, timeout=PATIENCE) as first,
        running_server(memory, scratch=tmp_path / "b", read_only=True, **often) as reader,
        httpx.Client(base_url=reader, trust_env=False, timeout=PATIENCE) as second,
    ):
        eventually(lambda: first.get("/readyz").json()["role"] == "writer", "the server to write")
        assert 0 <= first.get("/readyz").json()["unseen"] < PATIENCE
        (surface,) = second.get("/v1/surfaces").json()["surfaces"]
        for http, role in ((first, 1), (second, 0)):
            words = f"lodestream_writer {role}.0\n"
            eventually(lambda http=http, words=words: words in http.get("/metrics").text, "who writes")  # type: ignore[misc]
        monkeypatch.setattr("lodestream_server.following._PATIENCE", 0.01)
        for method in ("get", "get_if", "create", "replace"):
            monkeypatch.setattr(f"lodestream.stores.bucket.Bucket.{method}", hanging)
        eventually(lambda: first.get("/readyz").json()["role"] == "waiting", "the lease to end")
        assert first.get("/readyz").json()["writer"] is None
        assert "nobody is known to write" in first.delete(surface["url"]).json()["detail"]
        eventually(lambda: all(http.get("/readyz").json()["unseen"] > 1.2 for http in (first, second)), "it to be told")
        for http in (first, second):
            answer = http.get(surface["url"])
            assert (answer.status_code, answer.json()["detail"]) == (503, "The bucket does not answer; try again soon")
            (line,) = (it for it in http.get("/metrics").text.splitlines() if it.startswith("lodestream_bucket_unseen"))
            assert float(line.split()[1]) > 1.2
        hanging.over.set()


def test_a_server_ends_and_gives_up_its_lease_while_the_bucket_hangs(
    memory: str, hanging: Hanging, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        ThreadPoolExecutor(1) as reader,
        running_server(memory, scratch=tmp_path / "scratch", workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        eventually(lambda: http.get("/readyz").json()["role"] == "writer", "the server to write")
        monkeypatch.setattr("lodestream.stores.bucket.Bucket.get", hanging)
        reader.submit(http.put, "/v1/names/dem", json={"surface": None})  # it holds the lock of all changes
        eventually(lambda: hanging.count == 1, "the change to wait")
    assert not hanging.gave_up
    found = open_store(memory).get_if(layout.WRITER, None)
    assert found is not None
    assert layout.parse(layout.Writer, layout.WRITER, found[0]).holder is None


def test_a_server_ends_while_levels_and_builds_wait_for_the_bucket(
    built: list[dict[str, Any]], memory: str, hanging: Hanging, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        ThreadPoolExecutor(1) as reader,
        running_server(memory, scratch=tmp_path / "scratch", workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        eventually(lambda: http.get("/readyz").json()["role"] == "writer", "the server to write")
        monkeypatch.setattr(Bucket, "_range", hanging)
        reader.submit(http.get, f"{built[0]['url']}/levels/0?format=npy")
        eventually(lambda: hanging.count == 1, "the level to wait")
        assert http.post("/v1/surfaces", content=npy(hills(seed=3))).status_code == 202
        eventually(lambda: hanging.count == 2, "the build to wait")
    assert not hanging.gave_up


def test_a_server_ends_while_what_a_build_is_to_note_waits_for_the_bucket(
    memory: str, hanging: Hanging, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "build", slow.wait)
    with (
        ThreadPoolExecutor(1) as reader,
        running_server(memory, scratch=tmp_path / "scratch", workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        eventually(lambda: http.get("/readyz").json()["role"] == "writer", "the server to write")
        location = http.post("/v1/surfaces", content=npy(hills())).headers["location"]
        eventually(lambda: http.get(location).json()["progress"] == 0.5, "the build to begin")
        monkeypatch.setattr("lodestream.stores.bucket.Bucket.get", hanging)
        reader.submit(http.put, "/v1/names/dem", json={"surface": None})  # it holds the lock of all changes
        eventually(lambda: hanging.count == 1, "the change to wait")
    assert not hanging.gave_up
