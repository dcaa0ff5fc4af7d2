"""Files that can be made or fetched again: the most recently used ones, and those that somebody reads."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from .durable import discard

__all__ = ["KeptFiles", "Lease"]

_Key = TypeVar("_Key", bound=Hashable)


@dataclass
class _File:
    path: Path
    size: int
    readers: int = 0
    forgotten: bool = False


class Lease:
    """A file in use; it is not removed before it is released.

    Attributes
    ----------
    path : Path
    size : int
        Bytes.
    """

    def __init__(self, file: _File, take: Callable[[_File], Lease], released: Callable[[_File], None]) -> None:
        self.path = file.path
        self.size = file.size
        self._file = file
        self._take = take
        self._released: Callable[[_File], None] | None = released

    def again(self) -> Lease:
        """Return another lease of the same file."""
        assert self._released is not None, "it was not given back"
        return self._take(self._file)

    def release(self) -> None:
        """Release the file; further calls do nothing."""
        released, self._released = self._released, None
        if released is not None:
            released(self._file)


class KeptFiles(Generic[_Key]):
    """Files by key, with the bytes that they take. It may be used from any thread.

    Attributes
    ----------
    lent : int
        Bytes of the files that somebody reads, removed ones included.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._files: OrderedDict[_Key, _File] = OrderedDict()
        self._idle = 0  # bytes of the files that nobody reads
        self.lent = 0

    @property
    def size(self) -> int:
        """Bytes of all files, including removed ones that are still being read."""
        with self._lock:
            return self.lent + self._idle

    def __contains__(self, key: _Key) -> bool:
        """Return whether there is a file."""
        with self._lock:
            return key in self._files

    def lend(self, key: _Key) -> Lease | None:
        """Return a lease of a file, if it exists."""
        with self._lock:
            file = self._files.get(key)
            if file is None:
                return None
            self._files.move_to_end(key)
            return self._take(file)

    def add(self, key: _Key, path: Path, size: int, *, kept: bool = True) -> Lease:
        """Take over a file, and lend it; without ``kept`` it is removed at its release."""
        with self._lock:
            file = _File(path, size, forgotten=not kept)
            if kept:
                assert key not in self._files, "it is there"
                self._files[key] = file
                self._idle += size
            return self._take(file)

    def shrink(self, most: int) -> None:
        """Remove files that nobody reads, least recently used ones first, until all take no more than so many bytes."""
        while (file := self._oldest(most)) is not None:
            discard(file.path)

    def forget(self, which: Callable[[_Key], bool]) -> None:
        """Remove the files of some keys; those being read, when they are released."""
        with self._lock:
            files = [self._drop(key) for key in [key for key in self._files if which(key)]]
        for file in files:
            if not file.readers:
                discard(file.path)

    def give_up(self, key: _Key, path: Path) -> bool:
        """Forget the file of a key, if it is this one: another one may have its place; return whether it was."""
        with self._lock:
            file = self._files.get(key)
            if file is None or file.path != path:
                return False
            self._drop(key)
        if not file.readers:
            discard(path)
        return True

    def _oldest(self, most: int) -> _File | None:
        with self._lock:
            if self.size > most:
                for key, file in self._files.items():
                    if not file.readers:
                        return self._drop(key)
        return None

    def _drop(self, key: _Key) -> _File:
        file = self._files.pop(key)
        file.forgotten = True
        if not file.readers:
            self._idle -= file.size
        return file

    def _take(self, file: _File) -> Lease:
        with self._lock:
            if not file.readers:
                self.lent += file.size
                self._idle -= 0 if file.forgotten else file.size
            file.readers += 1
        return Lease(file, self._take, self._release)

    def _release(self, file: _File) -> None:
        with self._lock:
            file.readers -= 1
            if file.readers:
                return
            self.lent -= file.size
            if not file.forgotten:
                self._idle += file.size
        if file.forgotten:
            discard(file.path)
