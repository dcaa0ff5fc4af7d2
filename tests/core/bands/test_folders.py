"""Folders of builds: nobody else's files are removed, and one process at a time builds in one."""

from __future__ import annotations

import errno
import fcntl
import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

from lodestream.bands import folders
from lodestream.bands.folders import build_folder, passing_folder, remove, replacing
from lodestream.errors import InputError
from lodestream.scratch import FolderScratch

ENTRIES = ("tasks",)


def fill(folder: Path) -> None:
    (folder / "tasks").mkdir(exist_ok=True)
    (folder / "tasks" / "x.npy").write_bytes(b"x")


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("named", [False, True])
def test_a_folder_that_was_made_is_gone_afterwards(tmp_path: Path, named: bool) -> None:
    with build_folder(tmp_path / "a.build", ENTRIES, named) as folder:
        fill(folder)
    assert not names(tmp_path)


def test_an_empty_folder_of_somebody_stays_and_is_empty(tmp_path: Path) -> None:
    for _ in range(2):
        with build_folder(tmp_path, ENTRIES, True) as folder:
            fill(folder)
        assert not names(tmp_path)


def test_what_others_put_there_meanwhile_stays(tmp_path: Path) -> None:
    with build_folder(tmp_path / "a", ENTRIES, True) as folder:
        fill(folder)
        (folder / "diary.txt").write_text("dear diary")
        (folder / "letters").mkdir()
    assert names(tmp_path / "a") == {"diary.txt", "letters"}
    with pytest.raises(InputError, match="got something else, which stays"), build_folder(folder, ENTRIES, True):
        pytest.fail("it is not ours")
    assert names(tmp_path / "a") == {"diary.txt", "letters"}


@pytest.mark.parametrize("named", [False, True])
def test_other_folders_and_files_are_refused(tmp_path: Path, named: bool) -> None:
    (tmp_path / "tasks").mkdir()
    (tmp_path / "file").write_text("dear diary")
    for other in (tmp_path, tmp_path / "file"):
        with pytest.raises(InputError, match="got something else"), build_folder(other, ENTRIES, named):
            pytest.fail("it is not ours")
    assert names(tmp_path) == {"tasks", "file"}


def _cut(folder: Path, named: bool) -> None:
    with build_folder(folder, ENTRIES, named):
        fill(folder)
        raise KeyboardInterrupt


def test_a_build_that_fails_keeps_a_named_folder_only(tmp_path: Path) -> None:
    for named in (False, True):
        with pytest.raises(KeyboardInterrupt):
            _cut(tmp_path / "a", named)
        assert (tmp_path / "a").exists() == named
    with build_folder(tmp_path / "a", ENTRIES, True) as folder:
        assert (folder / "tasks" / "x.npy").exists()
    assert not names(tmp_path)


def test_a_second_build_is_told_that_one_is_at_work(tmp_path: Path) -> None:
    with build_folder(tmp_path / "a", ENTRIES, False) as folder:
        fill(folder)
        for named in (False, True):
            who = rf"another one is at work there \(process {os.getpid()} on "
            with pytest.raises(InputError, match=who), build_folder(folder, ENTRIES, named):
                pytest.fail("two at once")
        assert (folder / "tasks" / "x.npy").exists()
    with build_folder(tmp_path / "a", ENTRIES, False):
        pass


def _die(folder: Path) -> None:
    with build_folder(folder, ENTRIES, False):
        fill(folder)
        os.kill(os.getpid(), signal.SIGKILL)


def test_what_a_killed_process_left_is_found_again_and_removed(tmp_path: Path) -> None:
    process = multiprocessing.get_context("spawn").Process(target=_die, args=(tmp_path / "a",))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    with build_folder(tmp_path / "a", ENTRIES, False) as folder:
        assert (folder / "tasks" / "x.npy").exists()
    assert not names(tmp_path)


