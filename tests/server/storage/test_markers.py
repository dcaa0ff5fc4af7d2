"""Folders that are not mounted, or moved: a server does not start on them, and nothing is removed."""

from __future__ import annotations

import argparse
import errno
import itertools
import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import httpx
import pytest

from lodestream.errors import LodestreamError
from lodestream_server import running_server
from lodestream_server.commands.fsck import register
from lodestream_server.storage.folders import Folders
from lodestream_server.storage.markers import MARKER, adopt
from lodestream_server.storage.storage import Storage
from lodestream_server.store.durable import Disk, write_file
from tests.patience import PATIENCE
from tests.server.helpers import hills, npy, push, settled, upload_of

FOLDERS = ("records", "uploads", "containers")


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file() and path.name != "lock"
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """A folder with a surface that is ready and one that failed."""
    data = tmp_path_factory.mktemp("markers") / "data"
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        return data, [push(http, npy(hills(seed=1)), name="one"), push(http, npy(hills(seed=2))[:-1])]


@pytest.fixture
def data(made: tuple[Path, list[dict[str, Any]]], tmp_path: Path) -> Path:
    return shutil.copytree(made[0], tmp_path / "data")


@pytest.fixture
def surfaces(made: tuple[Path, list[dict[str, Any]]]) -> list[dict[str, Any]]:
    return made[1]


def unmark(data: Path) -> None:
    """Make it a folder of the versions before markers."""
    for name in FOLDERS:
        (data / name / MARKER).unlink()


def as_of_before(data: Path) -> None:
    """The same with the uploads as these versions laid them."""
    unmark(data)
    for path in (data / "records").glob("*.json"):
        record = json.loads(path.read_bytes())
        folder = data / "uploads" / record.pop("upload")
        copy = json.loads((folder / path.name).read_bytes())
        copy.pop("upload")
        (folder / path.name).unlink()
        (folder / "record.json").write_text(json.dumps(copy))
        folder.rename(data / "uploads" / record["id"])
        path.write_text(json.dumps(record))


def served(data: Path) -> list[dict[str, Any]]:
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        found = http.get("/v1/surfaces").json()["surfaces"]
        return [http.get(entry["url"]).json() for entry in found]


@pytest.mark.parametrize("unmarked", [False, True])
@pytest.mark.parametrize("left", ["nothing", "an empty folder"])
@pytest.mark.parametrize("away", [("records",), ("uploads",), ("containers",), ("uploads", "containers")])
def test_a_start_without_a_folder_removes_nothing(
    data: Path, tmp_path: Path, surfaces: list[dict[str, Any]], away: tuple[str, ...], left: str, unmarked: bool
) -> None:
    if unmarked:
        unmark(data)
    before = contents(data)
    for name in away:
        (data / name).rename(tmp_path / name)
        if left == "an empty folder":
            (data / name).mkdir()
    there = contents(data)
    for _ in range(2):
        with pytest.raises(LodestreamError, match=r"expected .* Nothing was changed.*fsck --adopt") as refusal:
            Storage(data)
        assert any(f"{name}/" in str(refusal.value) for name in away)
        assert contents(data) == there
    for name in away:
        if (data / name).exists():
            (data / name).rmdir()
        (tmp_path / name).rename(data / name)
    assert contents(data) == before
    assert served(data) == surfaces


def test_the_folder_of_another_server_is_refused(data: Path, tmp_path: Path, surfaces: list[dict[str, Any]]) -> None:
    Storage(tmp_path / "other").close()
    (data / "uploads").rename(tmp_path / "uploads")
    (tmp_path / "other" / "uploads").rename(data / "uploads")
    before = contents(data)
    with pytest.raises(LodestreamError, match="expected the same marker in each folder"):
        Storage(data)
    assert contents(data) == before
    (data / "uploads").rename(tmp_path / "other" / "uploads")
    (tmp_path / "uploads").rename(data / "uploads")
    assert served(data) == surfaces


@pytest.mark.parametrize("change", [unmark, as_of_before])
def test_a_folder_without_markers_is_marked(
    data: Path, surfaces: list[dict[str, Any]], change: Callable[[Path], None]
) -> None:
    change(data)
    assert served(data) == surfaces
    assert len({(data / name / MARKER).read_text() for name in FOLDERS}) == 1
    assert not (data / "damaged").exists()
    assert served(data) == surfaces


def test_a_folder_of_before_is_deleted_from_and_shared(data: Path, surfaces: list[dict[str, Any]]) -> None:
    as_of_before(data)
    one = surfaces[0]
    folder = data / "uploads" / one["id"]
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        two = push(http, npy(hills(seed=1)), name="two")
        assert upload_of(data, two) == folder
        assert http.delete(one["url"]).status_code == 204
        assert http.get(two["url"]).json() == two
    assert one["id"] not in [surface["id"] for surface in served(data)]
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        assert http.delete(two["url"]).status_code == 204
    assert not folder.exists()


