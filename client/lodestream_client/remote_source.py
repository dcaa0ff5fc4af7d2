"""Containers at a URL, for `lodestream.open`, which finds this by its entry points ``http`` and ``https``."""

from __future__ import annotations

import threading
from typing import Any

from lodestream.errors import RemoteProtocolError
from lodestream.opening.byte_sources import AT_ONCE

from .client import Client
from .requests import addresses

__all__ = ["RemoteSource"]


class RemoteSource:
    """A container on a server, or on any host of files with Range; the token stays here.

    Parameters
    ----------
    url : str
        Of a surface of a server, of a container file, or of a name on a server or a published page.
    token : str or None, optional

    Attributes
    ----------
    place : str
        The URL of the surface or the container itself, whatever a name leads to by then.

    Raises
    ------
    LodestreamError
        If the server cannot be reached, refuses, or does not say how long the file is.
    """

    def __init__(self, url: str, token: str | None = None) -> None:
        self._client = Client(url, token=token)
        url = self._client.locate(addresses.source_url(url))
        identity = self._client.identify(url)
        if identity.size is None or identity.name is None:
            raise RemoteProtocolError(f"expected the length and the version of {url}, got neither")
        self.name = self._told_name(url) or url.rstrip("/").rpartition("/")[2].removesuffix(".lode")
        self.size = identity.size
        self.tag = identity.name
        self.gap = 1 << 14
        self.place, self._token, self._identity = url, token, identity
        self._lock = threading.Lock()

    def __reduce__(self) -> tuple[Any, ...]:
        return RemoteSource, (self.place, self._token)

    def close(self) -> None:
        """Close the connection."""
        self._client.close()

    def read(self, offset: int, length: int) -> bytes:
        """Return at most ``length`` bytes from ``offset`` on.

        Raises
        ------
        LodestreamError
            If the server cannot be reached, refuses, sends other bytes than were asked for, or has another container
            there than before.
        """
        wanted = min(length, AT_ONCE, self.size - offset)
        with self._lock:  # one at a time, as some servers want it
            return self._client.fetch_range(self.place, offset, wanted, identity=self._identity)

    def _told_name(self, url: str) -> str | None:
        """Return the name that a server has for a surface."""
        if not addresses.is_surface(url):
            return None
        name = self._client.get(url).details.get("name")
        return name if isinstance(name, str) else None
