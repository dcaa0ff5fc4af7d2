"""Folders for the files of a build: a temporary one beside the output, or one that the next call continues in."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from ..errors import InputError
from ..operating_system import (
    NO_LOCKS,
    is_of_another_user,
    is_writable_by_others,
    lock,
    open_own,
    remove_closed,
    remove_folder,
    run_in_forks,
    unlock,
)
from ..scratch import FolderScratch, checksum

__all__ = [
    "BuildFolders",
    "check_out",
    "is_sealed",
    "kept_folder",
    "remove",
    "remove_leftovers",
    "replacing",
    "seal",
    "temporary_folder",
]

_LOCK = "lock"
_SEAL = "seal.json"
#: How the name of a temporary folder ends.
_TEMPORARY = ".lodestream"
#: What is on its way out: nobody can write there under its former name any more.
_REMOVED = ".lodestream-removed-"
#: Characters of a name that another name begins with: file systems take 255 bytes.
_SHORT = 50
#: Descriptors of the locks that this process has.
_HELD: set[int] = set()
#: How often a folder may vanish, or its lock be another file than the one that was opened, while it is taken.
_ATTEMPTS = 100


class BuildFolders:
    """The folders of a call of `encode`, which are made when they are needed.

    Parameters
    ----------
    stack : ExitStack
        When it ends, so does the use of the folders.
    scratch : path-like or None
        The folder in which builds continue; None: no build continues.
    out : path-like or None
        The container. Temporary folders are in ``scratch``, or beside this, or among those of the system.
    """

    def __init__(
        self, stack: ExitStack, scratch: str | os.PathLike[str] | None, out: str | os.PathLike[str] | None
    ) -> None:
        self._stack = stack
        self._scratch = None if scratch is None else Path(scratch)
        self._out = None if out is None else Path(out)
        self._temporary: Path | None = None

    def temporary(self) -> Path:
        """Make a temporary folder, which is removed at the end, whatever happens."""
        if self._temporary is None:
            name = "" if self._out is None else self._out.name
            above = None if self._out is None else self._out.parent
            if self._scratch is not None:
                self._scratch.mkdir(parents=True, exist_ok=True)
                above = self._scratch
            self._temporary = self._stack.enter_context(temporary_folder(above, name))
        return self._temporary

    def copies(self) -> FolderScratch:
        """Make a temporary folder for copies of sources that can be read only once."""
        return FolderScratch(self.temporary() / "source")

    def build(self, key: Callable[[], str]) -> FolderScratch:
        """Make or reopen the folder of a build; the key, see `kept_folder`, is asked for only where builds continue."""
        if self._scratch is None:
            return FolderScratch(self.temporary() / "build")
        return FolderScratch(self._stack.enter_context(kept_folder(self._scratch, key())), lasting=True)


def check_out(path: Path) -> None:
    """Check before any work that a file can be written.

    Raises
    ------
    OSError
        If its folder is not there, or it is a folder itself.
    """
    if not path.parent.is_dir():
        raise FileNotFoundError(
            errno.ENOENT, "expected a folder to write a container into, there is none", str(path.parent)
        )
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "expected the name of a container to write, got a folder", str(path))


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a path for a new file that replaces ``path`` when the block ends; no other process writes to it.

    A link stays a link. A pipe or a device is not replaced: the file is copied into it.
    """
    if path.exists() and not path.is_file():  # before links are followed: that of a pipe leads to no path
        with tempfile.TemporaryDirectory(prefix="lodestream-") as folder:
            yield (copy := Path(folder) / "container")
            with copy.open("rb") as whole, path.open("wb") as out:
                shutil.copyfileobj(whole, out)
        return
    path = path.resolve()
    unfinished = path.with_name(f".{path.name[:_SHORT]}.{secrets.token_hex(6)}.part")
    try:
        yield unfinished
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


@contextmanager
def temporary_folder(above: Path | None, name: str = "") -> Iterator[Path]:
    """Make a folder in another one that only this user can read, and remove it afterwards, whatever happens.

    Parameters
    ----------
    above : Path or None
        None: where the system has temporary files.
    name : str
        Its name begins with this.

    Raises
    ------
    OSError
        If it cannot be made.
    """
    # Absolute, since workers of a build may be at work elsewhere.
    folder = Path(tempfile.mkdtemp(_TEMPORARY, f".{name[:_SHORT]}.", above)).absolute()
    try:
        yield folder
    finally:
        remove(folder)


