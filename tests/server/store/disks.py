"""Disks that are full, or remove nothing: for `store.durable.disk`, the store and the index."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import BinaryIO, ClassVar

from lodestream.stores import Folder, FullError, Progress, Tag
from lodestream_server.store.durable import Disk
from lodestream_server.store.index import Index, Surface

__all__ = ["CountingDisk", "FullDisk", "FullFolder", "FullIndex", "StickyDisk"]


class CountingDisk(Disk):
    """A disk that is asked before each step that needs room; here it always has some.

    Attributes
    ----------
    steps : list of str
        The steps so far, by name.
    """

    def __init__(self) -> None:
        self.steps: list[str] = []

    def ask(self, step: str) -> None:
        """Raise when there is no room."""
        self.steps.append(step)

    def make_folder(self, path: Path) -> None:
        self.ask("make_folder")
        super().make_folder(path)

    def create(self, path: Path) -> BinaryIO:
        self.ask("create")
        return super().create(path)

    def write(self, file: BinaryIO, data: bytes) -> None:
        try:
            self.ask("write")
        except OSError:
            # A disk fills up in the middle of what is written.
            super().write(file, data[: len(data) // 2])
            raise
        super().write(file, data)

    def sync(self, handle: int, path: Path) -> None:
        self.ask("sync")
        super().sync(handle, path)

    def rename(self, source: Path, target: Path) -> None:
        self.ask("rename")
        super().rename(source, target)


class FullDisk(CountingDisk):
    """A disk that one step finds full, or that one and all after it.

    Parameters
    ----------
    step : int
        Number of the step, from 0.
    lasting : bool
        It stays full.
    """

    def __init__(self, step: int, *, lasting: bool = False) -> None:
        super().__init__()
        self._step = step
        self._lasting = lasting

    def ask(self, step: str) -> None:
        number = len(self.steps)
        super().ask(step)
        if number == self._step or (self._lasting and number > self._step):
            raise OSError(errno.ENOSPC, "No space left on device")


class StickyDisk(Disk):
    """A disk that removes nothing beneath some folders."""

    def __init__(self, *folders: Path) -> None:
        self._folders = folders

    def unlink(self, path: Path) -> None:
        self._ask(path)
        super().unlink(path)

    def remove_folder(self, path: Path) -> None:
        self._ask(path)
        super().remove_folder(path)

    def _ask(self, path: Path) -> None:
        if any(path.is_relative_to(folder) for folder in self._folders):
            raise OSError(errno.EIO, "Input/output error")


class FullFolder(Folder):
    """A store on a disk that one of its writes finds full, or that one and all after it.

    What is asked before a write is also asked before each change of the index, which is on the same disk.

    Attributes
    ----------
    full : int or None
        Number of the write, from 0; None: there is room.
    lasting : bool
        It stays full.
    below : str or None
        Or every write of a key that begins like this finds it full.
    steps : list of str
        The writes so far, by name.
    """

    below: str | None = None
    full: int | None = None
    lasting = False
    steps: ClassVar[list[str]] = []

    @classmethod
    def fill(cls, step: int | None, *, lasting: bool = False) -> None:
        """Let the disk be full at a step from now on; None: at no step."""
        cls.full, cls.lasting, cls.below = step, lasting, None
        cls.steps.clear()

    @classmethod
    def ask(cls, step: str, key: str = "") -> None:
        """Raise when there is no room."""
        if cls.below is not None and key.startswith(cls.below):
            raise FullError(f"{key}: No space left on device")
        number = len(cls.steps)
        cls.steps.append(step)
        if cls.full is not None and (number == cls.full or (cls.lasting and number > cls.full)):
            raise FullError(f"{step}: No space left on device")

    def create(self, key: str, data: bytes) -> Tag:
        self.ask("create", key)
        return super().create(key, data)

    def replace(self, key: str, data: bytes, tag: Tag) -> Tag:
        self.ask("replace", key)
        return super().replace(key, data, tag)

    def put_file(self, key: str, path: Path, progress: Progress | None = None, *, given: bool = False) -> None:
        self.ask("put_file", key)
        super().put_file(key, path, progress, given=given)


class FullIndex(Index):
    """An index on that disk."""

    def put(self, surface: Surface, seen: str | None = None, built_seen: str | None = None) -> None:
        FullFolder.ask("index")
        super().put(surface, seen, built_seen)
