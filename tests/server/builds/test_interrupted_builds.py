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
from lodestream.scratch import boot_id
from lodestream_server.storage import interrupted
from lodestream_server.storage.folders import Folders
from lodestream_server.storage.storage import Storage
from tests.core.surfaces import terrain
from tests.server.builds.test_confinement import needs_landlock
from tests.server.helpers import eventually, settled
from tests.server.programs import Server, server

#: Of a build: nothing fits into half of it in one piece that has so many points with holes.
MEMORY, SIDE = 256 << 20, 2280

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
    with server(path.parent / "data", build_memory=MEMORY) as whole, whole.client() as http:
        return path.name, path.read_bytes(), _container(http, _post(http, path.name, path.read_bytes()))


def _post(http: httpx.Client, name: str, data: bytes) -> str:
    answer = http.post("/v1/surfaces", content=data, params={"filename": name, "name": "a"})
    return str(answer.raise_for_status().headers["location"])


def _container(http: httpx.Client, location: str) -> bytes:
    surface = settled(http, location)
    assert surface["state"] == "ready", surface
    return http.get(f"/v1/containers/{surface['container']}.lode").raise_for_status().content


def _made(folder: Path) -> Inodes:
    """The finished files of builds by bands below a folder, by their name there."""
    found: Inodes = {}
    for above, _, names in os.walk(folder):  # which passes over folders that vanish meanwhile
        for path in (Path(above) / name for name in names if "/tasks/" in f"{above}/" and name.endswith(".npy")):
            with suppress(FileNotFoundError):
                found[str(path).partition("/tasks/")[2]] = path.stat().st_ino
    return {name: number for name, number in found.items() if "/prepared/" not in name and "/surface/" not in name}


def _is_measured(data: Path) -> Callable[[], object]:
    return lambda: any("/exact/" in f"/{name}" for name in _made(data / "work"))


def _begin(data: Path, name: str, content: bytes) -> tuple[Server, str]:
    """A server in the middle of measuring."""
    running = Server(data, build_memory=MEMORY)
    with running.client() as http:
        location = _post(http, name, content)
        eventually(_is_measured(data), "measured rows")
    return running, location


def _end(data: Path, location: str, container: bytes, memory: int = MEMORY) -> str:
    """What the next server writes to its log until it has built this container."""
    with server(data, build_memory=memory) as second, second.client() as http:
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
    left = _made(data)
    measured = {name: number for name, number in left.items() if "/exact/" in f"/{name}"}
    assert measured
    with server(data, build_memory=MEMORY) as second, second.client() as http:
        # Files of tasks that are done are those of before, as long as they are there.
        again: Inodes = {}

        def some_more() -> object:
            again.update(_made(data / "work"))
            return set(again) - set(left) or http.get(location).json()["state"] == "ready"

        eventually(some_more, "more files")
        assert {name: again[name] for name in measured} == measured
        assert _container(http, location) == container
        assert not (data / "interrupted").exists() or not list((data / "interrupted").iterdir())
        assert list((data / "work").iterdir()) == []
        assert "continues from what an interrupted attempt had made" in second.log.read_text()


@pytest.mark.parametrize("upload", ["npy"], indirect=True)
def test_what_is_kept_of_a_surface_that_waits_for_no_build_is_removed(
    tmp_path: Path, upload: tuple[str, bytes, bytes]
) -> None:
    name, content, _ = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    first.stop()
    surface = location.rpartition("/")[2]
    assert [path.name for path in (data / "interrupted").iterdir()] == [f"{surface}.{boot_id()}"]
    for kept in ("0123456789abcdef0123", "other"):
        (data / "interrupted" / kept / "deep").mkdir(parents=True)
    with server(data, build_memory=MEMORY) as second, second.client() as http:
        eventually(lambda: not list((data / "interrupted").iterdir()), "an empty folder")
        http.delete(location).raise_for_status()
        assert list((data / "work").iterdir()) == []
        assert list((data / "interrupted").iterdir()) == []


@pytest.mark.parametrize("upload", ["npy"], indirect=True)
def test_a_build_with_other_memory_begins_anew(tmp_path: Path, upload: tuple[str, bytes, bytes]) -> None:
    name, content, container = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    first.kill()
    _end(data, location, container, MEMORY + (40 << 20))


@needs_landlock
@pytest.mark.parametrize("upload", ["npy"], indirect=True)
def test_a_process_of_the_server_before_is_waited_for(tmp_path: Path, upload: tuple[str, bytes, bytes]) -> None:
    name, content, container = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    first.stop()
    (mark,) = (data / "interrupted").glob("*/.lodestream-build")
    left = _made(data)
    with mark.open() as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with server(data, build_memory=MEMORY) as second, second.client() as http:
            eventually(lambda: "waits for the server's system" in second.log.read_text(), "a build that waits")
            assert http.get(location).json()["state"] in ("queued", "building")
            eventually(
                lambda: left in (_made(data / "interrupted"), _made(data / "work")), "what was made, still there"
            )
            held.close()
            assert _container(http, location) == container


