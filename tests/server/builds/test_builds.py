"""Builds: progress, cancelling, processes that die, restarts, and the folder in which everything lies."""

from __future__ import annotations

import asyncio
import os
import shutil
import stat
import subprocess
import sys
import threading
import zlib
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
from lodestream_server.builds import builder, worker
from lodestream_server.builds.work import Work
from lodestream_server.operation.disks import disk_of
from lodestream_server.operation.threads import carried_out
from lodestream_server.store.data import Data
from lodestream_server.store.durable import discard
from tests.server.builds import slow
from tests.server.helpers import PATIENCE, eventually, hills, kept, npy, problem, push, settled, upload_of
from tests.server.store.world import upload


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
        eventually(lambda: not kept(data, "scratch/work"), "the work folder empty")


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
    monkeypatch.setattr(builder, "_allowed", slow.allow_more)
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
        assert "more memory than its share, 1024 MiB (LODESTREAM_MEMORY): 3 builds began" in surface["reason"]
        monkeypatch.undo()
        assert settled(http, post(http, 1))["state"] == "ready"


def test_a_process_that_is_told_to_end_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.end_once)
    monkeypatch.setattr(builder, "_allowed", slow.allow_more)
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
        assert len(list((data / "scratch" / "work").iterdir())) == 1
        assert [len(kept(data, name)) for name in ("surfaces", "uploads", "scratch/incoming")] == [1, 1, 0]
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
    assert list((data / "scratch" / "work").iterdir()) == []
    with running(data) as http:
        assert http.get(ready["url"]).json() == ready
        assert http.get(failed["url"]).json() == failed
        assert [settled(http, where)["state"] for where in (half, queued)] == ["ready", "ready"]
        assert len(http.get("/v1/surfaces").json()["surfaces"]) == 4


@contextmanager
def stopped(data: Path) -> Iterator[Data]:
    """The data folder of a server that does not run."""
    folder = Data(data)
    try:
        yield folder
    finally:
        folder.close()


def crash(data: Path) -> None:
    """Leave the folder as a server leaves it that dies in the middle of the one build that is queued."""
    with stopped(data) as folder:
        (surface,) = folder.surfaces.index.queued()
        work = Work(folder.work)
        work.begin(surface, work.new_attempt(surface), may_continue=True)
        folder.surfaces.begin(surface)


def attempts(data: Path) -> list[int]:
    """How often builds of the surfaces have begun and come to no end."""
    with stopped(data) as folder:
        return [surface.attempts for surface in folder.surfaces.index.page((0.0, ""), 10)]


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
        assert attempts(data) == [0]
    for _ in range(2):
        crash(data)
    assert attempts(data) == [2]
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
        assert surface["reason"] == "the server ended: 3 builds began and did not end"
        # Whoever asks for it begins to count anew.
        assert http.post(f"{location}/retry").status_code == 202
        building(http, location)
    assert attempts(data) == [0]


def test_of_a_long_queue_some_builds_are_taken_up_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, most = tmp_path / "data", list[int]()
    folder = Data(data)
    for number in range(11):
        folder.surfaces.accept(*upload(tmp_path, number))
    folder.close()
    monkeypatch.setattr(builder, "_TAKEN_UP", 4)
    submit = builder.Builder._submit

    def counted(self: builder.Builder, surface: str, caller: str | None) -> None:
        submit(self, surface, caller)
        most.append(self.pending)

    monkeypatch.setattr(builder.Builder, "_submit", counted)
    with running(data) as http:
        for entry in http.get("/v1/surfaces").json()["surfaces"]:
            settled(http, entry["url"])
    assert max(most) <= 5


def test_servers_and_processes_that_die_count_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data) as http:
        location = post(http, 1)
    for _ in range(2):
        crash(data)
    monkeypatch.setattr(worker, "build", slow.kill)
    with running(data) as http:
        surface = settled(http, location)
    assert surface["state"] == "waiting"
    assert surface["reason"].startswith("the build failed: the process ended")
    assert surface["reason"].endswith("SIGKILL): 3 builds began and did not end")


