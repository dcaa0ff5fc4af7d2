"""What could not be built for a local reason waits, with its upload and the reason, until somebody asks again."""

from __future__ import annotations

import asyncio
import errno
import logging
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from lodestream.errors import FormatError, TooLargeError, UnavailableError
from lodestream.stores import Folder, FullError, StoreError, Tag
from lodestream_server import Settings
from lodestream_server.builds import builder, results, worker
from lodestream_server.builds.processes import ForkServer
from lodestream_server.builds.results import check as results_check
from lodestream_server.maintenance.check import check
from lodestream_server.maintenance.waiting import retry, waiting
from lodestream_server.store.uploads import check_upload
from tests.patience import PATIENCE
from tests.server.builds import slow
from tests.server.builds.test_builds import building, running
from tests.server.helpers import eventually, hills, kept, npy, problem, push, settled, upload_of

BODY = npy(hills(seed=5))


def index_of(data: Path) -> Path:
    return data / "scratch" / "index.sqlite"


@pytest.mark.parametrize(
    "cause",
    [
        UnavailableError("a library is missing"),
        TooLargeError("more vertices than this server takes"),
        MemoryError("no memory"),
        OSError(errno.EIO, "the disk"),
        PermissionError(errno.EACCES, "not for us"),
    ],
)
def test_a_reason_that_is_not_in_the_bytes_may_pass(cause: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(*_: object, **__: object) -> object:
        if isinstance(cause, UnavailableError | TooLargeError):
            raise cause
        try:
            raise cause
        except Exception:
            raise FormatError("expected a file that can be read") from None

    monkeypatch.setattr(worker, "_build", read)
    refused = worker.build(worker.Job((), None, None, "auto", {}, 1, Path()))
    assert isinstance(refused, worker.Refused)
    assert not refused.final


def test_memory_that_gdal_lacks_may_pass() -> None:
    """Its number is that of a missing file, and its words are those of a driver."""
    lacking = pytest.importorskip("rasterio._err").CPLE_OutOfMemoryError(3, 2, "There is none for the block cache")
    refused = FormatError("GDAL cannot read this GeoTIFF")
    refused.__context__ = lacking
    assert worker.may_pass(refused)


@pytest.mark.parametrize(
    "words",
    [
        "TIFFFillStrip:No space for data buffer at scanline 4294967295",
        "ZSTDDecode:Error in ZSTD_decompressStream(): Allocation error : not enough memory",
        "LERCPreDecode:Cannot allocate buffer",
        "JPEGLib:Insufficient memory (case 4)",
        "Failed to allocate memory for tile buffer (1 elements of 4096 bytes each)",
        "No space to expand strip arrays",
    ],
)
def test_memory_that_a_library_of_gdal_lacks_may_pass(words: str) -> None:
    """To GDAL it is any error."""
    refused = FormatError("GDAL cannot read this GeoTIFF")
    refused.__context__ = pytest.importorskip("rasterio._err").CPLE_AppDefinedError(3, 1, words)
    assert worker.may_pass(refused)


# Reads a file with ever more memory, in processes of their own, and prints what became of it.
LIMITED = """
import os, resource, sys
from lodestream.errors import LodestreamError
from lodestream.formats import read
from lodestream_server.builds.worker import may_pass

def outcome(more):
    with open("/proc/self/status") as status:
        (has,) = (int(line.split()[1]) << 10 for line in status if line.startswith("VmData"))
    resource.setrlimit(resource.RLIMIT_DATA, (has + more, has + more))
    try:
        read(sys.argv[2])
    except MemoryError:
        return 1
    except LodestreamError as error:
        return 2 if may_pass(error) else 3
    return 0

read(sys.argv[1])  # what it takes to read any is there
found = []
while not found or found[-1] != 0:
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
        os._exit(outcome(len(found) << 21))
    found.append(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
print(*found)
"""


@pytest.mark.parametrize("compress", ["deflate", "zstd"])
def test_however_little_memory_there_is_no_raster_is_refused_for_good(tmp_path: Path, compress: str) -> None:
    rasterio = pytest.importorskip("rasterio")
    large, small = tmp_path / "large.tif", tmp_path / "small.tif"
    for path, size in ((large, 1500), (small, 20)):
        heights = np.random.default_rng(7).random((size, size), np.float32)
        place = rasterio.Affine(30, 0, 500_000, 0, -30, 4_000_000)
        profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "transform": place, "compress": compress}
        with rasterio.open(path, "w", height=size, width=size, blockysize=size, **profile) as dataset:
            dataset.write(heights, 1)
    program = [sys.executable, "-c", LIMITED, str(small), str(large)]
    said = subprocess.run(program, stdout=subprocess.PIPE, check=True, timeout=PATIENCE, text=True).stdout
    outcomes = {int(word) for word in said.split()}
    assert 3 not in outcomes, said
    assert 2 in outcomes, said  # GDAL lacked it


