"""Builds run apart: what a process may do whose reader a file has taken over, and what is believed of its word."""

from __future__ import annotations

import asyncio
import ctypes
import json
import logging
import os
import re
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import lodestream as ls
from lodestream.confinement import landlock
from lodestream.stores import Folder
from lodestream_server.builds import builder, worker
from lodestream_server.builds.answers import UnforeseenError
from lodestream_server.builds.processes import Call, ForkServer, Pool
from lodestream_server.maintenance.check import check
from lodestream_server.store.durable import remove
from tests.patience import PATIENCE
from tests.server.builds import slow
from tests.server.builds.test_builds import running
from tests.server.connections import hostile
from tests.server.helpers import eventually, hills, kept, npy, push, settled

Build = Callable[[worker.Job], worker.Built | worker.Parsed | worker.Refused]

WHOLE = sys.platform == "linux" and bool(landlock.version(ctypes.CDLL(None)))
needs_landlock = pytest.mark.skipif(not WHOLE, reason="this kernel has no Landlock")

BODY = npy(hills(seed=7))
VTK = b"# vtk DataFile Version 3.0\nx\nASCII\n"


def build_by(http: httpx.Client, monkeypatch: pytest.MonkeyPatch, build: Build, body: bytes = BODY) -> dict[str, Any]:
    """What becomes of an upload whose build does something else."""
    with monkeypatch.context() as patch:
        patch.setattr(worker, "build", build)
        return push(http, body)


@pytest.fixture
def other(http: httpx.Client) -> Iterator[dict[str, Any]]:
    """Somebody else's surface, which comes to no harm."""
    made = push(http, npy(hills(seed=8)), name="other")
    container = http.get(f"{made['url']}/container", follow_redirects=True).content
    yield made
    assert http.get(made["url"]).json() == made
    assert http.get(f"{made['url']}/container", follow_redirects=True).content == container


@needs_landlock
def test_a_call_that_is_confined_less_than_the_trial_does_not_run() -> None:
    server = ForkServer(slow.weaken)

    async def check() -> None:
        pool = Pool(1, server)
        try:
            async with asyncio.timeout(PATIENCE):
                with pytest.raises(UnforeseenError, match="RuntimeError") as raised:
                    await pool.run(Call(slow.number))
            assert "this process is confined by ('seccomp',)" in raised.value.traceback
        finally:
            await asyncio.to_thread(pool.close)

    try:
        asyncio.run(check())
    finally:
        server.close()