def test_a_start_removes_what_a_dead_server_left_in_its_scratch_and_nothing_else(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, npy(hills()))
    (upload,) = kept(data, "uploads")
    stray = f"containers/{'0' * 64}.lode", f"uploads/{'0' * 64}/0", ".lodestream/0123456789abcdef.new"
    scratch = "scratch/incoming/ab/0", "scratch/work/cd/container", "scratch/levels/ef/level"
    for leftover in (*stray, *scratch):
        path = data / leftover
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"half")
    with running(data) as http:
        assert [entry["id"] for entry in http.get("/v1/surfaces").json()["surfaces"]] == [surface["id"]]
    files = sorted(str(path.relative_to(data)) for path in data.rglob("*") if path.is_file())
    # What was whole, and nobody speaks of, is removed by `lodestream fsck --collect` alone.
    assert files == sorted(
        [
            *stray,
            ".lodestream/lock",
            f"built/{surface['id']}.json",
            f"containers/{surface['container_sha256']}.lode",
            "lock",
            "lodestream.json",
            "scratch/index.sqlite",
            "scratch/index.sqlite.room",
            "scratch/lock",
            f"surfaces/{surface['id']}.json",
            f"uploads/{upload}/0",
        ]
    )


def busy(answer: httpx.Response) -> bool:
    """Whether a server tells to come back, since it has noticed that something is not there."""
    return problem(answer) == (503, "busy") and int(answer.headers["retry-after"]) >= 1


@pytest.mark.parametrize("path", ["{url}/container", "{url}/levels/0", "/v1/containers/{container_sha256}.lode"])
def test_a_lost_container_is_built_again_when_somebody_opens_it(tmp_path: Path, path: str) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, npy(hills()))
        container = data / "containers" / f"{surface['container_sha256']}.lode"
        whole = container.read_bytes()
        container.unlink()
        lost = http.get(path.format(**surface), follow_redirects=True)
        # What is asked for by surface is told that it is not ready now.
        assert problem(lost) == (409, "not-ready") if path.startswith("{url}") else busy(lost)
        again = eventually(lambda: (it := settled(http, surface["url"]))["container_sha256"] and it, "another build")
        assert again == surface
        assert container.read_bytes() == whole
        assert http.get(path.format(**surface), follow_redirects=True).status_code == 200


def test_without_its_upload_a_lost_container_is_waited_for(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, npy(hills()))
    container = data / "containers" / f"{surface['container_sha256']}.lode"
    upload = upload_of(data, surface)
    upload.rename(data / "away")
    before = {path: path.read_bytes() for name in ("surfaces", "built") for path in (data / name).iterdir()}
    with running(data) as http:
        assert http.get(surface["url"]).json() == surface, "its container is there"
        assert http.get(f"{surface['url']}/container", follow_redirects=True).status_code == 200
        container.rename(data / "lost")
        assert problem(http.get(f"{surface['url']}/container"))[0] == 409
        waiting = settled(http, surface["url"])
        assert (waiting["state"], waiting["container_sha256"]) == ("waiting", None)
        assert waiting["reason"] == "its upload is not in the server's store"
        assert http.get(f"{surface['url']}/container").status_code == 409
        assert busy(http.get(f"/v1/containers/{surface['container_sha256']}.lode"))
        assert {path: path.read_bytes() for path in before} == before
        # Once either is there again it is enough to ask.
        (data / "lost").rename(container)
        assert http.post(f"{surface['url']}/retry").status_code == 202
        assert settled(http, surface["url"]) == surface
        assert http.get(f"{surface['url']}/container", follow_redirects=True).status_code == 200
        container.unlink()
        assert problem(http.get(f"{surface['url']}/container"))[0] == 409
        assert settled(http, surface["url"])["state"] == "waiting"
        (data / "away").rename(upload)
        assert http.post(f"{surface['url']}/retry").status_code == 202
        assert settled(http, surface["url"]) == surface


def test_a_manifest_that_cannot_be_read_is_left_alone_with_its_bytes(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface, other = push(http, npy(hills())), push(http, npy(hills()), name="of the same bytes")
    path = data / "surfaces" / f"{surface['id']}.json"
    files = (upload_of(data, surface) / "0", data / "containers" / f"{surface['container_sha256']}.lode")
    path.write_text("{not json")
    (data / "scratch" / "index.sqlite").unlink()
    with running(data) as http:
        assert http.get(surface["url"]).status_code == 404
        # Nobody knows what the other one refers to.
        assert http.delete(other["url"]).status_code == 204
        assert path.read_text() == "{not json"
        assert all(file.is_file() for file in files)
        # The same upload again takes its place, and is built again.
        again = push(http, npy(hills()))
        assert (again["id"], again["state"], again["container_sha256"]) == (
            surface["id"],
            "ready",
            surface["container_sha256"],
        )
    with running(data) as http:
        assert http.get(surface["url"]).json() == again


def test_two_servers_never_share_a_folder(tmp_path: Path) -> None:
    with stopped(tmp_path), pytest.raises(LodestreamError, match="which another one uses"):
        Data(tmp_path)
    Data(tmp_path).close()


@pytest.mark.parametrize("name", ["surfaces", "built"])
def test_what_a_later_version_writes_is_read(tmp_path: Path, name: str) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, npy(hills()))
    path = data / name / f"{surface['id']}.json"
    body, _, _ = path.read_bytes().rpartition(b', "check": ')
    body = body.replace(b"{", b'{"later": {"something": [1]}, ', 1)
    path.write_bytes(body + b', "check": "%08x"}' % zlib.crc32(body))
    with running(data) as http:
        assert http.get(surface["url"]).json() == surface


