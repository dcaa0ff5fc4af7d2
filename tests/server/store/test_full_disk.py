"""A disk that is full at any step: 507, nothing half-written, nothing acknowledged is lost, and the server goes on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from lodestream_server.builds import builder, worker
from lodestream_server.store import data, durable, surfaces
from lodestream_server.store.data import Data
from tests.data_folder import below
from tests.history.site import Disk, can_fill
from tests.server.builds import slow
from tests.server.builds.test_builds import building, running
from tests.server.helpers import eventually, hills, kept, npy, push, settled
from tests.server.programs import server
from tests.torture import small_disk

from .disks import CountingDisk, FullDisk, FullFolder, FullIndex, StickyDisk


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(builder, "_FIRST_DELAY", 0.01)


@pytest.fixture(autouse=True)
def fillable(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Stores and indexes that `FullFolder.fill` fills."""
    FullFolder.fill(None)
    monkeypatch.setattr(data, "Folder", FullFolder)
    monkeypatch.setattr(surfaces, "Index", FullIndex)
    yield
    FullFolder.fill(None)


def files(data: Path) -> set[Path]:
    """What is kept, and what an upload leaves; the index and the store's lock aside."""
    return {path for path in below(data) if path.is_file() and "index." not in path.name and path.name != "lock"}


def test_an_upload_at_every_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    # No build disturbs the count of steps, nor what is compared.
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data) as http:
        kept = http.post("/v1/surfaces", content=npy(hills(seed=1))).json()
        eventually(lambda: http.get(kept["url"]).json()["progress"] == 0.5 or None, "the build to begin")
        before = files(data)
        counting = CountingDisk()
        monkeypatch.setattr(durable, "disk", counting)
        FullFolder.fill(None)
        made = http.post("/v1/surfaces", content=npy(hills(seed=2)))
        assert made.status_code == 202
        steps, writes = list(counting.steps), list(FullFolder.steps)
        assert set(steps) == {"make_folder", "create", "write", "sync"}
        assert writes == ["put_file", "create", "index"]
        assert http.delete(made.headers["location"]).status_code == 204
        for lasting in (False, True):
            for step in range(len(steps) + len(writes)):
                if step < len(steps):
                    monkeypatch.setattr(durable, "disk", FullDisk(step, lasting=lasting))
                else:
                    monkeypatch.setattr(durable, "disk", durable.Disk())
                    FullFolder.fill(step - len(steps), lasting=lasting)
                answer = http.post("/v1/surfaces", content=npy(hills(seed=2)))
                assert (answer.status_code, answer.json()["code"]) == (507, "disk-full"), step
                eventually(lambda: files(data) == before, f"nothing to be left after step {step}")
                assert [entry["id"] for entry in http.get("/v1/surfaces").json()["surfaces"]] == [kept["id"]]
                FullFolder.fill(None)
        (data / "go").touch()
        assert push(http, npy(hills(seed=2)))["state"] == "ready"
        assert settled(http, kept["url"])["state"] == "ready"


def test_a_second_upload_of_what_failed_at_every_step(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        failed = push(http, npy(hills())[:-1])
        for step in range(100):
            FullFolder.fill(step)
            answer = http.post("/v1/surfaces", content=npy(hills())[:-1])
            if answer.status_code == 202:
                break
            assert answer.status_code in (503, 507)  # or it is stored, and the index could not be told
            # What was known of it is known still, or it is queued again; and what it was made of is there.
            assert http.get(failed["url"]).json()["id"] == failed["id"]
            assert len(kept(data, "uploads")) == 1
        assert step > 0
        assert settled(http, failed["url"])["state"] == "failed"


def test_a_build_at_every_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.full_at_each_step)
    monkeypatch.setattr(builder, "_allowed", slow.allow_more)
    with running(data) as http:
        surface = push(http, npy(hills()))
        assert surface["state"] == "ready"
        # Creating, writing and synchronising the container failed once each.
        assert (data / "fuller").read_text() == "4"


