"""Builds: progress, cancelling, processes that die, restarts, and the folder in which everything lies."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest

from lodestream.errors import LodestreamError
from lodestream_server import running_server
from lodestream_server.builds import jobs, worker
from lodestream_server.storage.markers import MARKER
from lodestream_server.storage.storage import Storage
from lodestream_server.store.durable import discard
from tests.server.builds import slow
from tests.server.helpers import PATIENCE, eventually, hills, kept, npy, push, settled, upload_of


@contextmanager
def running(data: Path, **settings: Any) -> Iterator[httpx.Client]:
    with (
        running_server(data, **{"workers": 1, **settings}) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        yield http


def building(http: httpx.Client, location: str) -> dict[str, Any]:
    def look() -> dict[str, Any] | None:
        surface: dict[str, Any] = http.get(location).json()
        return surface if surface["state"] == "building" and surface["progress"] == 0.5 else None

    return eventually(look, "the build to be half done")


def post(http: httpx.Client, seed: int) -> str:
    answer = http.post("/v1/surfaces", content=npy(hills(seed=seed)), params={"filename": "hills.npy"})
    assert answer.status_code == 202
    return str(answer.headers["location"])


def test_a_build_tells_its_progress_and_answers_409_until_it_is_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(tmp_path / "data") as http:
        location = post(http, 1)
        behind = post(http, 2)
        building(http, location)
        assert http.get(behind).json()["state"] == "queued"
        for path in (f"{location}/container", f"{location}/levels/0", f"{behind}/container"):
            answer = http.get(path)
            assert (answer.status_code, answer.json()["code"]) == (409, "not-ready")
            assert int(answer.headers["retry-after"]) >= 1
        again = http.post("/v1/surfaces", content=npy(hills(seed=1)), params={"filename": "hills.npy"})
        assert (again.status_code, again.headers["location"]) == (202, location)
        (tmp_path / "data" / "go").touch()
        assert [settled(http, where)["state"] for where in (location, behind)] == ["ready", "ready"]


def test_deleting_stops_the_build_and_frees_its_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data) as http:
        location = post(http, 1)
        building(http, location)
        assert http.delete(location).status_code == 204
        assert http.get(location).status_code == 404
        monkeypatch.undo()
        assert push(http, npy(hills(seed=2)))["state"] == "ready"
        assert len(kept(data, "uploads")) == 1
        # A surface is ready a moment before the folder of its build is gone.
        eventually(lambda: not list((data / "work").iterdir()) or None, "the work folder empty")


def test_a_process_that_dies_takes_only_its_build_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.kill)
    with running(data) as http:
        surface = settled(http, post(http, 1))
        assert surface["state"] == "waiting"
        assert "process ended" in surface["reason"]
        assert "9" in surface["reason"]
        assert len(kept(data, "uploads")) == 1
        monkeypatch.undo()
        # The same bytes again are a new attempt.
        assert settled(http, post(http, 1))["state"] == "ready"


def test_a_process_that_is_killed_once_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.kill_once)
    monkeypatch.setattr(jobs, "_allowed", slow.allow_more)
    with running(tmp_path / "data") as http:
        assert settled(http, post(http, 1))["state"] == "ready"
        assert (tmp_path / "data" / "killed").exists()


def test_a_build_that_uses_too_much_processor_time_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.out_of_processor_time)
    with running(tmp_path / "data", build_seconds=50.0) as http:
        surface = settled(http, post(http, 1))
        assert surface["state"] == "waiting"
        assert surface["reason"] == "the build took more processor time than 50 s"
        monkeypatch.undo()
        assert settled(http, post(http, 1))["state"] == "ready"


def test_a_build_that_needs_too_much_memory_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.hoard)
    with running(tmp_path / "data", build_memory=1 << 30) as http:
        surface = settled(http, post(http, 1))
        assert surface["state"] == "waiting"
        assert "more memory than its share, 1024 MiB (LODESTREAM_MEMORY), 2 times" in surface["reason"]
        monkeypatch.undo()
        assert settled(http, post(http, 1))["state"] == "ready"


def test_a_process_that_is_told_to_end_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.end_once)
    monkeypatch.setattr(jobs, "_allowed", slow.allow_more)
    with running(tmp_path / "data") as http:
        assert settled(http, post(http, 1))["state"] == "ready"
        assert (tmp_path / "data" / "told").exists()


def test_what_nobody_foresaw_does_not_tell_the_servers_inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.explode)
    with running(tmp_path / "data") as http:
        surface = settled(http, post(http, 1))
        assert (surface["state"], surface["reason"]) == (
            "waiting",
            "the build failed with an internal error: ZeroDivisionError",
        )


def test_a_build_that_takes_too_long_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(tmp_path / "data", build_seconds=0.3) as http:
        surface = settled(http, post(http, 1))
        assert (surface["state"], surface["reason"]) == ("waiting", "the build took longer than 0.3 s")


def test_identical_uploads_at_once_are_one_surface(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data, workers=2) as http, ThreadPoolExecutor(8) as threads:
        bytes_, start = npy(hills(seed=1)), threading.Barrier(8)

        def send(number: int) -> httpx.Response:
            # Under different names, some as a form: neither makes another surface.
            start.wait()
            if number % 2:
                return http.post("/v1/surfaces", files={"file": (f"{number}.npy", bytes_)})
            return http.post("/v1/surfaces", content=bytes_, params={"filename": f"{number}.npy"})

        answers = list(threads.map(send, range(8)))
        assert {answer.status_code for answer in answers} == {202}
        (location,) = {answer.headers["location"] for answer in answers}
        building(http, location)
        assert len(list((data / "work").iterdir())) == 1
        assert [len(kept(data, name)) for name in ("records", "uploads", "incoming")] == [1, 1, 0]
        (data / "go").touch()
        assert settled(http, location)["state"] == "ready"
        assert http.post("/v1/surfaces", content=bytes_).status_code == 200


def test_a_restart_keeps_surfaces_and_takes_up_builds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        ready = push(http, npy(hills(seed=1)), name="kept")
        failed = push(http, npy(hills(seed=2))[:-1])
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data) as http:
        half = post(http, 3)
        building(http, half)
        queued = post(http, 4)
    monkeypatch.undo()
    assert list((data / "work").iterdir()) == []
    with running(data) as http:
        assert http.get(ready["url"]).json() == ready
        assert http.get(failed["url"]).json() == failed
        assert [settled(http, where)["state"] for where in (half, queued)] == ["ready", "ready"]
        assert len(http.get("/v1/surfaces").json()["surfaces"]) == 4


def crash(data: Path) -> None:
    """Leave the folder as a server leaves it that dies in the middle of the one build that is queued."""
    storage = Storage(data)
    (record,) = storage.records()
    storage.begin_work(record.id, storage.work_folder(record.id), may_continue=True)
    storage.close()


def test_a_build_under_which_server_after_server_dies_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data) as http:
        location = post(http, 1)
        building(http, location)
    # To be stopped properly does not count, whatever was under way.
    for _ in range(3):
        storage = Storage(data)
        assert [record.attempts for record in storage.records()] == [0]
        storage.close()
    for _ in range(2):
        crash(data)
    with running(data) as http:
        later = post(http, 2)
        building(http, location)
    with running(data) as http:
        # What may be to blame comes last.
        building(http, later)
        assert http.get(location).json()["state"] == "queued"
        http.delete(later)
        building(http, location)
    crash(data)
    with running(data) as http:
        surface = settled(http, location)
        assert surface["state"] == "waiting"
        assert surface["reason"] == "the server ended 3 times while this was being built"


def test_what_a_dead_server_left_half_done_is_swept_away(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, npy(hills()))
    for leftover in (
        "incoming/ab/0",
        "work/cd/container",
        "uploads/0123456789abcdef0123/0",
        f"containers/{'0' * 64}.lode",
    ):
        path = data / leftover
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"half")
    (data / "records" / "x.json.0123.new").write_bytes(b"{")
    with running(data) as http:
        assert [entry["id"] for entry in http.get("/v1/surfaces").json()["surfaces"]] == [surface["id"]]
    (upload,) = kept(data, "uploads")
    files = sorted(str(path.relative_to(data)) for path in data.rglob("*") if path.is_file() and path.name != MARKER)
    # What was whole, and nobody speaks of, is not removed.
    assert files == [
        f"containers/{surface['container']}.lode",
        f"damaged/containers/{'0' * 64}.lode",
        "damaged/uploads/0123456789abcdef0123/0",
        "lock",
        f"records/{surface['id']}.json",
        f"uploads/{upload}/0",
        f"uploads/{upload}/{surface['id']}.json",
    ]


def test_a_lost_container_is_built_again_and_without_its_upload_it_is_missing(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        one, two = push(http, npy(hills(seed=1))), push(http, npy(hills(seed=2)))
    for surface in (one, two):
        (data / "containers" / f"{surface['container']}.lode").unlink()
    upload = upload_of(data, two)
    upload.rename(data / "away")
    before = (data / "records" / f"{two['id']}.json").read_bytes()
    with running(data) as http:
        assert settled(http, one["url"])["container"] == one["container"]
        lost = http.get(two["url"]).json()
        assert lost["state"] == "missing"
        assert lost["reason"] == "neither its upload nor its container is on the server's disk"
        for path in (f"{two['url']}/container", f"{two['url']}/levels/0", f"/v1/containers/{two['container']}.lode"):
            answer = http.get(path)
            assert (answer.status_code, answer.json()["code"]) in ((503, "missing"), (404, "not-found"))
        assert http.get(f"{two['url']}/container").status_code == 503
        # Once it is there again it is enough to ask.
        (data / "away").rename(upload)
        assert (data / "records" / f"{two['id']}.json").read_bytes() == before
        assert http.post(f"{two['url']}/retry").status_code == 202
        assert settled(http, two["url"])["container"] == two["container"]


def test_a_record_that_cannot_be_read_is_left_alone_with_its_bytes(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, npy(hills()))
    path = data / "records" / f"{surface['id']}.json"
    copy = upload_of(data, surface) / path.name
    path.write_text("{not json")
    copy.write_text("{not json")
    storage = Storage(data)
    (record,) = storage.records()
    assert (record.id, record.state) == (surface["id"], "missing")
    storage.close()
    assert path.read_text() == copy.read_text() == "{not json"
    assert (copy.parent / "0").is_file()
    assert (data / "containers" / f"{surface['container']}.lode").is_file()


def test_two_servers_never_share_a_folder(tmp_path: Path) -> None:
    storage = Storage(tmp_path)
    with pytest.raises(LodestreamError, match="which another one uses"):
        Storage(tmp_path)
    storage.close()
    Storage(tmp_path).close()


def test_a_record_written_by_a_later_version_is_read(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, npy(hills()))
    path = data / "records" / f"{surface['id']}.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "later": "something"}))
    storage = Storage(data)
    assert storage.get(surface["id"]).state == "ready"
    storage.close()


def test_what_a_build_leaves_is_removed_though_it_is_cancelled(tmp_path: Path) -> None:
    """A surface is deleted as soon as it is ready: its build is still tidying up, and no thread is free for that."""
    folder = tmp_path / "left"
    folder.mkdir()

    async def cancelled() -> None:
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1))
        free = threading.Event()
        busy = asyncio.ensure_future(asyncio.to_thread(free.wait, PATIENCE))
        await asyncio.sleep(0)
        task = asyncio.ensure_future(jobs._carried_out(partial(discard, folder)))
        await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.sleep(0.01)
        free.set()
        with pytest.raises(asyncio.CancelledError):
            await task
        await busy

    asyncio.run(cancelled())
    assert not folder.exists()


def test_what_builds_and_levels_import_is_there_before_they_begin(tmp_path: Path) -> None:
    program = """
import sys
from pathlib import Path
from lodestream_server.builds import fork_server, worker
worker.preload()
from lodestream_server.builds.levels import LevelJob, MadeLevel, make_level
before = set(sys.modules)
job = worker.Job((Path("a.npy"),), "a.npy", None, "auto", {"precision": "0.1"}, 10_000, Path("built"))
assert isinstance(worker.build(job), worker.Built)
assert isinstance(make_level(LevelJob(job.container, 0, "ply", Path("level"), 10_000, 1 << 28)), MadeLevel)
print(*sorted(set(sys.modules) - before), "fastapi" in sys.modules)
"""
    (tmp_path / "a.npy").write_bytes(npy(hills()))
    for name in ("built", "level"):
        (tmp_path / name).mkdir()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
