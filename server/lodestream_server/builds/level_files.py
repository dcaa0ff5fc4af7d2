"""Level files on disk: the most recently requested ones, within a limit on disk space."""

from __future__ import annotations

import itertools
from collections.abc import Awaitable, Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

from ..operation.threads import carried_out
from ..store.durable import discard
from ..store.kept_files import KeptFiles, Lease

__all__ = ["REMOVED", "Key", "LevelFiles"]

#: Why a level file is not where it was made, or cannot be made.
REMOVED = "The server's scratch folder was removed meanwhile; ask again"


class Key(NamedTuple):
    """Identifies a level file."""

    container: str
    level: int
    format_name: str


class LevelFiles:
    """Level files in a folder of their own, which is created with the first of them.

    All files together, including a file that is being made, take at most ``most`` bytes. Before a file is made, files
    that nobody reads are removed until half of that is free.

    Parameters
    ----------
    folder : Path
    most : int
        Bytes.
    free : callable
        Returns how many bytes of the disk may be used now.
    """

    def __init__(self, folder: Path, most: int, free: Callable[[], Awaitable[int]]) -> None:
        self.folder = folder
        self.most = most
        self._free = free
        self._files = KeptFiles[Key]()
        self._numbers = itertools.count()

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
        return self._files.size

    @property
    def lent(self) -> int:
        """Bytes of the files that somebody reads, including removed ones."""
        return self._files.lent

    def lend(self, key: Key) -> Lease | None:
        """Return a lease of a file, if it exists."""
        return self._files.lend(key)

    async def make_room(self) -> int:
        """Remove files to make room for another one; return the bytes that it may have, 0 if there is no room."""
        await self._shrink(self.most // 2)
        free = await self._free()
        if free < 2 * self.longest:
            await self._shrink(0)
            free = await self._free()
        return max(min(self.longest, (self.most - self.size) // 2, free // 2), 0)

    async def _shrink(self, most: int) -> None:
        await carried_out(partial(self._files.shrink, most))

    def new_folder(self, key: Key) -> Path:
        """Return the path of a folder in which to make a file."""
        return self.folder / f"{key.container}-{key.level}-{key.format_name}.{next(self._numbers)}"

    def add(self, key: Key, path: Path, size: int, *, kept: bool) -> Lease:
        """Take over a file from a folder of `new_folder`, and lend it; without `kept` it is removed at its release."""
        place = path.parent.with_name(f"{path.parent.name}.level")
        path.rename(place)
        return self._files.add(key, place, size, kept=kept)

    def forget(self, container: str) -> None:
        """Remove the files of a container; those being read, when they are released."""
        self._files.forget(lambda key: key.container == container)
