"""Folders of builds: what is temporary is gone, what is kept is found again, and one process at a time has it."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from lodestream.encoding import folders
from lodestream.encoding.folders import kept_folder, remove, replacing, temporary_folder
from lodestream.errors import InputError
from lodestream.operating_system import NO_LOCKS
from lodestream.scratch import FolderScratch


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.mark.parametrize("error", [None, KeyError, KeyboardInterrupt])
def test_a_temporary_folder_is_gone_afterwards(tmp_path: Path, error: type[BaseException] | None) -> None:
    def used() -> None:
        with temporary_folder(tmp_path, "a" * 300) as folder:
            (folder / "x").mkdir()
            (folder / "x" / "y").touch()
            assert folder.parent == tmp_path
            assert folder.stat().st_mode & 0o777 == 0o700
            if error is not None:
                raise error

    if error is None:
        used()
    else:
        with pytest.raises(error):
            used()
    assert not names(tmp_path)


def test_folders_are_found_from_elsewhere_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with temporary_folder(Path("."), "a") as temporary, kept_folder(Path("scratch"), "key") as kept:
        monkeypatch.chdir("/")
        assert temporary.parent == tmp_path
        assert kept.parent == tmp_path / "scratch"
    assert names(tmp_path) == {"scratch"}


def _cut(scratch: Path, key: str = "key") -> None:
    with kept_folder(scratch, key) as folder:
        (folder / "x").touch()
        raise KeyboardInterrupt


def test_a_folder_is_kept_after_an_error_and_found_again_by_its_key(tmp_path: Path) -> None:
    scratch = tmp_path / "new" / "scratch"
    with pytest.raises(KeyboardInterrupt):
        _cut(scratch)
    (left,) = scratch.iterdir()
    (scratch / "diary.txt").write_text("dear diary")
    with kept_folder(scratch, "another") as other:
        assert names(other) == {folders._LOCK}
    with kept_folder(scratch, "key") as folder:
        assert folder == left
        assert (folder / "x").exists()
    assert names(scratch) == {"diary.txt"}


def test_what_was_being_removed_is_removed(tmp_path: Path) -> None:
    (tmp_path / f"{folders._REMOVED}1" / "a").mkdir(parents=True)
    with kept_folder(tmp_path, "key") as folder:
        assert names(tmp_path) == {folder.name}


def test_the_same_build_is_told_that_one_is_at_work(tmp_path: Path) -> None:
    with kept_folder(tmp_path, "key") as folder:
        expected = "the same build is at work there; choose another scratch folder"
        with pytest.raises(InputError, match=expected), kept_folder(tmp_path, "key"):
            pytest.fail("two at once")
        with kept_folder(tmp_path, "another"):
            pass
        assert names(tmp_path) == {folder.name}
    with kept_folder(tmp_path, "key"):
        pass


@pytest.mark.parametrize("other", [Path.touch, lambda path: path.symlink_to(path.parent / "elsewhere")])
def test_what_is_no_folder_is_refused(tmp_path: Path, other: Callable[[Path], None]) -> None:
    with kept_folder(tmp_path, "key") as folder:
        pass
    (tmp_path / "elsewhere").mkdir()
    other(folder)
    with pytest.raises(InputError, match="got something else"), kept_folder(tmp_path, "key"):
        pytest.fail("it is not ours")
    assert names(tmp_path) == {"elsewhere", folder.name}


def test_a_folder_of_another_user_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(KeyboardInterrupt):
        _cut(tmp_path)
    user = os.geteuid()
    monkeypatch.setattr(os, "geteuid", lambda: user + 1)
    with pytest.raises(InputError, match="one of another"), kept_folder(tmp_path, "key"):
        pytest.fail("whose is it")


def _fork_and_die(scratch: Path, forked: Connection) -> None:
    with kept_folder(scratch, "key") as folder:
        (folder / "x").touch()
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
    process = multiprocessing.get_context("spawn").Process(target=_fork_and_die, args=(tmp_path, sender))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    child = receiver.recv()
    try:
        os.kill(child, 0)  # it is there
        with kept_folder(tmp_path, "key") as folder:
            assert (folder / "x").exists()
    finally:
        os.kill(child, signal.SIGKILL)
    assert not names(tmp_path)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are not forked")
def test_a_fork_that_ends_removes_nothing(tmp_path: Path) -> None:
    def fork() -> int:
        with kept_folder(tmp_path, "key") as folder:
            (folder / "x").touch()
            child = os.fork()
            if child:
                os.waitpid(child, 0)
                assert (folder / "x").exists()
                with pytest.raises(InputError, match="at work"), kept_folder(tmp_path, "key"):
                    pytest.fail("two at once")
        return child

    if not fork():
        os._exit(0)
    assert not names(tmp_path)


def test_a_folder_that_goes_while_it_is_opened_is_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lock: Callable[[int, Path], None] = folders._lock
    calls: list[Path] = []

    def late(handle: int, folder: Path) -> None:
        if not calls:  # whoever had it ends just now
            remove(folder)
        calls.append(folder)
        lock(handle, folder)

    monkeypatch.setattr(folders, "_lock", late)
    with kept_folder(tmp_path, "key") as folder:
        assert names(folder) == {folders._LOCK}
        with pytest.raises(InputError, match="at work"), kept_folder(tmp_path, "key"):
            pytest.fail("the lock is that of the folder which is there")
    assert len(calls) == 3
    assert not names(tmp_path)
    assert not folders._HELD


def test_file_systems_without_locks_will_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(*_: Any) -> None:
        raise OSError(next(iter(NO_LOCKS)), "no locks available")

    monkeypatch.setattr("fcntl.flock", no_locks)
    with kept_folder(tmp_path, "key") as folder:
        (folder / "x").touch()
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


def test_a_container_that_is_not_finished_leaves_the_one_before_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.lode"
    path.write_bytes(b"before")

    def interrupted() -> None:
        with replacing(path) as unfinished:
            unfinished.write_bytes(b"half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert names(tmp_path) == {"a.lode"}
    assert path.read_bytes() == b"before"


def test_two_that_write_one_file_do_not_mix(tmp_path: Path) -> None:
    path = tmp_path / "a.lode"
    with replacing(path) as first, replacing(path) as second:
        assert first != second
        first.write_bytes(b"first")
        second.write_bytes(b"second")
    assert path.read_bytes() == b"first"
    assert names(tmp_path) == {"a.lode"}


def test_a_lock_that_is_another_file_each_time_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os.path, "samestat", lambda one, other: False)
    with pytest.raises(InputError, match="another file each time"), kept_folder(tmp_path, "key"):
        raise AssertionError("entered")


def test_the_key_is_asked_for_only_where_a_build_continues(tmp_path: Path) -> None:
    asked = Mock(return_value="key")
    with ExitStack() as stack:
        for scratch in (None, tmp_path / "scratch"):
            build = folders.BuildFolders(stack, scratch, tmp_path / "out").build(asked)
            assert asked.called == build.lasting == (scratch is not None)
