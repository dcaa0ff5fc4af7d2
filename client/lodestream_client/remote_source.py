"""Containers at a URL, for `lodestream.open`, which finds this by its entry points ``http`` and ``https``."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from typing import Any

from lodestream.errors import RemoteProtocolError
from lodestream.opening.byte_sources import AT_ONCE

from . import sync
from .requests import addresses, api, calls

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
        import httpx

        url = sync.locate(url, token=token)
        identity = sync.identify(url, token=token)
        if identity.size is None or identity.name is None:
            raise RemoteProtocolError(f"expected the length and the version of {url}, got neither")
        self.name = _name(url, token) or url.rstrip("/").rpartition("/")[2].removesuffix(".lode")
        self.size = identity.size
        self.tag = identity.name
        self.gap = 1 << 14
        self.place, self._token, self._identity = url, token, identity
        self._lock = threading.Lock()
        self._open = ExitStack()
        self._client = self._open.enter_context(httpx.Client(**calls.client_options(url, calls.TIMEOUT)))

    def __reduce__(self) -> tuple[Any, ...]:
        return RemoteSource, (self.place, self._token)

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
        wanted = min(length, AT_ONCE, self.size - offset)
        with self._lock:
            call = api.fetch_range(self.place, offset, wanted, self._identity)
            return sync.run(self._client, call, self.place, self._token)


def _name(url: str, token: str | None) -> str | None:
    """Return the name that a server has for a surface."""
    if not addresses.is_surface(url):
        return None
    name = sync.describe(url, token=token).details.get("name")
    return name if isinstance(name, str) else None
