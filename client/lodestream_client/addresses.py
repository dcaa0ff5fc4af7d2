"""Addresses of servers, surfaces and container files, and what is asked at them."""

from __future__ import annotations

import ipaddress
from urllib.parse import urlsplit, urlunsplit

from lodestream.errors import OptionError

__all__ = [
    "container_url",
    "is_loopback",
    "is_surface",
    "is_url",
    "same_origin",
    "source_url",
    "stream_url",
    "surface_url",
    "surfaces_url",
]

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


def source_url(url: str) -> str:
    """The address of what can be pulled: a surface on a server, or a container file that any web server holds.

    Raises
    ------
    OptionError
        When this is neither.
    """
    base = _clean(url)
    path = urlsplit(base).path
    if not path or path.endswith(_SURFACES):
        raise OptionError(
            f"expected a surface's address such as http://HOST/v1/surfaces/ID, or a container's such as "
            f"http://HOST/NAME.lode, got {url}"
        )
    # The query may be what allows reading a file.
    return base if is_surface(base) else urlunsplit(urlsplit(url)._replace(fragment=""))


def is_surface(url: str) -> bool:
    """Whether this is a surface's address, not that of a file."""
    return _clean(url).rpartition("/")[0].endswith(_SURFACES)


def stream_url(url: str, query: str | None = None) -> str:
    """Where the stream of the surface at this address is."""
    address = "ws" + surface_url(url).removeprefix("http") + "/stream"
    return address if query is None else f"{address}?{query}"


def container_url(url: str) -> str:
    """Where the container of a surface, or at a file's own address, can be fetched."""
    return f"{surface_url(url)}/container" if is_surface(url) else url


def same_origin(one: str, other: str) -> bool:
    """Whether two addresses are of one server."""
    return urlsplit(one)[:2] == urlsplit(other)[:2]


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
