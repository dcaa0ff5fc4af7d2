"""Builds by bands that are interrupted: the next server continues them, and is harmed by nothing that they left."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import httpx
import numpy as np
import pytest

import lodestream as ls
from lodestream.encoding import tasks
from lodestream_server.builds import worker
from lodestream_server.builds.work import Work
from tests.core.surfaces import terrain
from tests.server.builds.test_confinement import needs_landlock
from tests.server.helpers import eventually, kept, settled
from tests.server.programs import Server, server

#: Of a build: nothing fits into half of it in one piece that has so many points with holes, by `alone.preload_large`.
MEMORY, SIDE = 256 << 20, 620

Inodes = dict[str, int]


@pytest.fixture(scope="module")
def heights() -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    made = (100 * terrain((SIDE, SIDE))).astype(np.float32).round(1)
    made[3:9, 5:60] = np.nan
    return made


@pytest.fixture(scope="module")
def upload(
    request: pytest.FixtureRequest,
    heights: np.ndarray[tuple[int, int], np.dtype[np.float32]],
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[str, bytes, bytes]:
    """Name and bytes of a file, of which one is mapped and the other is put into files first; and its container."""
    if request.param == "tif":
        pytest.importorskip("rasterio")
    path = tmp_path_factory.mktemp("upload") / f"a.{request.param}"
    ls.write(ls.Surface(heights), path)
    return path.name, path.read_bytes(), ls.encode(ls.read(path))


def _post(http: httpx.Client, name: str, data: bytes) -> str:
    answer = http.post("/v1/surfaces", content=data, params={"filename": name, "name": "a"})
    return str(answer.raise_for_status().headers["location"])


def _container(http: httpx.Client, location: str) -> bytes:
    surface = settled(http, location)
    assert surface["state"] == "ready", surface
    return http.get(f"/v1/containers/{surface['container_sha256']}.lode").raise_for_status().content


def _made(folder: Path) -> Inodes:
    """The finished files of builds by bands below a folder, by their name there."""
    found: Inodes = {}
    for above, _, names in os.walk(folder):  # which passes over folders that vanish meanwhile
        for path in (Path(above) / name for name in names if "/exact/" in f"{above}/" and name.endswith(".npy")):
            with suppress(FileNotFoundError):
                found["exact/" + str(path).partition("/exact/")[2]] = path.stat().st_ino
    return {name: number for name, number in found.items() if "/prepared/" not in name and "/surface/" not in name}


def _is_measured(data: Path) -> Callable[[], object]:
    return lambda: "exact/counts/0/0.npy" in _made(data / "scratch" / "work")


def _begin(data: Path, name: str, content: bytes) -> tuple[Server, str]:
    """A server whose build waits in the middle of measuring."""
    running = Server(data, preload="preload_waiting", build_memory=MEMORY)
    with running.client() as http:
        location = _post(http, name, content)
        eventually(_is_measured(data), "measured rows")
    return running, location


def _end(data: Path, location: str, container: bytes, memory: int = MEMORY) -> str:
    """What the next server writes to its log until it has built this container."""
    with server(data, preload="preload_large", build_memory=memory) as second, second.client() as http:
        assert _container(http, location) == container
        return second.log.read_text()


@needs_landlock  # what is not confined does not continue
@pytest.mark.parametrize(("upload", "end"), [("npy", Server.kill), ("tif", Server.stop)], indirect=["upload"])
def test_a_build_continues_after_its_server_has_ended(
    tmp_path: Path, upload: tuple[str, bytes, bytes], end: Callable[[Server], object]
) -> None:
    name, content, container = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    end(first)
    with server(data, preload="preload_continuing", build_memory=MEMORY) as second, second.client() as http:
        assert _container(http, location) == container
        # A surface is ready a moment before the folder of its build is gone.
        eventually(lambda: not kept(data, "scratch/work"), "the build's folder to be removed")
        assert "continues from what an interrupted attempt had made" in second.log.read_text()


@pytest.mark.parametrize("upload", ["npy"], indirect=True)
@pytest.mark.long
def test_what_is_kept_of_a_surface_that_waits_for_no_build_is_removed(
    tmp_path: Path, upload: tuple[str, bytes, bytes]
) -> None:
    name, content, _ = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    first.stop()
    surface = location.rpartition("/")[2]
    work = data / "scratch" / "work"
    assert [path.relative_to(work).as_posix() for path in work.glob("*/*")] == [f"{surface}/bands"]
    for other in ("0123456789abcdef0123", "other"):
        (work / other / "bands" / "deep").mkdir(parents=True)
    with server(data, preload="preload_waiting", build_memory=MEMORY) as second, second.client() as http:
        assert kept(data, "scratch/work") == [surface]
        http.delete(location).raise_for_status()
        eventually(lambda: not kept(data, "scratch/work"), "an empty folder")


@pytest.mark.parametrize("upload", ["npy"], indirect=True)
@pytest.mark.long
def test_a_build_with_other_memory_begins_anew(tmp_path: Path, upload: tuple[str, bytes, bytes]) -> None:
    name, content, container = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    first.kill()
    _end(data, location, container, MEMORY + (16 << 20))


@needs_landlock
@pytest.mark.parametrize("upload", ["npy"], indirect=True)
@pytest.mark.long
def test_a_process_of_the_server_before_is_waited_for(tmp_path: Path, upload: tuple[str, bytes, bytes]) -> None:
    name, content, container = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    first.stop()
    (mark,) = (data / "scratch" / "work").glob("*/bands/*/lock")
    left = _made(data)
    with mark.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with server(data, preload="preload_large", build_memory=MEMORY) as second, second.client() as http:
            eventually(lambda: "waits for the server's system" in second.log.read_text(), "a build that waits")
            assert http.get(location).json()["state"] in ("queued", "building")
            assert _made(data / "scratch" / "work") == left, "what was made, still there"
            held.close()
            assert _container(http, location) == container


@pytest.mark.parametrize("upload", ["npy"], indirect=True)
@pytest.mark.long
def test_damaged_files_are_made_again(tmp_path: Path, upload: tuple[str, bytes, bytes]) -> None:
    name, content, container = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    first.kill()
    for number, path in enumerate(sorted((data / "scratch" / "work").glob("*/bands/*/exact/**/*.npy"))):
        if number % 5 == 0:
            os.truncate(path, path.stat().st_size // 2)
    assert "starts again from the beginning" not in _end(data, location, container)


@needs_landlock
@pytest.mark.parametrize("upload", ["npy"], indirect=True)
@pytest.mark.long
def test_a_build_that_fails_since_it_was_continued_is_tried_from_its_upload(
    tmp_path: Path, upload: tuple[str, bytes, bytes]
) -> None:
    name, content, container = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    first.kill()
    (exact,) = (data / "scratch" / "work").glob("*/bands/*/exact")
    shutil.rmtree(exact)
    exact.touch()
    text = _end(data, location, container)
    assert text.count("continues from what an interrupted attempt had made") == 1
    assert text.count("starts again from the beginning; continuing it failed: the build failed with an internal") == 1


def test_another_attempt_goes_on_in_the_same_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    heights = np.rint(100 * terrain((300, 310))).astype(np.int16)
    np.save(tmp_path / "0", heights)
    monkeypatch.setattr(worker, "memory_limit", lambda: 2 << 20)

    def job(name: str) -> worker.Job:
        for folder in (tmp_path / "bands", tmp_path / name):
            folder.mkdir(exist_ok=True)
        files = (tmp_path / "0.npy",)
        return worker.Job(files, "a.npy", None, "auto", {}, 1 << 20, tmp_path / name, tmp_path / "bands")

    first = job("first")
    with monkeypatch.context() as patched:
        patched.setattr(tasks, "measure", None)
        with pytest.raises(TypeError):
            worker.build(first)
    assert list((tmp_path / "bands").glob("*/exact/coefficients"))
    for name in ("coordinates", "first_step", "second_step", "core", "code"):
        monkeypatch.setattr(tasks, name, None)
    second = job("second")
    assert isinstance(worker.build(second), worker.Built)
    assert np.array_equal(ls.decode(second.container.read_bytes()).points, heights)
    assert list((tmp_path / "bands").iterdir()) == []


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "scratch" / "work"


def test_what_an_attempt_has_made_is_there_for_the_next(folder: Path) -> None:
    work = Work(folder)
    folder.parent.mkdir()
    first, bands = work.new_attempt("ab"), work.bands("ab")
    assert not work.begin("ab", first, may_continue=True)
    (bands / "some").touch()
    work.forget("ab")
    assert first.is_dir(), "an attempt goes on"
    work.end("ab", first, keep=True)
    second = Work(folder).new_attempt("ab")
    assert second != first
    assert Work(folder).begin("ab", second, may_continue=True)
    assert [path.name for path in bands.iterdir()] == ["some"]
    assert list(second.iterdir()) == []
    work.end("ab", second)
    assert list(folder.iterdir()) == []


def test_the_end_of_an_attempt_leaves_another_one_of_the_same_surface(folder: Path) -> None:
    """One that was deleted and came again at once."""
    work = Work(folder)
    folder.parent.mkdir()
    first, second = work.new_attempt("ab"), work.new_attempt("ab")
    work.begin("ab", first, may_continue=True)
    work.begin("ab", second, may_continue=True)
    (work.bands("ab") / "some").touch()
    work.end("ab", first)
    assert second.is_dir()
    assert (work.bands("ab") / "some").exists()
    work.end("ab", second)
    assert list(folder.iterdir()) == []


def test_where_a_build_may_not_continue_what_was_kept_is_removed(folder: Path) -> None:
    work = Work(folder)
    folder.parent.mkdir()
    attempt = work.new_attempt("ab")
    work.begin("ab", attempt, may_continue=True)
    (work.bands("ab") / "some").touch()
    work.end("ab", attempt, keep=True)
    assert not work.begin("ab", attempt, may_continue=False)
    assert list(work.bands("ab").iterdir()) == []


def test_a_start_keeps_only_what_queued_builds_continue_from(folder: Path, tmp_path: Path) -> None:
    outside = tmp_path / "outside"
    (outside / "bands").mkdir(parents=True)
    (outside / "bands" / "precious").touch()
    folder.parent.mkdir()
    work = Work(folder)
    work.clean({"queued"})
    for surface in ("queued", "ready"):
        work.begin(surface, work.new_attempt(surface), may_continue=True)
        (work.bands(surface) / "some").symlink_to(outside)
    (folder / "link").symlink_to(outside)
    (folder / "file").touch()
    work.clean({"queued", "link", "file"})
    assert [path.relative_to(folder).as_posix() for path in folder.glob("*/*")] == ["queued/bands"]
    assert (work.bands("queued") / "some").is_symlink()
    assert (outside / "bands" / "precious").exists()
    work.forget("queued")
    assert list(folder.iterdir()) == []
    assert (outside / "bands" / "precious").exists()


@pytest.mark.parametrize("upload", ["npy"], indirect=True)
@pytest.mark.long
def test_nothing_is_kept_for_a_surface_whose_upload_is_damaged(
    tmp_path: Path, upload: tuple[str, bytes, bytes]
) -> None:
    name, content, _ = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    first.stop()
    (file,) = (data / "uploads").glob("*/0")
    with file.open("r+b") as damaged:
        damaged.write(b"\0")
    with server(data, preload="preload_large", build_memory=MEMORY) as second, second.client() as http:
        assert settled(http, location)["state"] == "waiting"
        eventually(lambda: not kept(data, "scratch/work"), "an empty folder")