def test_marking_that_was_cut_short_is_finished(
    data: Path, surfaces: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    unmark(data)
    written: list[Path] = []

    def cut(path: Path, content: bytes) -> None:
        if len(written) == 2:
            raise OSError("the machine stops here")
        written.append(path)
        write_file(path, content)

    monkeypatch.setattr("lodestream_server.storage.markers.write_file", cut)
    with pytest.raises(OSError, match="stops here"):
        Storage(data)
    monkeypatch.undo()
    assert served(data) == surfaces
    assert not (data / "marking").exists()


def cut_short(data: Path, after: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Adopt the folders, and let the file after so many others not be written."""
    written: list[Path] = []

    def cut(path: Path, content: bytes) -> None:
        if len(written) == after:
            raise OSError("the machine stops here")
        written.append(path)
        write_file(path, content)

    with monkeypatch.context() as patch:
        patch.setattr("lodestream_server.storage.markers.write_file", cut)
        with pytest.raises(OSError, match="stops here"):
            adopt(Folders(data))


@pytest.mark.parametrize("after", range(4))
@pytest.mark.parametrize("markers", ["of one server", "none", "no markers"])
def test_adopting_that_was_cut_short_is_finished(
    data: Path, surfaces: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch, after: int, markers: str
) -> None:
    if markers == "none":
        unmark(data)
    elif markers == "no markers":
        for name in FOLDERS:
            (data / name / MARKER).write_bytes(b"\xff\x00")
    cut_short(data, after, monkeypatch)
    if markers == "no markers" and after == 0:  # nothing was begun
        with pytest.raises(LodestreamError, match="expected 32 hexadecimal digits"):
            Storage(data)
        return
    assert served(data) == surfaces
    assert len({(data / name / MARKER).read_text() for name in FOLDERS}) == 1
    assert not (data / "marking").exists()


class Stale(Disk):
    """A disk on which one step goes wrong."""

    def __init__(self, step: int) -> None:
        self.left = step

    def _ask(self) -> None:
        self.left -= 1
        if self.left == -1:
            raise OSError(errno.ESTALE, "Stale file handle")

    def create(self, path: Path) -> BinaryIO:
        self._ask()
        return super().create(path)

    def write(self, file: BinaryIO, data: bytes) -> None:
        self._ask()
        super().write(file, data)

    def sync(self, handle: int, path: Path) -> None:
        self._ask()
        super().sync(handle, path)

    def rename(self, source: Path, target: Path) -> None:
        self._ask()
        super().rename(source, target)

    def unlink(self, path: Path) -> None:
        self._ask()
        super().unlink(path)


def test_a_server_starts_after_adopting_that_an_error_has_ended_anywhere(
    data: Path, surfaces: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    for step in itertools.count():
        with monkeypatch.context() as patch:
            disk = Stale(step)
            patch.setattr("lodestream_server.store.durable.disk", disk)
            with suppress(OSError):
                adopt(Folders(data))
        storage = Storage(data)
        assert {record.id for record in storage.records()} == {surface["id"] for surface in surfaces}
        storage.close()
        if disk.left >= 0:
            break
    assert step > 15
    assert served(data) == surfaces


def test_adopting_without_records_that_was_cut_short_is_finished(
    data: Path, surfaces: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.rmtree(data / "records")
    cut_short(data, 1, monkeypatch)
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        for surface in surfaces:
            assert settled(http, surface["url"]) == surface


@pytest.mark.parametrize("instead", ["nothing", "an empty folder", "another server's"])
def test_adopting_is_not_finished_with_other_folders(
    data: Path, surfaces: list[dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, instead: str
) -> None:
    cut_short(data, 2, monkeypatch)
    Storage(tmp_path / "other").close()
    for name in ("uploads", "records"):  # without its new marker, and with it
        (data / name).rename(tmp_path / name)
        if instead == "an empty folder":
            (data / name).mkdir()
        elif instead == "another server's":
            (tmp_path / "other" / name).rename(data / name)
        there = contents(data)
        with pytest.raises(LodestreamError, match=rf"expected the {name}/ of .* Nothing was changed"):
            Storage(data)
        assert contents(data) == there
        if (data / name).exists():
            shutil.rmtree(data / name)
        (tmp_path / name).rename(data / name)
    assert served(data) == surfaces


def test_a_note_of_adopting_that_cannot_be_read_is_replaced_by_adopting_again(
    data: Path, surfaces: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    cut_short(data, 2, monkeypatch)
    (data / "marking").write_bytes(b"records none\n")
    with pytest.raises(LodestreamError, match="expected the number of a marker, and of those before"):
        Storage(data)
    adopt(Folders(data))
    assert served(data) == surfaces


def test_adopting_what_was_moved(
    data: Path, tmp_path: Path, surfaces: list[dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    # The records are lost for good, and the markers are those of two folders.
    shutil.rmtree(data / "records")
    Storage(tmp_path / "other").close()
    shutil.copy(tmp_path / "other" / "containers" / MARKER, data / "containers" / MARKER)
    parser = argparse.ArgumentParser()
    register(parser.add_subparsers())
    args = parser.parse_args(["fsck", str(data)])
    assert args.run(args) == 1
    assert "expected the same marker" in capsys.readouterr().out
    args = parser.parse_args(["fsck", str(data), "--repair"])
    with pytest.raises(LodestreamError, match="--adopt"):
        args.run(args)
    args = parser.parse_args(["fsck", str(data), "--adopt", "--json"])
    assert args.run(args) == 0
    found = {surface["id"]: surface for surface in served(data)}
    for surface in surfaces:
        # Built again from the upload, under its name, with its owner; it is as old as it was.
        assert found[surface["id"]] == surface


def test_a_server_says_in_one_line_why_it_does_not_start(data: Path, tmp_path: Path) -> None:
    (data / "uploads").rename(tmp_path / "uploads")
    command = [sys.executable, "-m", "lodestream_client", "serve", "--data", str(data), "--port", "0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("lodestream: expected the marker of this data folder in uploads/")
