"""Addresses of servers, surfaces and container files, and what is asked at them."""

from __future__ import annotations

import ipaddress
import re
from urllib.parse import urljoin, urlsplit, urlunsplit

from lodestream.errors import OptionError, RemoteProtocolError

__all__ = [
    "container_url",
    "counterpart",
    "is_loopback",
    "is_surface",
    "is_url",
    "origin",
    "resolved",
    "same_origin",
    "source_url",
    "stream_url",
    "surface_url",
    "surfaces_url",
]

_SURFACES = "/v1/surfaces"

_SCHEMES = {"http": "http", "https": "https", "ws": "http", "wss": "https"}
_PORTS = {"http": 80, "https": 443}

_ADDRESS = re.compile("https?://[!-~]+", re.IGNORECASE)


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


def origin(url: str) -> str:
    """Scheme, host and port of an address: what a token given for it may be sent to, and nothing else.

    A WebSocket counts as the HTTP that it begins as. What is no such address has no origin: an empty text.
    """
    try:
        parts = urlsplit(url)
        scheme = _SCHEMES.get(parts.scheme, "")
        port = parts.port or _PORTS.get(scheme, 0)
    except ValueError:
        return ""
    host = parts.hostname or ""
    if not scheme or not host:
        return ""
    host = f"[{host}]" if ":" in host else host
    return f"{scheme}://{host}" if port == _PORTS[scheme] else f"{scheme}://{host}:{port}"


def same_origin(one: str, other: str) -> bool:
    """Whether two addresses are of one server: the same scheme, host and port."""
    return origin(one) == origin(other) != ""


def counterpart(given: str, asked: str, landed: str) -> str:
    """What to give instead of one address, where what was asked below it has led elsewhere.

    Parameters
    ----------
    given : str
        The address of a server, a surface or a file.
    asked : str
        What was asked for it: that address itself, or one that begins with it.
    landed : str
        Where a redirect led.
    """
    base, path, end = urlsplit(given).path.rstrip("/"), urlsplit(asked).path, urlsplit(landed).path
    below = path.removeprefix(base)
    return origin(landed) + (end.removesuffix(below) if path.startswith(base) and below else end)


def resolved(base: str, address: str) -> str:
    """An address that a server has told, seen from `base`.

    Raises
    ------
    RemoteProtocolError
        When it is no ``http`` or ``https`` address, written in characters that an address has.
    """
    try:
        found = urljoin(base, address)
    except ValueError:
        found = ""
    if not _ADDRESS.fullmatch(found) or not origin(found):
        raise RemoteProtocolError(f"expected an address from {base}, got {address!a:.200}")
    return found


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