@needs_landlock
def test_there_is_no_way_out(
    http: httpx.Client, data: Path, other: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    victim = data / "victim"
    victim.write_text("another's")
    before = victim.stat()
    escaped = Path("/tmp/lodestream-escaped")
    try:
        made = build_by(http, monkeypatch, hostile.escape)
        assert made["state"] == "failed"
        done, handles, secrets = json.loads(made["reason"])
        assert done == ["read the upload", "write the folder"]
        assert (handles, secrets) == ([], [])
        after = victim.stat()
        assert (victim.read_text(), after.st_mode, after.st_mtime) == ("another's", before.st_mode, before.st_mtime)
        assert not escaped.exists()
    finally:
        escaped.unlink(missing_ok=True)
        victim.unlink()
        http.delete(made["url"])


def test_no_secret_of_the_server_is_in_the_environment(
    http: httpx.Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SOMEBODYS_SECRET", "x")
    monkeypatch.setenv("LODESTREAM_TOKEN", "x")
    server = ForkServer()
    try:
        server.wait()
        environment = Path(f"/proc/{server.pid}/environ").read_bytes().split(b"\0")
        names = {entry.partition(b"=")[0].decode() for entry in environment}
        assert "PATH" in names
        assert not names & {"SOMEBODYS_SECRET", "LODESTREAM_TOKEN"}
        assert len(os.listdir(f"/proc/{server.pid}/task")) == 1
    finally:
        server.close()


@pytest.mark.parametrize(
    "build",
    [
        hostile.say_nothing,
        hostile.say_garbage,
        hostile.say_pickle,
        hostile.say_much,
        hostile.say_deep,
        hostile.say_something_else,
        hostile.say_a_class,
        hostile.forge_nothing,
        hostile.forge_hash,
        hostile.forge_path,
        hostile.forge_second_name,
        hostile.forge_folder,
        hostile.forge_container,
    ],
    ids=lambda build: str(build.__name__),
)
def test_no_word_of_it_is_believed(
    http: httpx.Client, data: Path, other: dict[str, Any], monkeypatch: pytest.MonkeyPatch, build: Build
) -> None:
    containers = kept(data, "containers")
    made = build_by(http, monkeypatch, build)
    assert made["state"] == "waiting"
    assert "gave an invalid answer" in made["reason"]
    assert made["reason"].endswith(": 3 builds began and did not end")
    assert made["container_sha256"] is None
    assert kept(data, "containers") == containers
    # The same bytes are built once nothing has taken the reader over.
    assert http.post(f"{made['url']}/retry").status_code == 202
    assert settled(http, made["url"])["state"] == "ready"
    assert http.delete(made["url"]).status_code == 204


def test_what_is_told_of_a_surface_comes_from_its_container(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    with running(data) as http:
        made = build_by(http, monkeypatch, hostile.forge_errors)
        assert made["state"] == "ready"
        assert "errors" not in made
    assert check(Folder(data)).findings == []


def test_a_reason_is_one_line_that_upsets_no_terminal(http: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    made = build_by(http, monkeypatch, hostile.forge_reason)
    assert made["state"] == "failed"
    assert made["reason"].startswith("two lines  [31m")
    assert made["reason"].isprintable()
    assert made["reason"].endswith("...")
    assert len(made["reason"].encode()) == 1024
    http.delete(made["url"])


def test_a_traceback_cannot_be_taken_for_lines_of_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with running(tmp_path / "data") as http, caplog.at_level(logging.ERROR):
        made = build_by(http, monkeypatch, hostile.forge_log)
        assert (made["state"], made["reason"]) == ("waiting", "the build failed with an internal error: ValueError")
    (record,) = [record for record in caplog.records if "failed unexpectedly" in record.getMessage()]
    assert "\x1b" not in record.getMessage()
    assert all(line.startswith("| ") for line in record.getMessage().split("\n")[:-1] if "INFO" in line)
    assert "| 2026 INFO forged" in record.getMessage()


def test_a_build_that_only_computes_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with running(tmp_path / "data", build_seconds=0.5) as http:
        made = build_by(http, monkeypatch, hostile.burn)
        assert made["state"] == "waiting"
        # On a busy machine either limit may be the first to be noticed.
        assert re.fullmatch(r"the build took (longer|more processor time) than 0\.5 s", made["reason"])


def test_processor_time_is_limited_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with running(tmp_path / "data", build_seconds=2) as http:
        made = build_by(http, monkeypatch, hostile.burn)
        assert made["state"] == "waiting"
        assert re.fullmatch("the build took (longer|more processor time) than 2 s", made["reason"])


def test_no_file_is_larger_than_a_container_may_be(http: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    made = build_by(http, monkeypatch, hostile.write_much)
    assert (made["state"], made["reason"]) == ("waiting", "the build failed with an internal error: OSError")
    http.delete(made["url"])


def test_a_folder_that_is_too_deep_is_removed(http: httpx.Client, data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = build_by(http, monkeypatch, hostile.dig)
    assert (made["state"], made["reason"]) == ("failed", "dug")
    eventually(lambda: not kept(data, "scratch/work"), "the work folder empty")
    http.delete(made["url"])


def test_nothing_but_what_was_asked_is_removed(tmp_path: Path) -> None:
    deep, beside = tmp_path / "deep", tmp_path / "beside"
    beside.mkdir()
    (beside / "file").touch()
    deep.mkdir()
    inner = deep
    for _ in range(40):
        (inner / "link").symlink_to(beside)
        (inner / "file").touch()
        inner = inner / "d"
        inner.mkdir()
    before = sys.getrecursionlimit()
    try:
        sys.setrecursionlimit(80)  # so that 40 are too deep
        remove(deep)
    finally:
        sys.setrecursionlimit(before)
    assert not deep.exists()
    assert (beside / "file").exists()


def test_the_file_of_the_progress_may_be_anything(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "data"
    monkeypatch.setattr(worker, "build", hostile.trick_progress)
    with running(data) as http:
        where = http.post("/v1/surfaces", content=BODY).headers["location"]
        eventually(lambda: http.get(where).json()["state"] == "building" or None, "the build to begin")
        for _ in range(20):
            assert http.get(where).json()["progress"] == 0.0
        (data / "go").touch()
        until = time.monotonic() + PATIENCE
        while (told := http.get(where).json())["state"] == "building" and time.monotonic() < until:
            assert 0.0 <= told["progress"] <= 1.0
        assert settled(http, where)["state"] == "ready"


@pytest.mark.parametrize("text", ["nan", "inf", "-1", "2", "", "x", "1e400"])
def test_a_progress_that_is_none(tmp_path: Path, text: str) -> None:
    (tmp_path / "progress").write_text(text)
    assert worker.read_progress(tmp_path) == 0.0


def test_what_a_build_leaves_behind_is_ended(http: httpx.Client, monkeypatch: pytest.MonkeyPatch) -> None:
    # Only the readers of some formats may start processes.
    made = build_by(http, monkeypatch, hostile.linger)
    assert (made["state"], made["reason"]) == ("waiting", "the build failed with an internal error: PermissionError")
    http.delete(made["url"])
    made = build_by(http, monkeypatch, hostile.linger, VTK)
    assert made["state"] == "failed"
    for process in json.loads(made["reason"]):
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)
    http.delete(made["url"])


def test_the_server_says_what_the_kernel_holds_builds_to(
    http: httpx.Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    told = eventually(lambda: http.get("/readyz").json()["confinement"], "it to be known")
    assert told in ("landlock+seccomp", "seccomp", "landlock", "none")
    assert told == "landlock+seccomp" or not WHOLE

    class Loose(ForkServer):
        held: tuple[str, ...] = ()

        @property
        def confinement(self) -> tuple[str, ...]:
            return self.held

    assert http.get("/readyz").json()["missing"] == [] or not WHOLE
    lacks = (["landlock", "seccomp"], ["landlock"])
    for held, words, names in (((), "has neither", lacks[0]), (("seccomp",), "has only seccomp", lacks[1])):
        monkeypatch.setattr(Loose, "held", held)
        monkeypatch.setattr(builder, "ForkServer", lambda _: Loose())
        caplog.clear()
        with running(tmp_path / str(len(held))) as other:
            answer = eventually(partial(_ready, other), "the server to be ready")
            missing = answer.pop("missing")
            confinement = "+".join(held) or "none"
            assert answer == {"status": "ready", "role": "writer", "index": "current", "confinement": confinement}
            assert [sentence.partition(": a build may ")[0] for sentence in missing] == names
        (warning,) = [record.getMessage() for record in caplog.records if words in record.getMessage()]
        assert all(sentence in warning for sentence in missing)


def _ready(http: httpx.Client) -> dict[str, Any] | None:
    answer = http.get("/readyz")
    return answer.json() if answer.status_code == 200 else None


def test_real_formats_are_built_confined(http: httpx.Client, tmp_path: Path) -> None:
    import lodestream as ls

    heights = hills(seed=9)
    suffixes = [".npy"]
    for module, more in (("rasterio", [".tif"]), ("PIL", [".png"]), ("vtkmodules", [".vts"])):
        try:
            __import__(module)
        except ImportError:
            continue
        suffixes += more
    for suffix in suffixes:
        path = tmp_path / f"surface{suffix}"
        if suffix == ".npy":
            np.save(path, heights)
        elif suffix == ".png":
            ls.write(ls.Surface(np.rint(heights + 1000).astype(np.uint16)), path)
        else:
            ls.write(ls.Surface(heights), path)
        made = push(http, path.read_bytes(), filename=path.name)
        assert made["state"] == "ready", (suffix, made["reason"])
        http.delete(made["url"])


def test_conventions_of_netcdf_are_read_confined(http: httpx.Client, tmp_path: Path) -> None:
    """pyproj reads its database there, and the query of an upload chooses a group and attributes."""
    xarray, pyproj = pytest.importorskip("xarray"), pytest.importorskip("pyproj")
    pytest.importorskip("h5netcdf")
    mapping = {"grid_mapping_name": "mercator", "standard_parallel": 20.0, "longitude_of_projection_origin": 10.0}
    heights = hills(seed=3)
    axes = {
        name: (name, np.arange(n) * 3000.0, {"standard_name": f"projection_{name}_coordinate", "units": "m"})
        for name, n in zip("yx", heights.shape, strict=True)
    }
    grid = {"z": (("y", "x"), heights, {"grid_mapping": "crs"}), "crs": ((), 0, mapping)}
    data = xarray.Dataset(grid | {key: (("y", "x"), heights + k) for k, key in enumerate("uv")}, axes)
    path = tmp_path / "groups.nc"
    xarray.DataTree.from_dict({"/day": data, "/night": data}).to_netcdf(path, engine="h5netcdf")
    made = push(http, path.read_bytes(), filename="groups.nc", group="day", variable="z", attributes="u,v")
    assert made["state"] == "ready", made["reason"]
    surface = ls.decode(http.get(made["url"] + "/container", follow_redirects=True).content)
    np.testing.assert_array_equal(surface.points, heights)
    for k, key in enumerate("uv"):
        np.testing.assert_array_equal(surface.attributes[key], heights + k)
    found = pyproj.CRS.from_wkt(surface.metadata["crs"]).to_cf()
    assert {key: found[key] for key in mapping} == mapping
    refused = push(http, path.read_bytes(), filename="groups.nc")
    assert "there are groups: day, night, choose with group=" in refused["reason"]


def test_netcdf_is_built_confined(http: httpx.Client, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("h5netcdf")
    for engine, name in (("h5netcdf", "four.nc"), ("scipy", "three.nc")):
        path = tmp_path / name
        xarray.Dataset({"z": (("y", "x"), hills(seed=3))}).to_netcdf(path, engine=engine)
        made = push(http, path.read_bytes(), filename=name)
        assert made["state"] == "ready", (engine, made["reason"])
        http.delete(made["url"])
