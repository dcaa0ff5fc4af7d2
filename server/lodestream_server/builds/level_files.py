"""Level files on disk: the most recently requested ones, within a limit on disk space."""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from ..operation.threads import carried_out
from ..store.durable import discard

__all__ = ["REMOVED", "Key", "Lease", "LevelFiles"]

#: Why a level file is not where it was made, or cannot be made.
REMOVED = "The server's scratch folder was removed meanwhile; ask again"


class Key(NamedTuple):
    """Identifies a level file."""

    container: str
    level: int
    format_name: str


@dataclass
class _File:
    path: Path
    size: int
    readers: int = 0
    forgotten: bool = False


class Lease:
    """A level file in use; it is not removed before it is released.

    Attributes
    ----------
    path : Path
    size : int
        Bytes.
    """

    def __init__(self, files: LevelFiles, file: _File) -> None:
        self.path = file.path
        self.size = file.size
        self._files: LevelFiles | None = files
        self._file = file
        file.readers += 1

    def again(self) -> Lease:
        """Return another lease of the same file."""
        assert self._files is not None, "it was not given back"
        return Lease(self._files, self._file)

    def release(self) -> None:
        """Release the file; further calls do nothing."""
        files, self._files = self._files, None
        if files is not None:
            self._file.readers -= 1
            files.released(self._file)


class LevelFiles:
    """Level files in a folder of their own, which is created with the first of them.

    All files together, including a file that is being made, take at most ``most`` bytes. Before a file is made, files
    that nobody reads are removed until half of that is free. Everything except disk access happens in the event loop,
    so no lock is needed.

    Parameters
    ----------
    folder : Path
    most : int
        Bytes.
    free : callable
        Returns how many bytes of the disk may be used now.

    Attributes
    ----------
    lent : int
        Bytes of the files that somebody reads, removed ones included.
    """

    def __init__(self, folder: Path, most: int, free: Callable[[], Awaitable[int]]) -> None:
        self.folder = folder
        self.most = most
        self._free = free
        self._files: OrderedDict[Key, _File] = OrderedDict()
        self._numbers = itertools.count()
        self.lent = 0

    def close(self) -> None:
        """Remove all files."""
        discard(self.folder)

    @property
    def longest(self) -> int:
        """Bytes of the largest file that can be made; a library may write a second one on the way to it."""
        return self.most // 4

    @property
    def size(self) -> int:
        """Bytes of all files, including removed ones that are still being read."""
        return self.lent + sum(file.size for file in self._files.values() if not file.readers)

    def lend(self, key: Key) -> Lease | None:
        """Return a lease of a file, if it exists."""
        file = self._files.get(key)
        if file is None:
            return None
        self._files.move_to_end(key)
        return self._lease(file)

    def _lease(self, file: _File) -> Lease:
        if not file.readers:
            self.lent += file.size
        return Lease(self, file)

    def released(self, file: _File) -> None:
        """Count a reader less of a file; `Lease` calls this."""
        if not file.readers:
            self.lent -= file.size
            if file.forgotten:
                discard(file.path)

    async def make_room(self) -> int:
        """Remove files to make room for another one; return the bytes that it may have, 0 if there is no room."""
        await self._shrink(self.most // 2)
        free = await self._free()
        if free < 2 * self.longest:
            await self._shrink(0)
            free = await self._free()
        return max(min(self.longest, (self.most - self.size) // 2, free // 2), 0)

    async def _shrink(self, most: int) -> None:
        for key, file in list(self._files.items()):
            if self.size <= most:
                return
            # Meanwhile its container may have gone, or somebody may have begun to read it.
            if self._files.get(key) is file and not file.readers:
                del self._files[key]
                await carried_out(partial(discard, file.path))

    def new_folder(self, key: Key) -> Path:
        """Return the path of a folder in which to make a file."""
        return self.folder / f"{key.container}-{key.level}-{key.format_name}.{next(self._numbers)}"

    def add(self, key: Key, path: Path, size: int, *, kept: bool) -> Lease:
        """Take over a file from a folder of `new_folder`, and lend it; without `kept` it is removed at its release."""
        place = path.parent.with_name(f"{path.parent.name}.level")
        path.rename(place)
        file = _File(place, size, forgotten=not kept)
        if kept:
            self._files[key] = file
        return self._lease(file)

    def forget(self, container: str) -> None:
        """Remove the files of a container; those being read, when they are released."""
        for key in [key for key in self._files if key.container == container]:
            file = self._files.pop(key)
            file.forgotten = True
            if not file.readers:
                discard(file.path)