def test_the_same_bytes_of_two_names_are_built_twice_and_stored_once(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        one, two = push(http, npy(hills()), name="one"), push(http, npy(hills()), name="two")
        assert (one["state"], two["state"]) == ("ready", "ready")
        assert [len(kept(data, name)) for name in ("surfaces", "uploads", "containers")] == [2, 1, 2]
        three = push(http, npy(hills()), name="one", precision="0.5")
        assert (three["state"], len(kept(data, "uploads"))) == ("ready", 1)


def test_builds_and_uploads_go_on_while_the_scratch_folder_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A build whose work is gone begins again, and nobody has to ask for that."""
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data) as http:
        location = post(http, 1)
        building(http, location)
        (data / "scratch").rename(tmp_path / "away")
        assert disk_of(data / "scratch" / "work").total > 0

        def taken() -> str | None:
            answer = http.post("/v1/surfaces", content=npy(hills(9, 8)), params={"filename": "hills.npy"})
            assert answer.status_code == 202 or busy(answer), answer.text
            return str(answer.headers["location"]) if answer.status_code == 202 else None

        second = eventually(taken, "the upload to be taken")
        (data / "go").touch()
        eventually(lambda: http.get("/readyz").status_code == 200, "the index to be made again")
        assert [settled(http, where)["state"] for where in (location, second)] == ["ready", "ready"]
    assert stat.S_IMODE((data / "scratch").stat().st_mode) == 0o700


def test_builds_go_on_while_the_index_is_lost_and_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data) as http:
        location = post(http, 1)
        building(http, location)
        behind = post(http, 2)
        for path in (data / "scratch").glob("index.sqlite*"):
            path.unlink()
        for where in (location, behind):

            def there(where: str = where) -> dict[str, Any] | None:
                answer = http.get(where)
                if answer.status_code == 503:
                    assert busy(answer)
                    return None
                return dict(answer.raise_for_status().json())

            assert eventually(there, "the index")["state"] in ("queued", "building")
        (data / "go").touch()
        assert [settled(http, where)["state"] for where in (location, behind)] == ["ready", "ready"]
    assert any("is made again" in record.getMessage() for record in caplog.records)
    assert kept(data, "scratch/work") == []


def test_scratch_may_be_elsewhere_and_go(tmp_path: Path) -> None:
    data, scratch = tmp_path / "data", tmp_path / "fast" / "disk"
    with running(data, scratch=scratch) as http:
        surface = push(http, npy(hills()))
        assert http.get(f"{surface['url']}/levels/0").status_code == 200
    assert not (data / "scratch").exists()
    assert kept(scratch, "work") == []
    shutil.rmtree(scratch)
    with running(data, scratch=scratch) as http:
        assert http.get(surface["url"]).json() == surface
        assert http.get(f"{surface['url']}/levels/0").status_code == 200


def test_what_a_build_leaves_is_removed_though_it_is_cancelled(tmp_path: Path) -> None:
    """A surface is deleted as soon as it is ready: its build is still tidying up, and no thread is free for that."""
    folder = tmp_path / "left"
    folder.mkdir()

    async def cancelled() -> None:
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(1))
        free = threading.Event()
        busy = asyncio.ensure_future(asyncio.to_thread(free.wait, PATIENCE))
        await asyncio.sleep(0)
        task = asyncio.ensure_future(carried_out(partial(discard, folder)))
        await asyncio.sleep(0.01)
        task.cancel()
        await asyncio.sleep(0.01)
        free.set()
        with pytest.raises(asyncio.CancelledError):
            await task
        await busy

    asyncio.run(cancelled())
    assert not folder.exists()


@pytest.mark.long
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


def test_an_upload_is_the_same_as_long_as_nobody_puts_another_in_its_place(tmp_path: Path) -> None:
    file, part = tmp_path / "upload", tmp_path / "part"
    file.write_bytes(b"abc")
    begun = builder._identities([file])
    # What came in parts keeps its name there until it is a surface.
    part.hardlink_to(file)
    part.unlink()
    assert builder._identities([file]) == begun
    other = tmp_path / "other"
    other.write_bytes(b"abc")
    other.replace(file)
    assert builder._identities([file]) != begun
    file.unlink()
    assert builder._identities([file]) is None
