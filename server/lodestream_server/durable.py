"""Files that are on disk, whole, when these functions return: everything that the server writes goes through here."""

from __future__ import annotations

import os
import secrets
import shutil
from pathlib import Path
from types import TracebackType
from typing import Self

__all__ = ["NewFile", "remove", "rename", "sync_folder", "write_file"]


class NewFile:
    """A file being written, of which nothing remains unless it was kept.

    It is on disk when the ``with`` block ends; whoever writes it then renames it, or the folder around it.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = 0
        self._file = path.open("xb")

    def write(self, data: bytes) -> None:
        """Append bytes."""
        self._file.write(data)
        self.size += len(data)

    def __enter__(self) -> Self:
        """Give itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put the file on disk, or remove it after an error."""
        try:
            with self._file:
                if kind is None:
                    self._file.flush()
                    os.fsync(self._file.fileno())
        except OSError:
            self.path.unlink(missing_ok=True)
            raise
        if kind is not None:
            self.path.unlink(missing_ok=True)


def write_file(path: Path, data: bytes) -> None:
    """Write a file, or replace one: at every moment it is the old one or the new one."""
    temporary = path.with_name(f"{path.name}.{secrets.token_hex(8)}.new")
    with NewFile(temporary) as file:
        file.write(data)
    rename(temporary, path)


def rename(source: Path, target: Path) -> None:
    """Give a file or folder that is on disk its final place."""
    try:
        source.replace(target)
    except OSError:
        remove(source)
        raise
    sync_folder(target.parent)


def remove(path: Path) -> None:
    """Remove a file or a folder with what is in it; nothing happens if there is none."""
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def sync_folder(path: Path) -> None:
    """Put the names in a folder on disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
