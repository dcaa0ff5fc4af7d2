"""Writing files that survive a power failure; the server makes all changes of its folder through this module.

Every step that changes the disk is a method of `Disk`, called on the one object `disk`. Tests replace it, to simulate a
full disk at any step or the loss of everything that was not synchronised.
"""

from __future__ import annotations

import logging
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

__all__ = ["Disk", "NewFile", "discard", "disk", "make_folder", "remove", "rename", "sync_folder"]

_log = logging.getLogger(__name__)

_COPIED = 1 << 20


class Disk:
    """The steps in which the server changes its folder; each may fail for lack of space."""

    def make_folder(self, path: Path) -> None:
        """Create a folder that only its owner can access."""
        path.mkdir(0o700)

    def create(self, path: Path) -> BinaryIO:
        """Open a new file for writing that only its owner can access."""
        # Unbuffered: the bytes reach the file in `write`, and nothing is left to fail when it is closed.
        return open(path, "xb", buffering=0, opener=_private)

    @contextmanager
    def extend(self, path: Path, size: int) -> Iterator[BinaryIO]:
        """Open a file for writing after so many bytes; what is beyond them is cut off."""
        with open(path, "r+b", buffering=0) as file:
            file.truncate(size)
            file.seek(size)
            yield file

    def write(self, file: BinaryIO, data: bytes) -> None:
        """Append bytes, all of them."""
        rest = memoryview(data)
        while rest:
            rest = rest[file.write(rest) :]

    def sync(self, handle: int, path: Path) -> None:
        """Synchronise a file's bytes, or the names in a folder, to disk."""
        os.fsync(handle)

    def link(self, source: Path, target: Path) -> None:
        """Give a file a second name; where that is not possible, make a copy."""
        try:
            target.hardlink_to(source)
        except FileNotFoundError:
            raise
        except OSError:
            with source.open("rb") as file, self.create(target) as copy:
                shutil.copyfileobj(file, copy, _COPIED)

    def rename(self, source: Path, target: Path) -> None:
        """Rename a file or folder, replacing what has the new name."""
        source.replace(target)

    def unlink(self, path: Path) -> None:
        """Remove a file, if it exists."""
        path.unlink(missing_ok=True)

    def remove_folder(self, path: Path) -> None:
        """Remove a folder with its contents."""
        with suppress(RecursionError):  # one that was made to be too deep
            shutil.rmtree(path, ignore_errors=True)
        if path.is_dir():
            with suppress(OSError):
                _remove_deep(path)


def _remove_deep(top: Path) -> None:
    """Remove a folder, however deep it is and whatever its permissions are."""
    while inner := [entry.path for entry in os.scandir(top) if entry.is_dir(follow_symlinks=False)]:
        for folder in inner:
            os.chmod(folder, 0o700)
            for entry in list(os.scandir(folder)):
                if entry.is_dir(follow_symlinks=False):
                    os.chmod(entry.path, 0o700)
                    os.rename(entry.path, top / f".{secrets.token_hex(8)}")
                else:
                    os.unlink(entry.path)
            os.rmdir(folder)
    shutil.rmtree(top)


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


#: What the functions below work on.
disk = Disk()


class NewFile:
    """A file being written. It is removed if the ``with`` block fails.

    When the block ends, the file is on disk. The caller then renames it, or the folder around it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = 0
        self._file = disk.create(path)

    def write(self, data: bytes) -> None:
        """Append bytes."""
        disk.write(self._file, data)
        self.size += len(data)

    def __enter__(self) -> Self:
        """Return the file itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put the file on disk, or remove it after an error."""
        try:
            with self._file:
                if kind is None:
                    disk.sync(self._file.fileno(), self.path)
        except OSError:
            discard(self.path)
            raise
        if kind is not None:
            discard(self.path)


def make_folder(path: Path) -> Path:
    """Create a folder; its name is on disk once the parent folder is synchronised."""
    disk.make_folder(path)
    return path


def rename(source: Path, target: Path) -> None:
    """Give a file or folder that is on disk its final name; if that fails it keeps the old one."""
    disk.rename(source, target)
    sync_folder(target.parent)


def remove(path: Path) -> None:
    """Remove a file, or a folder with its contents; does nothing if there is none."""
    if path.is_dir() and not path.is_symlink():
        disk.remove_folder(path)
    else:
        disk.unlink(path)


def discard(path: Path) -> None:
    """Remove something that is no longer needed; if that fails, log it and leave it for the next start to remove.

    For files whose removal does not matter to the caller: the work before was successful in any case.
    """
    try:
        remove(path)
    except OSError as error:
        _log.warning("%s is no longer needed, but could not be removed: %s", path, error.strerror or error)


def sync_folder(path: Path) -> None:
    """Synchronise the names in a folder to disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        disk.sync(handle, path)
    finally:
        os.close(handle)