@contextmanager
def kept_folder(scratch: Path, key: str) -> Iterator[Path]:
    """Lock the folder of a key, and yield it; it is removed if the block ends well, else it is kept.

    Parameters
    ----------
    scratch : Path
        Is made if it is not there; it stays, and so does all else in it.
    key : str
        What decides about the files: the name of the folder is a hash of it.

    Raises
    ------
    InputError
        If another process is at work there, or another user has made it.
    OSError
        If it cannot be made.
    """
    scratch.mkdir(parents=True, exist_ok=True)
    remove_leftovers(scratch)
    folder = scratch.absolute() / hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest()[:24]
    descriptor = _locked(folder)
    has_ended_well = False
    try:
        yield folder
        has_ended_well = descriptor in _HELD  # else this is a fork of the process that builds
        if has_ended_well:
            remove(folder)
    finally:
        _let_go(descriptor)
        if has_ended_well:
            remove_closed(folder / _LOCK)


def _locked(folder: Path) -> int:
    """Lock a folder, which is made if it is missing; return a file descriptor."""
    for _ in range(_ATTEMPTS):
        try:
            folder.mkdir(0o700)
        except FileExistsError:
            was_there = True
        else:
            was_there = False
        try:
            if was_there:
                _check(folder)
            handle = open_own(folder / _LOCK, create=True)
        except FileNotFoundError:  # the build that had it has just removed the folder
            continue
        _HELD.add(handle)
        try:
            _lock(handle, folder)
            if os.path.samestat(os.fstat(handle), os.lstat(folder / _LOCK)):
                return handle
        except FileNotFoundError:
            pass
        except BaseException:
            _let_go(handle)
            raise
        _let_go(handle)
    raise InputError(f"expected {folder} to keep its lock, it is another file each time; choose another scratch folder")


def _check(folder: Path) -> None:
    """Refuse a folder of another user: tasks are unpickled from it."""
    state = folder.lstat()
    if not stat.S_ISDIR(state.st_mode):
        raise InputError(f"expected a folder of a build at {folder}, got something else")
    if is_of_another_user(state):
        raise InputError(
            f"expected {folder} to be a folder of this user, got one of another; choose another scratch folder"
        )
    if is_writable_by_others(state):
        raise InputError(f"expected {folder} to be writable by this user alone, others may write there; remove it")


def _lock(handle: int, folder: Path) -> None:
    try:
        is_free = lock(handle)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        return
    if not is_free:
        raise InputError(
            f"expected {folder} to be free for this build, the same build is at work there; choose another scratch "
            "folder"
        ) from BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))  # by which a server knows that it will pass


def _let_go(handle: int) -> None:
    if handle in _HELD:
        _HELD.remove(handle)
        unlock(handle)
        os.close(handle)


def _forked() -> None:
    """Close inherited descriptors in a forked process, so that a lock ends with the process that took it."""
    while _HELD:
        os.close(_HELD.pop())


run_in_forks(_forked)


def remove(path: Path) -> None:
    """Remove a folder with its contents, if it exists.

    It is renamed first, so that a late task cannot write into it.
    """
    away = path.with_name(f"{_REMOVED}{secrets.token_hex(6)}")
    try:
        path.rename(away)
    except FileNotFoundError:
        return
    except OSError:  # a folder whose files are open, on Windows
        away = path
    remove_folder(away)


def remove_leftovers(folder: Path) -> None:
    """Remove folders that a killed process had begun to remove."""
    for path in folder.glob(f"{_REMOVED}*"):
        remove_folder(path)


def seal(folder: Path) -> None:
    """Put the files of a finished folder on disk, with a list of their lengths and checksums.

    Raises
    ------
    OSError
        If the disk fails.
    """
    sums = {}
    for path in _files(folder):
        with path.open("rb+") as file:
            os.fsync(file.fileno())
        sums[path.relative_to(folder).as_posix()] = checksum(path)
    unfinished = folder / f"{_SEAL}.part"
    with unfinished.open("w", encoding="utf-8") as file_:
        json.dump(sums, file_)
        file_.flush()
        os.fsync(file_.fileno())
    unfinished.replace(folder / _SEAL)


def is_sealed(folder: Path) -> bool:
    """Return whether a folder exists and its files are byte for byte those that were sealed."""
    try:
        sums = json.loads((folder / _SEAL).read_bytes())
        return bool({path.relative_to(folder).as_posix(): list(checksum(path)) for path in _files(folder)} == sums)
    except (OSError, ValueError):  # it is not there, or damaged: so are files that a disk cannot read
        return False


def _files(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.rglob("*")) if path.is_file() and path != folder / _SEAL]
