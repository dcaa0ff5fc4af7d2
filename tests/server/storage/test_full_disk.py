"""A disk that is full at any step: 507, nothing half-written, nothing acknowledged is lost, and the server goes on."""

from __future__ import annotations

from pathlib import Path

import pytest

from lodestream_server.builds import jobs, worker
from lodestream_server.storage.storage import Storage
from lodestream_server.store import durable
from tests.server.builds import slow
from tests.server.builds.test_builds import running
from tests.server.helpers import eventually, hills, kept, npy, push, settled
from tests.server.storage.disks import CountingDisk, FullDisk, StickyDisk
from tests.torture import small_disk


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jobs, "_FIRST_DELAY", 0.01)


def files(data: Path) -> set[Path]:
    return {path for path in data.rglob("*") if path.is_file()}


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
        made = http.post("/v1/surfaces", content=npy(hills(seed=2)))
        assert made.status_code == 202
        steps = list(counting.steps)
        assert set(steps) == {"make_folder", "create", "write", "sync", "rename"}
        assert http.delete(made.headers["location"]).status_code == 204
        for lasting in (False, True):
            for step in range(len(steps)):
                monkeypatch.setattr(durable, "disk", FullDisk(step, lasting=lasting))
                answer = http.post("/v1/surfaces", content=npy(hills(seed=2)))
                assert (answer.status_code, answer.json()["code"]) == (507, "disk-full"), (step, steps[step])
                assert files(data) == before, (step, steps[step])
                assert [entry["id"] for entry in http.get("/v1/surfaces").json()["surfaces"]] == [kept["id"]]
        monkeypatch.setattr(durable, "disk", durable.Disk())
        (data / "go").touch()
        assert push(http, npy(hills(seed=2)))["state"] == "ready"
        assert settled(http, kept["url"])["state"] == "ready"


def test_a_second_upload_of_what_failed_at_every_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        failed = push(http, npy(hills())[:-1])
        for step in range(100):
            monkeypatch.setattr(durable, "disk", FullDisk(step))
            answer = http.post("/v1/surfaces", content=npy(hills())[:-1])
            if answer.status_code == 202:
                break
            assert answer.status_code == 507
            # What was known of it is known still, and what it was made of is there.
            assert http.get(failed["url"]).json() == failed
            assert len(kept(data, "uploads")) == 1
        assert step > 5
        assert settled(http, failed["url"])["state"] == "failed"


def test_a_build_at_every_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.full_at_each_step)
    monkeypatch.setattr(jobs, "_allowed", slow.allow_more)
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
        monkeypatch.undo()
        monkeypatch.setattr(jobs, "_FIRST_DELAY", 0.01)
        full = FullDisk(0, lasting=True)
        monkeypatch.setattr(durable, "disk", full)
        (data / "go").touch()
        waiting = eventually(lambda: http.get(location).json()["reason"], "the build to wait")
        assert waiting == "waits for space on the server's disk"
        assert http.get(location).json()["state"] == "queued"
        assert kept(data, "containers") == []
        for step in range(100):
            disk = FullDisk(step)
            monkeypatch.setattr(durable, "disk", disk)
            surface = settled(http, location)
            assert surface["state"] == "ready", step
            if len(disk.steps) <= step:
                break
            # Another time from the start: this one found the disk full, waited and came through.
            assert http.delete(location).status_code == 204
            monkeypatch.setattr(durable, "disk", durable.Disk())
            assert http.post("/v1/surfaces", content=npy(hills())).headers["location"] == location
        assert step > 3


def test_a_failure_that_cannot_be_written_down(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.explode_later)
    with running(data) as http:
        location = http.post("/v1/surfaces", content=npy(hills())).headers["location"]
        eventually(lambda: http.get(location).json()["progress"] == 0.5 or None, "the build to begin")
        monkeypatch.setattr(durable, "disk", FullDisk(0, lasting=True))
        (data / "go").touch()
        assert settled(http, location)["reason"] == "the build failed with an internal error: ZeroDivisionError"
    monkeypatch.undo()
    # It is found out again.
    storage = Storage(data)
    assert [(record.state, record.reason) for record in storage.records()] == [("queued", None)]
    storage.close()


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    durable.write_file(path, b"old")
    for step in range(4):
        monkeypatch.setattr(durable, "disk", FullDisk(step))
        with pytest.raises(OSError, match="space"):
            durable.write_file(path, b"new")
        assert path.read_bytes() == b"old"
        assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not small_disk.can_mount(), reason="no small disk can be mounted on this machine")
def test_what_nobody_needs_any_more_may_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    passing = [data / name for name in ("incoming", "work", "levels")]
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


def test_a_disk_that_is_really_small(tmp_path: Path) -> None:
    done = small_disk.run(tmp_path, 20, size="300k")
    assert min(done.uploads, done.refused, done.deletes, done.kept) > 0