def _fork_and_die(folder: Path, forked: Connection) -> None:
    with build_folder(folder, ENTRIES, True):
        fill(folder)
        begun, begins = os.pipe()
        if not os.fork():  # a worker, which stays when its parent is killed
            forked.send(os.getpid())
            os.write(begins, b"x")
            time.sleep(60)
            os._exit(0)
        os.read(begun, 1)
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked")
def test_a_worker_that_was_forked_does_not_keep_the_folder_of_a_killed_process(tmp_path: Path) -> None:
    receiver, sender = multiprocessing.Pipe(duplex=False)
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=_fork_and_die, args=(tmp_path / "a", sender))
    process.start()
    process.join()
    child = receiver.recv()
    try:
        os.kill(child, 0)  # it is there
        with build_folder(tmp_path / "a", ENTRIES, True) as folder:
            assert (folder / "tasks" / "x.npy").exists()
    finally:
        os.kill(child, signal.SIGKILL)
    assert not names(tmp_path)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked")
def test_a_fork_that_ends_removes_nothing(tmp_path: Path) -> None:
    def fork() -> int:
        with build_folder(tmp_path / "a", ENTRIES, True) as folder:
            fill(folder)
            child = os.fork()
            if child:
                os.waitpid(child, 0)
                assert (folder / "tasks" / "x.npy").exists()
                with pytest.raises(InputError, match="at work"), build_folder(folder, ENTRIES, True):
                    pytest.fail("two at once")
        return child

    if not fork():
        os._exit(0)
    assert not names(tmp_path)


def test_a_folder_of_another_user_is_not_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(KeyError), build_folder(tmp_path / "a", ENTRIES, True):
        raise KeyError
    user = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: user + 1)
    with pytest.raises(InputError, match="one of another"), build_folder(tmp_path / "a", ENTRIES, False):
        pytest.fail("whose is it")


def test_a_folder_that_goes_while_it_is_opened_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lock: Callable[[int, Path], None] = folders._lock
    calls: list[Path] = []

    def late(handle: int, folder: Path) -> None:
        if not calls:  # whoever had it ends just now
            (folder / folders._MARK).unlink()
            folder.rmdir()
        calls.append(folder)
        lock(handle, folder)

    monkeypatch.setattr(folders, "_lock", late)
    with build_folder(tmp_path / "a", ENTRIES, False) as folder:
        assert names(folder) == {folders._MARK}
    assert len(calls) == 2
    assert not names(tmp_path)


def test_file_systems_without_locks_will_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(*_: Any) -> None:
        raise OSError(next(iter(folders._NO_LOCKS)), "no locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    with build_folder(tmp_path / "a", ENTRIES, False) as folder:
        fill(folder)
    assert not names(tmp_path)


def test_a_late_task_leaves_nothing(tmp_path: Path) -> None:
    late = FolderScratch(tmp_path / "tasks")
    with late.writing("a/b") as path:
        path.write_bytes(b"x")
    remove(tmp_path / "tasks")
    assert not names(tmp_path)
    with pytest.raises(FileNotFoundError), late.writing("a/c") as path:
        path.write_bytes(b"x")
    assert not names(tmp_path)
    remove(tmp_path / "tasks")


def test_two_that_write_one_file_do_not_mix(tmp_path: Path) -> None:
    path = tmp_path / "a.lode"
    with replacing(path) as first, replacing(path) as second:
        assert first != second
        first.write_bytes(b"first")
        second.write_bytes(b"second")
    assert path.read_bytes() == b"first"
    assert names(tmp_path) == {"a.lode"}


def _passing(above: Path, ready: Connection) -> None:
    with passing_folder(above / "a.npy", ENTRIES) as folder:
        fill(folder)
        ready.send(folder.name)
        time.sleep(600)


@pytest.fixture
def left(tmp_path: Path) -> Path:
    """A folder on the way to a file, of a process that was killed."""
    ours, theirs = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_passing, args=(tmp_path, theirs))
    process.start()
    name = ours.recv()
    with passing_folder(tmp_path / "b.npy", ENTRIES) as own:
        assert names(tmp_path) == {name, own.name}, "somebody is at work there"
    assert names(tmp_path) == {name}
    process.kill()
    process.join()
    return tmp_path / str(name)


