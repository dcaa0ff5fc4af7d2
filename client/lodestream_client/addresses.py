"""Addresses of servers and surfaces, and what is asked at them."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit, urlunsplit

from lodestream.errors import OptionError

__all__ = ["is_loopback", "is_url", "stream_url", "surface_url", "surfaces_url"]

_SURFACES = "/v1/surfaces"


def is_url(text: str) -> bool:
    """Whether this is the address of something on a server, not a file's name."""
    return text.lower().startswith(("http://", "https://"))


def surfaces_url(url: str) -> str:
    """The collection of surfaces of a server, from the server's address or from the collection's.

    Raises
    ------
    OptionError
        When this is not an ``http`` or ``https`` address.
    """
    base = _clean(url)
    return base if base.endswith(_SURFACES) else base + _SURFACES


def surface_url(url: str) -> str:
    """The address of one surface, without a slash at its end.

    Raises
    ------
    OptionError
        When this is not ``http(s)://HOST/v1/surfaces/ID``.
    """
    base = _clean(url)
    collection, _, name = base.rpartition("/")
    if not collection.endswith(_SURFACES) or not name:
        raise OptionError(f"expected a surface's address such as http://HOST/v1/surfaces/ID, got {url}")
    return base


def stream_url(url: str) -> str:
    """Where the stream of the surface at this address is."""
    return "ws" + surface_url(url).removeprefix("http") + "/stream"


def is_loopback(url: str) -> bool:
    """Whether the address is on this machine, where no proxy of the environment may come between."""
    host = urlsplit(url).hostname or ""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _clean(url: str) -> str:
    try:
        parts = urlsplit(url)
        parts.port  # noqa: B018  (reading it is what checks the number)
    except ValueError as error:
        raise OptionError(f"expected an address such as http://HOST:PORT, got {url}: {error}") from None
    if parts.scheme.lower() not in ("http", "https") or not parts.hostname:
        raise OptionError(f"expected an address that begins with http:// or https://, got {url}")
    return urlunsplit((parts.scheme.lower(), parts.netloc, parts.path.rstrip("/"), "", ""))