def test_keeping_what_was_built_at_every_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data) as http:
        location = http.post("/v1/surfaces", content=npy(hills())).headers["location"]
        eventually(lambda: http.get(location).json()["state"] == "building" or None, "the build to begin")
        FullFolder.fill(0, lasting=True)
        (data / "go").touch()
        eventually(lambda: "put_file" in FullFolder.steps, "the container to be stored")
        assert http.get(location).json()["state"] in ("queued", "building")
        assert kept(data, "containers") == []
        FullFolder.fill(None)
        assert settled(http, location)["state"] == "ready"
        for step in range(100):
            (data / "go").unlink()
            assert http.delete(location).status_code == 204
            assert http.post("/v1/surfaces", content=npy(hills())).headers["location"] == location
            building(http, location)  # from here on the steps are counted
            FullFolder.fill(step)
            (data / "go").touch()
            surface = settled(http, location)
            assert surface["state"] == "ready", step
            if len(FullFolder.steps) <= step:
                break
            FullFolder.fill(None)
        assert step > 1


def test_a_failure_that_cannot_be_stored(tmp_path: Path) -> None:
    """What a client was told as failed would be queued again after a restart."""
    data = tmp_path / "data"
    with running(data) as http:
        FullFolder.below = "built/"
        queued = http.post("/v1/surfaces", content=npy(hills())[:-1]).json()
        looked = eventually(
            lambda: (it := http.get(queued["url"]).json())["reason"] and it, "the end of the build to find no room"
        )
        assert looked["state"] in ("queued", "building")
        assert looked["reason"] == "waits for space on the server's disk"
    # It is found out again, also by a server that has no index.
    FullFolder.fill(None)
    for path in (data / "scratch").glob("index.sqlite*"):
        path.unlink()
    with running(data) as http:
        assert settled(http, queued["url"])["state"] == "failed"
    folder = Data(data)
    assert folder.surfaces.get(queued["id"]).state == "failed"
    folder.close()


@pytest.mark.skipif(not small_disk.can_mount(), reason="no small disk can be mounted on this machine")
def test_what_nobody_needs_any_more_may_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    passing = [data / "scratch" / name for name in ("incoming", "work", "levels")]
    with running(data) as http:
        monkeypatch.setattr(durable, "disk", StickyDisk(*passing))
        first = push(http, npy(hills(seed=1)))
        assert first["state"] == "ready"
        again = http.post("/v1/surfaces", content=npy(hills(seed=1)))
        assert (again.status_code, again.json()["id"]) == (200, first["id"])
        assert push(http, npy(hills(seed=2))[:-1])["state"] == "failed"
        assert http.post("/v1/surfaces", content=b"just some text").status_code == 422
        assert http.get(f"{first['url']}/levels/1").status_code == 200
        assert http.get(first["url"]).json() == first
        assert http.delete(first["url"]).status_code == 204
        assert http.get(first["url"]).status_code == 404
        assert all(any(folder.iterdir()) for folder in passing)
    monkeypatch.setattr(durable, "disk", durable.Disk())
    with running(data):
        assert not any(folder.exists() and any(folder.iterdir()) for folder in passing)


@pytest.mark.skipif(not can_fill(), reason="no disk that outlives a server can be had on this machine")
@pytest.mark.long
def test_a_server_starts_on_a_full_disk_and_deletes(tmp_path: Path) -> None:
    disk = Disk(tmp_path, "4m")
    try:
        with server(tmp_path / "data", disk.wrapper, keep_free=0) as first, first.client() as http:
            pushed = push(http, npy(hills()))
        disk.fill(0)
        with server(tmp_path / "data", disk.wrapper, keep_free=0) as second, second.client() as http:
            assert http.get(pushed["url"]).json()["state"] == "ready"
            assert http.delete(pushed["url"]).status_code == 204
            assert http.get("/v1/surfaces").json()["surfaces"] == []
    finally:
        disk.close()


@pytest.mark.long
def test_a_disk_that_is_really_small(tmp_path: Path) -> None:
    done = small_disk.run(tmp_path, 20, size="700k")
    assert min(done.uploads, done.refused, done.deletes, done.kept) > 0
