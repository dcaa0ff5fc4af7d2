"""URLs of servers, surfaces, names that lead to surfaces, and container files."""

from __future__ import annotations

import ipaddress
import re
import string
from urllib.parse import quote, unquote, urljoin, urlsplit, urlunsplit

from lodestream.errors import OptionError, RemoteProtocolError

__all__ = [
    "container_url",
    "counterpart",
    "formats_url",
    "is_loopback",
    "is_named",
    "is_served",
    "is_surface",
    "is_url",
    "made_url",
    "name_url",
    "names_url",
    "origin",
    "page_url",
    "place_url",
    "published_name",
    "resolved",
    "same_origin",
    "served_url",
    "server_url",
    "source_url",
    "stream_url",
    "surface_url",
    "surfaces_url",
    "uploads_url",
]

_SURFACES = "/v1/surfaces"
_NAMES = "/v1/names"
_UPLOADS = "/v1/uploads"
_BELOW = re.compile(f"({_SURFACES}|{_NAMES})(/.*)?$")
_SHOWN = re.compile(r"([sn])=([0-9A-Za-z._-]+)")
_ID = re.compile(r"[0-9A-Za-z_-]{1,100}")
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")

_SCHEMES = {"http": "http", "https": "https", "ws": "http", "wss": "https"}
_PORTS = {"http": 80, "https": 443}

_ADDRESS = re.compile("https?://[!-~]+", re.IGNORECASE)


def is_url(text: str) -> bool:
    """Return whether a text is a URL, not a file name."""
    return text.lower().startswith(("http://", "https://"))


def server_url(url: str) -> str:
    """Return the URL of a server, without a slash at its end, from its URL or from that of anything on it.

    Raises
    ------
    OptionError
        If this is not an ``http`` or ``https`` URL.
    """
    return _BELOW.sub("", _clean(url))


def surfaces_url(url: str) -> str:
    """Return the URL of a server's collection of surfaces, from the server's URL or from the collection's.

    Raises
    ------
    OptionError
        If this is not an ``http`` or ``https`` URL.
    """
    base = _clean(url)
    return base if base.endswith(_SURFACES) else base + _SURFACES


def formats_url(url: str) -> str:
    """Return the URL of the list of formats that a server reads, from the server's URL or from that of its surfaces."""
    return surfaces_url(url).removesuffix(_SURFACES) + "/v1/formats"


def surface_url(url: str) -> str:
    """Return the URL of one surface, without a slash at its end.

    Raises
    ------
    OptionError
        If this is not ``http(s)://HOST/v1/surfaces/ID``.
    """
    base = _clean(url)
    collection, _, name = base.rpartition("/")
    if not collection.endswith(_SURFACES) or not name:
        raise OptionError(f"expected a surface's address such as http://HOST/v1/surfaces/ID, got {url}")
    return base


def uploads_url(url: str) -> str:
    """Return the URL where a server begins uploads that can be resumed."""
    return surfaces_url(url).removesuffix(_SURFACES) + _UPLOADS


def place_url(url: str, place: str) -> str:
    """Return the URL of a surface on the server at `url`, given its id; a URL as it is.

    Raises
    ------
    OptionError
        If `place` is neither.
    """
    if not isinstance(place, str):
        raise OptionError(f"expected the id or the URL of a surface, which are texts, got {type(place).__name__}")
    if is_url(place):
        return place
    if not _ID.fullmatch(place):
        raise OptionError(
            f"expected the id of a surface, or an address such as http://HOST/v1/surfaces/ID, got {place}"
        )
    return f"{surfaces_url(url)}/{place}"


def names_url(url: str) -> str:
    """Return the URL of a server's collection of names, from the server's URL or from that of its surfaces."""
    return surfaces_url(url).removesuffix(_SURFACES) + _NAMES


def name_url(url: str, name: str) -> str:
    """Return the URL of a name that stays, on a server or on that of a collection of surfaces.

    Raises
    ------
    OptionError
        If it cannot be such a name.
    """
    if not _NAME.fullmatch(name):
        raise OptionError(
            "expected a name of at most 100 letters, digits and ._- that begins with a letter or a digit, "
            f"got {name[:100]!a}"
        )
    return f"{names_url(url)}/{name}"


def served_url(url: str) -> str:
    """Return the URL of a surface on a server, or of a name that leads to one, without a slash at its end.

    Raises
    ------
    OptionError
        If this is neither ``http(s)://HOST/v1/surfaces/ID`` nor ``http(s)://HOST/v1/names/NAME``.
    """
    return _clean(url) if is_served(url) else surface_url(url)


def page_url(url: str) -> str:
    """Return the address at which the page of a server shows a surface, or what a name there leads to.

    Raises
    ------
    OptionError
        If this is the URL of neither.
    """
    base, kind, name = served_url(url).rsplit("/", 2)
    return f"{base.removesuffix('/v1')}/#{'n' if kind == 'names' else 's'}={name}"