def test_what_a_killed_process_left_on_the_way_to_a_file_is_removed(left: Path) -> None:
    with passing_folder(left.parent / "other.tif", ENTRIES) as folder:
        assert names(left.parent) == {folder.name}
        assert folder.stat().st_mode & 0o777 == 0o700
    assert not names(left.parent)


def _other_words(folder: Path) -> None:
    (folder / folders._MARK).write_text("A folder of mine.\nprocess 1 on here\n")


def _other_machine(folder: Path) -> None:
    mark = folder / folders._MARK
    mark.write_text(mark.read_text().rpartition(" on ")[0] + " on another-machine\n")


def _no_mark(folder: Path) -> None:
    (folder / folders._MARK).unlink()


def _linked_mark(folder: Path) -> None:
    mark = folder / folders._MARK
    mark.rename(folder.parent / "kept")
    mark.symlink_to(folder.parent / "kept")


def _two_names(folder: Path) -> None:
    os.link(folder / folders._MARK, folder.parent / "kept")


def _pipe_for_a_mark(folder: Path) -> None:
    (folder / folders._MARK).unlink()
    os.mkfifo(folder / folders._MARK)


@pytest.mark.parametrize("change", [_other_words, _other_machine, _no_mark, _linked_mark, _two_names, _pipe_for_a_mark])
def test_what_may_be_of_somebody_else_stays(left: Path, change: Callable[[Path], None]) -> None:
    change(left)
    before = {path: path.lstat().st_size for path in left.parent.rglob("*")}
    with passing_folder(left.parent / "a.npy", ENTRIES):
        pass
    assert {path: path.lstat().st_size for path in left.parent.rglob("*")} == before


def test_a_link_of_such_a_name_is_not_followed(left: Path, tmp_path: Path) -> None:
    left.rename(tmp_path / "elsewhere")
    left.symlink_to(tmp_path / "elsewhere")
    with passing_folder(tmp_path / "a.npy", ENTRIES):
        pass
    assert (tmp_path / "elsewhere" / "tasks" / "x.npy").exists()
    assert left.is_symlink()


def test_a_link_that_takes_the_place_of_what_was_left_is_not_followed(
    left: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_somebody = tmp_path / "of somebody"
    of_somebody.mkdir()
    fill(of_somebody)
    lock = fcntl.flock

    def meanwhile(handle: int, how: int) -> None:
        lock(handle, how)
        if not left.is_symlink():
            left.rename(tmp_path / "elsewhere")
            left.symlink_to(of_somebody)

    with monkeypatch.context() as context:
        context.setattr("lodestream.bands.folders.fcntl.flock", meanwhile)
        with passing_folder(tmp_path / "a.npy", ENTRIES):
            pass
    assert (of_somebody / "tasks" / "x.npy").exists()


def test_a_folder_that_cannot_be_marked_is_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "no space left")

    with monkeypatch.context() as context:
        context.setattr("lodestream.bands.folders.os.open", full)
        with pytest.raises(OSError, match="no space left"), passing_folder(tmp_path / "a.npy", ENTRIES):
            pass
    assert not names(tmp_path)


def test_what_others_put_there_stays_with_the_mark(left: Path) -> None:
    (left / "diary.txt").write_text("dear diary")
    for _ in range(2):
        with passing_folder(left.parent / "a.npy", ENTRIES):
            pass
        assert names(left) == {"diary.txt", folders._MARK}


def test_a_file_system_without_locks_keeps_what_was_left(left: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def without(handle: int, how: int) -> None:
        raise OSError(errno.ENOLCK, "no locks available")

    monkeypatch.setattr("lodestream.bands.folders.fcntl.flock", without)
    with passing_folder(left.parent / "a.npy", ENTRIES):
        pass
    assert (left / "tasks" / "x.npy").exists()


def test_after_an_error_too_it_is_gone(tmp_path: Path) -> None:
    def interrupted() -> None:
        with passing_folder(tmp_path / "a.npy", ENTRIES) as folder:
            fill(folder)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert not names(tmp_path)