@pytest.mark.parametrize("upload", ["npy"], indirect=True)
def test_damaged_files_are_made_again(tmp_path: Path, upload: tuple[str, bytes, bytes]) -> None:
    name, content, container = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    first.kill()
    for number, path in enumerate(sorted((data / "work").glob(f"**/{interrupted.BANDS}/tasks/**/*.npy"))):
        if number % 5 == 0:
            os.truncate(path, path.stat().st_size // 2)
    _end(data, location, container)


@needs_landlock
@pytest.mark.parametrize("upload", ["npy"], indirect=True)
def test_a_build_that_fails_since_it_was_continued_is_tried_from_its_upload(
    tmp_path: Path, upload: tuple[str, bytes, bytes]
) -> None:
    name, content, container = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    first.kill()
    (exact,) = (data / "work").glob("**/exact")
    shutil.rmtree(exact)
    exact.touch()
    text = _end(data, location, container)
    assert text.count("continues from what an interrupted attempt had made") == 1
    assert text.count("begins anew, since continued it ended so: the build failed with an internal error") == 1


@pytest.mark.parametrize("upload", ["npy"], indirect=True)
@pytest.mark.parametrize("end", [Server.kill, Server.stop])
def test_after_a_restart_of_the_machine_the_build_begins_anew(
    tmp_path: Path, upload: tuple[str, bytes, bytes], end: Callable[[Server], object]
) -> None:
    name, content, container = upload
    data = tmp_path / "data"
    first, location = _begin(data, name, content)
    end(first)
    (left,) = [*(data / "work").iterdir(), *(data / "interrupted").glob("*")]
    left.rename(left.with_suffix(f".{(boot_id() or '')[::-1]}"))
    assert "continues" not in _end(data, location, container)
    assert not (data / "interrupted").exists() or not list((data / "interrupted").iterdir())


def test_where_a_build_may_not_continue_what_was_kept_is_removed(tmp_path: Path) -> None:
    at = Folders(tmp_path)
    storage = Storage(tmp_path)
    try:
        work = _work(at)
        (work / interrupted.SCRATCH / interrupted.BANDS).mkdir()
        interrupted.keep(at, "ab", work)
        assert not storage.new_work("ab", at.work / "ab.1", may_continue=False)
        assert list((at.work / "ab.1").iterdir()) == []
        assert list(at.interrupted.iterdir()) == []
    finally:
        storage.close()


def _work(at: Folders) -> Path:
    work = at.work / interrupted.work_name("ab", "0")
    (work / interrupted.SCRATCH).mkdir(parents=True)
    return work


@pytest.mark.parametrize("hostile", ["nothing", "scratch is a link", "bands is a link", "bands is a file", "a pipe"])
def test_no_link_is_followed_to_what_is_kept(tmp_path: Path, hostile: str) -> None:
    at, outside = Folders(tmp_path / "data"), tmp_path / "outside"
    work, bands = _work(at), tmp_path / "outside" / interrupted.BANDS
    bands.mkdir(parents=True)
    (bands / "precious").touch()
    inside = work / interrupted.SCRATCH / interrupted.BANDS
    if hostile == "scratch is a link":
        shutil.rmtree(work / interrupted.SCRATCH)
        (work / interrupted.SCRATCH).symlink_to(outside)
    elif hostile == "bands is a link":
        inside.symlink_to(bands)
    elif hostile == "bands is a file":
        inside.touch()
    elif hostile == "a pipe":
        os.mkfifo(inside)
    interrupted.keep(at, "ab", work)
    assert (bands / "precious").exists()
    assert not at.interrupted.exists() or not list(at.interrupted.iterdir())
    interrupted.forget(at, "ab")
    assert not interrupted.put_back(at, "ab", at.work / "ab.1")


def test_what_is_kept_is_put_back_once(tmp_path: Path) -> None:
    at = Folders(tmp_path)
    for said in ("before", "after"):
        work = _work(at)
        (work / interrupted.SCRATCH / interrupted.BANDS).mkdir()
        (work / interrupted.SCRATCH / interrupted.BANDS / said).touch()
        interrupted.keep(at, "ab", work)
        shutil.rmtree(work)
    work = at.work / "ab.1"
    work.mkdir()
    assert interrupted.put_back(at, "ab", work)
    assert [path.name for path in (work / interrupted.SCRATCH / interrupted.BANDS).iterdir()] == ["after"]
    shutil.rmtree(work / interrupted.SCRATCH)
    assert not interrupted.put_back(at, "ab", work)
    assert list(work.iterdir()) == []


def test_where_it_cannot_be_put_back_the_build_begins_anew(tmp_path: Path) -> None:
    at = Folders(tmp_path)
    work = _work(at)
    (work / interrupted.SCRATCH / interrupted.BANDS).mkdir()
    interrupted.keep(at, "ab", work)
    (work / interrupted.SCRATCH / interrupted.BANDS / "in the way").mkdir(parents=True)
    assert not interrupted.put_back(at, "ab", work)
    assert list(at.interrupted.iterdir()) == []


@pytest.mark.parametrize("upload", ["npy"], indirect=True)
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
    with server(data, build_memory=MEMORY) as second, second.client() as http:
        assert settled(http, location)["state"] == "waiting"
        eventually(lambda: not list((data / "interrupted").iterdir()), "an empty folder")