def source_url(url: str) -> str:
    """Return the URL of something that can be pulled.

    That is a surface on a server, a name there that leads to one, a container file on any web server, or a name on a
    published page: ``PAGE#NAME``.

    Raises
    ------
    OptionError
        If this is none of them.
    """
    base = _clean(url)
    if is_served(base):
        return base
    if published_name(url) is not None:
        return url
    shown = _SHOWN.match(urlsplit(url).fragment)
    if shown is not None:
        raise OptionError(
            f"expected the address of a surface, got that of the page that shows it: the surface's is "
            f"{base}{_NAMES if shown[1] == 'n' else _SURFACES}/{shown[2]}"
        )
    path = urlsplit(base).path
    if path.endswith((_SURFACES, _NAMES)):
        one, what = ("ID", "an id") if path.endswith(_SURFACES) else ("NAME", "a name")
        raise OptionError(f"expected {what} after {path}/, such as {base}/{one}, got none")
    if urlsplit(url).path.endswith(("/", ".html")):
        raise OptionError(
            f"expected a name after the page's address, such as {base}#NAME: lodestream published lists them"
        )
    if not path:
        raise OptionError(
            f"expected a surface's address such as http://HOST/v1/surfaces/ID, a container's such as "
            f"http://HOST/NAME.lode, or a published name's such as http://HOST/#NAME, got {url}"
        )
    # The query may be what allows reading a file.
    return urlunsplit(urlsplit(url)._replace(fragment=""))


def published_name(url: str) -> tuple[str, str] | None:
    """Return the URL of the list of a published page, and the name on it that ``PAGE#NAME`` asks for.

    None if the URL asks for no name. What has an equals sign tells how a surface is looked at, as does what the page
    adds to its address after ``&``; a name has ``%3D`` in its place.
    """
    page, _, fragment = url.partition("#")
    name = fragment.partition("&")[0]
    if not name or "=" in name or is_served(page):
        return None
    # What is not ASCII is as a browser sends it.
    return urljoin(quote(page.partition("?")[0], safe=string.punctuation), "view.json"), unquote(name)


def is_surface(url: str) -> bool:
    """Return whether a URL is that of a surface, not of a file."""
    return _clean(url).rpartition("/")[0].endswith(_SURFACES)


def is_served(url: str) -> bool:
    """Return whether a URL is that of a surface on a server, or of a name that leads to one."""
    return is_surface(url) or _leads(url)


def is_named(url: str) -> bool:
    """Return whether a URL leads to one surface now and perhaps to another one later: a name on a server or a page."""
    return _leads(url) or published_name(url) is not None


def _leads(url: str) -> bool:
    collection, _, name = _clean(url).rpartition("/")
    return collection.endswith(_NAMES) and bool(name)


def stream_url(url: str, query: str | None = None) -> str:
    """Return the WebSocket URL of a surface's stream."""
    address = "ws" + surface_url(url).removeprefix("http") + "/stream"
    return address if query is None else f"{address}?{query}"


def container_url(url: str) -> str:
    """Return the URL from which a container can be fetched, given the URL of its surface or of its file."""
    return f"{surface_url(url)}/container" if is_surface(url) else url


def origin(url: str) -> str:
    """Return scheme, host and port of a URL. A token is sent only to the origin for which it was given.

    A WebSocket URL counts as the HTTP URL of the same server. Any other text has the empty origin.
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


def same_origin(first: str, second: str) -> bool:
    """Return whether two URLs have the same scheme, host and port."""
    return origin(first) == origin(second) != ""


def counterpart(given: str, asked: str, landed: str) -> str:
    """Return the URL to use instead of `given`, if a request for `asked` was redirected to `landed`.

    Parameters
    ----------
    given : str
        The URL that the user gave: of a server, a surface or a file.
    asked : str
        The URL of the request: `given`, or one that begins with it.
    landed : str
        Where the redirect led.
    """
    base, path, end = urlsplit(given).path.rstrip("/"), urlsplit(asked).path, urlsplit(landed).path
    below = path.removeprefix(base)
    return origin(landed) + (end.removesuffix(below) if path.startswith(base) and below else end)


def resolved(base: str, address: str) -> str:
    """Return a URL from a server's answer, made absolute with `base`.

    Raises
    ------
    RemoteProtocolError
        If it is not an ``http`` or ``https`` URL in plain ASCII.
    """
    try:
        url = urljoin(base, address)
    except ValueError:
        url = ""
    if not _ADDRESS.fullmatch(url) or not origin(url):
        raise RemoteProtocolError(f"expected an address from {base}, got {address!a:.200}")
    return url


def made_url(collection: str, location: str) -> str:
    """Return the URL of what a server has made in one of its collections, from the Location of its answer.

    Raises
    ------
    RemoteProtocolError
        If that is no address, or one on this host without the path under which the server is reached.
    """
    url = resolved(collection, location)
    server = collection.rpartition("/v1/")[0]
    path = urlsplit(server).path
    # The user may have written it as it is read, and the server as it is sent.
    if same_origin(url, server) and not unquote(urlsplit(url).path).startswith(f"{unquote(path)}/"):
        raise RemoteProtocolError(
            f"{server} gives addresses without its path {path}, such as {url}: where a proxy removes the path from "
            f"requests, the server must be started with LODESTREAM_ROOT_PATH={path}"
        )
    return url


def is_loopback(url: str) -> bool:
    """Return whether a URL is on this machine, so that proxies from the environment are not used."""
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
        raise OptionError(f"expected an address that begins with http:// or https://, got {url!r}")
    return urlunsplit((parts.scheme.lower(), parts.netloc, parts.path.rstrip("/"), "", ""))
