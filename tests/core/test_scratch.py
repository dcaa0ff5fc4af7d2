"""The files of a build."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from lodestream.scratch import FolderScratch, MemoryScratch, Scratch


@pytest.fixture(params=["memory", "folder"])
def scratch(request: pytest.FixtureRequest, tmp_path: Path) -> Scratch:
    return MemoryScratch() if request.param == "memory" else FolderScratch(tmp_path / "new" / "folder")


def test_arrays_come_back_as_they_were_written(scratch: Scratch) -> None:
    with pytest.raises(FileNotFoundError):
        scratch.read("a/b")
    for array in (np.arange(12, dtype=np.int16).reshape(3, 4), np.zeros((0, 3)), np.array(5.5), np.ones((2, 3)).T):
        scratch.write("a/b", array)
        read = scratch.read("a/b")
        assert read.dtype == array.dtype
        assert np.array_equal(read, array)
        assert not read.flags.writeable or not read.size


def test_a_file_is_there_when_it_is_whole(tmp_path: Path) -> None:
    scratch = FolderScratch(tmp_path)

    def cut() -> None:
        with scratch.writing("half") as path:
            path.write_bytes(b"something")
            assert not scratch.has("half")
            raise KeyError

    with pytest.raises(KeyError):
        cut()
    assert not scratch.has("half")
    assert not list(tmp_path.iterdir())
    with pytest.raises(FileNotFoundError):
        scratch.read("half")


def test_what_is_removed_is_gone_and_nothing_else(scratch: Scratch) -> None:
    for name in ("x/1", "x/2/3", "xy/1", "y", "z"):
        scratch.write(name, np.ones(3))
    scratch.remove("y")
    scratch.remove("x")
    scratch.remove("nothing")
    assert scratch.those_of(["x/1", "x/2/3", "xy/1", "y", "z"]) == {"xy/1", "z"}


def test_a_folder_that_is_cleared_is_gone(tmp_path: Path) -> None:
    scratch = FolderScratch(tmp_path / "folder")
    scratch.write("x", np.ones(3))
    scratch.remove("x")
    assert scratch.size() == 0
    scratch.clear()
    assert not scratch.folder.exists()


def test_a_part_of_an_array_is_kept_without_the_rest(scratch: Scratch) -> None:
    whole = np.arange(12).reshape(3, 4)
    scratch.write("part", whole[:2, 1:3])
    whole[...] = 0
    assert scratch.read("part").tolist() == [[1, 2], [5, 6]]
    assert scratch.read("part").nbytes == 32


def test_what_a_task_puts_aside_is_gone_after_it(tmp_path: Path) -> None:
    scratch = FolderScratch(tmp_path)
    with scratch.temporary(100) as room:
        assert not isinstance(room.empty((3,), np.uint8), np.memmap)
        assert not list(tmp_path.iterdir())
        large = room.empty((1000,), np.uint8)
        large[...] = 5
        assert isinstance(large, np.memmap)
        assert scratch.size() > 1000
    assert not list(tmp_path.iterdir())
    with MemoryScratch().temporary(100) as room:
        assert not isinstance(room.empty((1000,), np.uint8), np.memmap)


def test_room_is_a_file_of_zeros(tmp_path: Path) -> None:
    scratch = FolderScratch(tmp_path)
    room = scratch.empty("room", (4, 5), np.uint8)
    assert not room.any()
    assert scratch.size() > 20
    room[...] = 7
    assert (scratch.read("room") == 7).all()
    assert not scratch.empty("room", (4, 5), np.uint8).any()
    assert (room == 7).all()
    assert scratch.empty("nothing", (0, 5), np.uint8).shape == (0, 5)


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="the system cannot take room")
def test_a_full_disk_is_told_when_an_array_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: int) -> None:
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(OSError, match="No space left") as caught:
        FolderScratch(tmp_path).empty("a", (100, 100), np.float64)
    assert caught.value.errno == errno.ENOSPC
    assert not list(tmp_path.iterdir())

    def unknown(*arguments: int) -> None:
        raise OSError(errno.EINVAL, "not of this file system")

    monkeypatch.setattr(os, "posix_fallocate", unknown)
    assert FolderScratch(tmp_path).empty("a", (100, 100), np.float64).shape == (100, 100)
    monkeypatch.undo()
    array = FolderScratch(tmp_path).empty("b", (1000, 1000), np.float64)
    assert not array.any()
    assert (tmp_path / "b.npy").stat().st_blocks * 512 >= array.nbytes


def test_a_folder_that_was_removed_is_not_made_again(tmp_path: Path) -> None:
    # By a task of a build that was given up meanwhile.
    scratch = FolderScratch(tmp_path / "build")
    scratch.write("a/1", np.ones(3))

    def cut() -> None:
        with scratch.writing("a/b/2") as path:
            path.write_bytes(b"half")
            scratch.clear()

    with pytest.raises(FileNotFoundError):
        cut()
    for name in ("a/3", "4"):
        with pytest.raises(FileNotFoundError):
            scratch.write(name, np.ones(3))
        with pytest.raises(FileNotFoundError):
            scratch.empty(name, (3,), np.uint8)
    assert not (tmp_path / "build").exists()


def test_names_that_are_there_are_told(scratch: Scratch) -> None:
    scratch.write("x/1/2", np.ones(3))
    scratch.write("y", np.ones(3))
    assert scratch.those_of(["x/1/2", "x/1/3", "x/2/2", "y", "z/1", "x"]) == {"x/1/2", "y"}


@pytest.mark.parametrize("length", [0, 5, 100, 130])
def test_a_file_that_is_cut_short_is_told(tmp_path: Path, length: int) -> None:
    scratch = FolderScratch(tmp_path)
    scratch.write("y", np.ones(30))
    os.truncate(tmp_path / "y.npy", length)
    with pytest.raises(ValueError, match=r"y\.npy"):
        scratch.read("y")


def test_objects_of_python_are_not_read(tmp_path: Path) -> None:
    header = b"{'descr': '|O', 'fortran_order': False, 'shape': (4, 4), }".ljust(117) + b"\n"
    (tmp_path / "y.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + b"A" * 128)
    with pytest.raises(ValueError, match="objects of Python"):
        FolderScratch(tmp_path).read("y")


def test_files_that_vanish_meanwhile_have_no_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scratch = FolderScratch(tmp_path)
    scratch.write("x/1", np.ones(3))
    size = scratch.size()
    walk = os.walk
    monkeypatch.setattr(os, "walk", lambda folder: [*walk(folder), (str(tmp_path / "x"), [], ["2.npy"])])
    assert scratch.size() == size > 24
