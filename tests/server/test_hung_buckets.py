"""A bucket that does not answer: what needs none goes on, and a server that is to end does."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from lodestream.stores import open_store
from lodestream_server import running_server
from lodestream_server.store.lease import Lease
from lodestream_server.store.surfaces import Surfaces
from tests.patience import PATIENCE
from tests.server.helpers import eventually
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
    """Calls that wait until they are let go; how many do."""

    def __init__(self) -> None:
        self.count = 0
        self.over = threading.Event()
        self._lock = threading.Lock()

    def __call__(self, *_: Any, **__: Any) -> bytes:
        with self._lock:
            self.count += 1
        self.over.wait(PATIENCE)
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