def test_a_raster_that_is_cut_short_is_refused_for_good(tmp_path: Path) -> None:
    """GDAL numbers its errors itself: what it cannot read has the number that a lack of rights has."""
    rasterio = pytest.importorskip("rasterio")
    path = tmp_path / "cut.tif"
    profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "tiled": True, "blockxsize": 64, "blockysize": 64}
    heights = hills(300, 300, seed=5).astype("f4")
    profile |= {"crs": "EPSG:32611", "transform": rasterio.Affine(30, 0, 500_000, 0, -30, 4_000_000)}
    with rasterio.open(path, "w", height=300, width=300, **profile) as dataset:
        dataset.write(heights, 1)
    path.write_bytes(path.read_bytes()[:50_000])
    job = worker.Job((path,), "cut.tif", None, "auto", {}, 10**6, tmp_path / "build")
    job.folder.mkdir()
    refused = worker.build(job)
    assert isinstance(refused, worker.Refused)
    assert refused.final
    assert "cut.tif: GDAL cannot read this GeoTIFF, which may be damaged or cut short: " in refused.reason
    assert "data.tif" not in refused.reason


def test_bytes_that_are_no_surface_are_refused_for_good(tmp_path: Path) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, BODY[:-1])
        assert surface["state"] == "failed"
        assert (upload_of(data, surface) / "0").read_bytes() == BODY[:-1]
        assert http.delete(surface["url"]).status_code == 204
        assert kept(data, "uploads") == kept(data, "built") == kept(data, "surfaces") == []


@pytest.mark.parametrize(("kind", "state"), [(FullError, "queued"), (StoreError, "waiting")])
def test_nobody_is_told_of_a_failure_that_a_restart_could_take_back(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    kind: type[StoreError],
    state: str,
) -> None:
    """Where the failure is not in the store, the surface is queued after a restart."""
    caplog.set_level(logging.INFO, "lodestream_server")
    create = Folder.create

    def broken(store: Folder, key: str, data: bytes) -> Tag:
        if key.startswith("built/"):
            raise kind(f"{store.root}: it does not work")
        return create(store, key, data)

    monkeypatch.setattr(Folder, "create", broken)
    monkeypatch.setattr(builder, "_FIRST_DELAY", 0.01)
    with running(tmp_path / "data") as http:
        location = http.post("/v1/surfaces", content=BODY[:-1]).headers["location"]

        def reason() -> str | None:
            said: dict[str, Any] = http.get(location).json()
            assert said["state"] in ("queued", "building", state)
            return said.get("reason") if said["state"] == state else None

        told = eventually(reason, "a reason")
        assert not [record for record in caplog.records if " failed: " in record.getMessage()]
        assert 'state="failed"' not in http.get("/metrics").text
        monkeypatch.undo()
        if state == "queued":
            assert told == "waits for space on the server's disk"
        else:
            assert told.endswith("; that could not be stored")
            assert http.post(f"{location}/retry").status_code == 202
        # Where the data are is for the log.
        assert str(tmp_path) not in told
        assert f"{tmp_path / 'data'}: it does not work" in caplog.text
        assert eventually(lambda: settled(http, location)["state"] == "failed", "the failure")
    with running(tmp_path / "data") as http:
        assert http.get(location).json()["state"] == "failed"


def test_it_waits_over_a_restart_and_is_built_when_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.kill)
    with running(data) as http:
        surface = push(http, BODY)
        assert surface["state"] == "waiting"
        assert "process ended" in surface["reason"]
        for path in (f"{surface['url']}/container", f"{surface['url']}/levels/0"):
            assert problem(http.get(path)) == (409, "waiting")
    monkeypatch.undo()
    with running(data) as http:
        # Nobody asked: it is not built at every start, which it may have ended.
        assert http.get(surface["url"]).json() == surface
        answer = http.post(f"{surface['url']}/retry")
        assert (answer.status_code, answer.headers["location"]) == (202, surface["url"])
        ready = settled(http, surface["url"])
        assert (ready["state"], ready["reason"]) == ("ready", None)
        answer = http.post(f"{surface['url']}/retry")
        assert (answer.status_code, answer.json()) == (200, ready)
        assert http.post("/v1/surfaces/0123/retry").status_code == 404


def test_asking_at_once_is_not_lost(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "build", slow.explode)
    with running(tmp_path / "data") as http:
        surface = push(http, BODY)
        for _ in range(10):
            assert http.post(f"{surface['url']}/retry").status_code == 202
            assert settled(http, surface["url"])["state"] == "waiting"


