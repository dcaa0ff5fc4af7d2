"""Random access to the bytes of one container: the interface, and files and memory behind it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Protocol

from ..errors import LodestreamError
from ..operating_system import read_at

__all__ = ["AT_ONCE", "ByteSource", "FileSource", "MemorySource", "read_all"]

#: Bytes of one read at most, so that a browser that goes away costs no more than these.
AT_ONCE = 1 << 20


class ByteSource(Protocol):
    """Random access to the bytes of one container, from several threads. A pickled one is opened again.

    Attributes
    ----------
    place : str
        Where they are, for messages: an absolute path, an address, or that they are in memory.
    name : str
        What the surface is called, if it does not say so itself.
    size : int
        Bytes of the container.
    tag : str
        Changes when the bytes change; letters and digits.
    gap : int
        Ranges that are no farther from each other than so many bytes are read at once: another read costs as much.
    """

    place: str
    name: str
    size: int
    tag: str
    gap: int

    def read(self, offset: int, length: int) -> bytes:
        """Return at most ``length`` bytes from ``offset`` on, at least one.

        Raises
        ------
        LodestreamError, OSError
            If they cannot be had.
        """

    def close(self) -> None:
        """Let go of what is held open; nothing is read afterwards."""


def read_all(source: ByteSource, offset: int, length: int) -> bytes:
    """Return ``length`` bytes from ``offset`` on, in as many reads as it takes; fewer only where the container ends.

    Raises
    ------
    LodestreamError, OSError
        If they cannot be had.
    """
    run, end = bytearray(), min(offset + length, source.size)
    while (at := offset + len(run)) < end:
        run += source.read(at, end - at)
    return bytes(run)


class MemorySource:
    """A container in memory.

    Parameters
    ----------
    data : bytes
    name : str
    """

    def __init__(self, data: bytes, name: str = "") -> None:
        self.place = "memory"
        self.name = name
        self.size = len(data)
        self.tag = "memory"
        self.gap = 0
        self._data = data

    def read(self, offset: int, length: int) -> bytes:
        """Return at most ``length`` bytes from ``offset`` on."""
        return self._data[offset : offset + min(length, AT_ONCE)]

    def close(self) -> None:
        """Do nothing."""


class FileSource:
    """A container file, which is opened for each read: it may be replaced meanwhile, and that is noticed.

    Raises
    ------
    OSError
        If there is no such file.
    """

    def __init__(self, path: Path, name: str | None = None) -> None:
        status = path.stat()
        self.place = str(path.absolute())
        self.name = path.name.removesuffix(".lode") if name is None else name
        self.size = status.st_size
        self.tag = _tag(status)
        self.gap = 1 << 12

    def __reduce__(self) -> tuple[Any, ...]:
        return FileSource, (Path(self.place), self.name)

    def read(self, offset: int, length: int) -> bytes:
        """Return at most ``length`` bytes from ``offset`` on.

        Raises
        ------
        OSError
            If the file cannot be read.
        LodestreamError
            If it is another file than it was, or was written since.
        """
        with open(self.place, "rb") as file:
            data = read_at(file.fileno(), min(length, AT_ONCE), offset)
            # Asked afterwards: what was read before a change is of the old file.
            same = _tag(os.fstat(file.fileno())) == self.tag
        if not same or not data:
            raise LodestreamError(f"expected {self.place} as it was when this began, got another: it has changed")
        return data

    def close(self) -> None:
        """Do nothing: no read leaves the file open."""


def _tag(status: os.stat_result) -> str:
    return f"{status.st_ino:x}{status.st_mtime_ns:x}{status.st_size:x}"
