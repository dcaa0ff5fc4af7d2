"""Stored containers as they are read: open files, and their indexes."""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from dataclasses import dataclass
from typing import TYPE_CHECKING, BinaryIO

from lodestream.errors import NotFoundError

from .storage import Storage

if TYPE_CHECKING:
    from lodestream.container import ByteRange, Index

__all__ = ["Containers", "OpenContainer"]

# An index holds a record per segment, a few megabytes for the largest surfaces: streams of one surface share it.
_INDEXES_KEPT = 16

# Linux reads what it has in memory and refuses the rest; elsewhere a thread reads everything.
_NOWAIT = getattr(os, "RWF_NOWAIT", 0)


@dataclass(frozen=True)
class OpenContainer:
    """A container open for reading; deleting it does not disturb whoever reads it."""

    sha256: str
    index: Index
    file: BinaryIO

    def read(self, place: ByteRange) -> bytes:
        """The bytes of a slice, fewer where the file ends; from any thread."""
        return os.pread(self.file.fileno(), place.length, place.offset)

    def read_at_once(self, place: ByteRange) -> bytes | None:
        """The same without waiting for a disk: None where the system would have to, or cannot tell."""
        if not _NOWAIT:
            return None
        buffer = bytearray(place.length)
        try:
            count = os.preadv(self.file.fileno(), [buffer], place.offset, _NOWAIT)
        except OSError:
            return None
        # Fewer bytes: the rest is not in memory, or the file has been cut.
        return bytes(buffer) if count == place.length else None

    def close(self) -> None:
        """Close the file."""
        self.file.close()


class Containers:
    """The containers of a storage, with the indexes used last."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
        self._indexes: OrderedDict[str, Index] = OrderedDict()
        self._lock = threading.Lock()

    def open(self, sha256: str) -> OpenContainer:
        """Open a container.

        Raises
        ------
        NotFoundError
            When there is none.
        StreamError
            When it is damaged.
        """
        try:
            file = self._storage.container(sha256).open("rb")
        except FileNotFoundError:  # deleted since it was looked for
            raise NotFoundError(f"expected the SHA-256 of a container on this server, got {sha256[:80]!a}") from None
        try:
            return OpenContainer(sha256, self._index(sha256, file), file)
        except BaseException:
            file.close()
            raise

    def _index(self, sha256: str, file: BinaryIO) -> Index:
        with self._lock:
            known = self._indexes.get(sha256)
            if known is not None:
                self._indexes.move_to_end(sha256)
                return known
        from lodestream.container import read_index

        handle = file.fileno()
        index = read_index(lambda offset, length: os.pread(handle, length, offset), os.fstat(handle).st_size)
        with self._lock:
            self._indexes[sha256] = index
            while len(self._indexes) > _INDEXES_KEPT:
                self._indexes.popitem(last=False)
        return index