def test_what_waits_is_built_by_the_next_start_when_asked_without_a_server(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", slow.explode)
    with running(data) as http:
        surface = push(http, BODY)
    store = Folder(data)
    assert waiting(store, index_of(data)) == {surface["id"]: surface["reason"]}
    report = check(store, repair=True, waiting=[surface["id"]])
    assert (report.findings, report.queued) == ([], 0)
    monkeypatch.undo()
    with running(data) as http:
        assert http.get(surface["url"]).json()["state"] == "waiting"
    assert retry(store, index_of(data)) == {surface["id"]: surface["reason"]}
    with running(data) as http:
        assert settled(http, surface["url"])["state"] == "ready"


@pytest.mark.parametrize("build", [slow.kill, slow.explode, slow.refuse])
def test_a_rebuild_that_fails_costs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, build: Any) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        surface = push(http, BODY)
    container = data / "containers" / f"{surface['container_sha256']}.lode"
    whole = container.read_bytes()
    container.write_bytes(whole[:-1])
    report = check(Folder(data), repair=True)
    assert [(found.what, found.repaired, found.lost) for found in report.findings] == [("container", True, False)]
    monkeypatch.setattr(worker, "build", build)
    with running(data) as http:
        left = settled(http, surface["url"])
        assert left["state"] == "waiting", left
        assert (upload_of(data, surface) / "0").read_bytes() == BODY
    monkeypatch.undo()
    assert list(retry(Folder(data), index_of(data))) == [surface["id"]]
    with running(data) as http:
        assert settled(http, surface["url"]) == surface
    assert container.read_bytes() == whole
    assert check(Folder(data)).findings == []


@pytest.mark.parametrize("read", [BODY[:-1], b"x" + BODY[1:]], ids=["shorter", "other"])
def test_an_upload_that_cannot_be_read_is_not_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read: bytes
) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        other = push(http, BODY, name="of the same bytes")
    monkeypatch.setattr(worker, "build", slow.wait)
    with running(data) as http:
        where = http.post("/v1/surfaces", content=BODY).headers["location"]
        building(http, where)  # which has been found as it was acknowledged
        (upload_of(data, other) / "0").write_bytes(read)  # as a bad disk gives it back
        (data / "go").touch()
        surface = settled(http, where)
        assert surface["state"] == "waiting"
        assert "the upload is damaged or cannot be read: expected " in surface["reason"]
        monkeypatch.undo()
        # The same file again makes it whole, also for the other surface.
        assert push(http, BODY)["state"] == "ready"
        assert (upload_of(data, other) / "0").read_bytes() == BODY


def test_an_upload_that_cannot_be_read_at_this_moment_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    failures = [OSError(errno.EMFILE, "no more open files"), OSError(errno.ENOMEM, "no memory")]

    def checked(*given: Any) -> str | None:
        if failures:
            raise failures.pop()
        return check_upload(*given)

    monkeypatch.setattr(builder, "check_upload", checked)
    monkeypatch.setattr(builder, "_FIRST_DELAY", 0.01)
    with running(tmp_path / "data") as http:
        assert push(http, BODY)["state"] == "ready"
    assert not failures


def test_builds_whose_folder_is_removed_again_and_again_do_not_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    removed: list[Path] = []

    def lost(container: Path, *given: Any) -> dict[str, Any]:
        if len(removed) < 4:
            shutil.rmtree(container.parent)
            removed.append(container)
        return results_check(container, *given)

    monkeypatch.setattr(results, "check", lost)
    monkeypatch.setattr(builder, "_FIRST_DELAY", 0.01)
    with running(tmp_path / "data") as http:
        assert push(http, BODY)["state"] == "ready"
    assert len(removed) == 4


def test_a_build_whose_program_is_missing_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is not its folder that is missing: it would be tried again for ever, and nobody would know why."""

    def wait(*_: object) -> str | None:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", "python")

    monkeypatch.setattr(ForkServer, "wait", wait)
    with running(tmp_path / "data") as http:
        location = http.post("/v1/surfaces", content=BODY).headers["location"]
        reason = eventually(lambda: http.get(location).json()["reason"], "the build to be given up")
        assert reason == "the server's disk: No such file or directory"
        assert settled(http, location)["state"] == "waiting"


def test_a_delete_that_is_cut_short_lets_the_build_end_and_deletes_nothing(tmp_path: Path) -> None:
    """Otherwise the files would go while the process of the build still runs."""
    deleted, nothing = list[str](), MagicMock()
    surfaces = MagicMock()
    surfaces.delete = deleted.append
    surfaces.index.find.return_value = None

    async def delete() -> None:
        made = builder.Builder(surfaces, nothing, Settings(data=tmp_path), nothing, nothing)
        ends = asyncio.Event()

        async def build() -> None:
            try:
                await asyncio.Future()
            finally:
                await ends.wait()

        build_task = made._tasks["a"] = asyncio.create_task(build())
        await asyncio.sleep(0)
        asked = asyncio.create_task(made.delete("a"))
        await asyncio.sleep(0)
        asked.cancel()
        await asyncio.wait((asked,))
        assert (asked.cancelled(), build_task.done(), build_task.cancelling(), deleted) == (True, False, 1, [])
        ends.set()
        await made.delete("a")
        assert (build_task.cancelled(), deleted, made._deleting) == (True, ["a"], set())

    asyncio.run(delete())
