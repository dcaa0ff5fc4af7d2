"""Sources of the bytes of a shown container: a file, memory, or a server."""

from __future__ import annotations

import os
import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Protocol

from lodestream.errors import LodestreamError, RemoteProtocolError
from lodestream.operating_system import read_at

from .. import sync
from ..requests import api, calls

__all__ = ["FileSource", "MemorySource", "RemoteSource", "Source", "read_fully"]

# Bytes of one request to a server, so that a browser that goes away costs no more than these.
_AT_ONCE = 1 << 20


class Source(Protocol):
    """Random access to the bytes of one container, from several threads.

    Attributes
    ----------
    name : str
        What the page calls the surface.
    size : int
        Bytes of the container.
    tag : str
        Changes when the bytes change; letters and digits.
    """

    name: str
    size: int
    tag: str

    def read(self, offset: int, length: int) -> bytes:
        """Return at most ``length`` bytes from ``offset`` on, at least one.

        Raises
        ------
        LodestreamError, OSError
            If they cannot be had.
        """


def read_fully(source: Source, offset: int, length: int) -> bytes:
    """Return all bytes of a range, fewer only where the container ends.

    Raises
    ------
    LodestreamError, OSError
        If they cannot be had.
    """
    run = bytearray()
    while len(run) < min(length, source.size - offset):
        run += source.read(offset + len(run), length - len(run))
    return bytes(run)


class MemorySource:
    """A container in memory.

    Parameters
    ----------
    data : bytes
    name : str
    """

    def __init__(self, data: bytes, name: str) -> None:
        self.name = name
        self.size = len(data)
        self.tag = "memory"
        self._data = memoryview(data)

    def read(self, offset: int, length: int) -> bytes:
        """Return at most ``length`` bytes from ``offset`` on."""
        return bytes(self._data[offset : offset + min(length, _AT_ONCE)])


class FileSource:
    """A container file."""

    def __init__(self, path: Path, name: str | None = None) -> None:
        status = path.stat()
        self.name = path.name.removesuffix(".lode") if name is None else name
        self.size = status.st_size
        self.tag = _tag(status)
        self._path = path

    def read(self, offset: int, length: int) -> bytes:
        """Return at most ``length`` bytes from ``offset`` on.

        Raises
        ------
        OSError
            If the file cannot be read.
        LodestreamError
            If it is another file than it was, or was written since.
        """
        with self._path.open("rb") as file:
            data = read_at(file.fileno(), min(length, _AT_ONCE), offset)
            # Asked afterwards: what was read before a change is of the old file.
            same = _tag(os.fstat(file.fileno())) == self.tag
        if not same or not data:
            raise LodestreamError(f"expected {self._path} as it was when this began, got another: it has changed")
        return data


def _tag(status: os.stat_result) -> str:
    return f"{status.st_ino:x}{status.st_mtime_ns:x}{status.st_size:x}"


class RemoteSource:
    """A container on a server, or on any host of files with Range; the token stays here.

    Parameters
    ----------
    url : str
        Of a surface of a server, of a container file, or of a name on a server or a published page.
    token : str or None

    Attributes
    ----------
    url : str
        Of the surface or the container itself.

    Raises
    ------
    LodestreamError
        If the server cannot be reached, refuses, or does not say how long the file is.
    """

    def __init__(self, url: str, token: str | None) -> None:
        import httpx

        url = sync.locate(url, token=token)
        identity = sync.identify(url, token=token)
        if identity.size is None or identity.name is None:
            raise RemoteProtocolError(f"expected the length and the version of {url}, got neither")
        self.name = _name(url, token) or url.rstrip("/").rpartition("/")[2].removesuffix(".lode")
        self.size = identity.size
        self.tag = identity.name
        self.url, self._token, self._identity = url, token, identity
        self._lock = threading.Lock()
        self._open = ExitStack()
        self._client = self._open.enter_context(httpx.Client(**calls.client_options(url, calls.TIMEOUT)))

    def close(self) -> None:
        """Close the connection."""
        self._open.close()

    def read(self, offset: int, length: int) -> bytes:
        """Return at most ``length`` bytes from ``offset`` on.

        Raises
        ------
        LodestreamError
            If the server cannot be reached, refuses, sends other bytes than were asked for, or has another container
            there than before.
        """
        wanted = min(length, _AT_ONCE, self.size - offset)
        with self._lock:
            call = api.fetch_range(self.url, offset, wanted, self._identity)
            return sync.run(self._client, call, self.url, self._token)


def _name(url: str, token: str | None) -> str | None:
    """Return the name that a server has for a surface."""
    from ..requests import addresses

    if not addresses.is_surface(url):
        return None
    name = sync.describe(url, token=token).details.get("name")
    return name if isinstance(name, str) else None
