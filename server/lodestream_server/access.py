"""Who may do what: tokens, and whoever sits at this very machine.

Without a token one may read where `Settings.public_reads` says so, and do anything where nobody else can be asking:
the socket and the Host are this machine's, nothing says that a proxy is in between, and no page of another site asks.
That ends as soon as there is a token, or a proxy that the operator knows of: a proxy on this machine looks like
somebody who sits at it.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

from fastapi.requests import HTTPConnection

from lodestream.errors import LodestreamError

from .problems import BadTokenError, ForeignOriginError, NoTokenError, SmallScopeError
from .settings import Settings
from .tokens import Tokens

__all__ = ["Access", "Caller", "anybody", "is_loopback", "key_of"]

# What the key of somebody without a token begins with.
_ADDRESS = "address "

# Origins that the page of any site can have: one in a frame of a certain kind is called null.
_ANY_SITE = {"*", "null"}


_AUTHORITY = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([^\s:/@\[\]]+))(?::(\d{1,5}))?", re.ASCII)
_DEFAULT_PORTS = {"http": "80", "https": "443"}


@dataclass(frozen=True)
class Caller:
    """Who asks.

    Attributes
    ----------
    key : str
        What limits for one client count by: a token, or an address (of IPv6 the network).
    name : str
        What stands in the log.
    owner : str or None
        Name of the token, to which belongs what is uploaded with it.
    admin : bool
        May do what the scope ``admin`` allows.
    token : str or None
        Hash of the token.
    """

    key: str
    name: str
    owner: str | None = None
    admin: bool = False
    token: str | None = None

    def may_delete(self, owner: str | None) -> bool:
        """Whether a surface of this owner may be removed: by its owner and by an admin."""
        return self.admin or (owner is not None and owner == self.owner)


class Access:
    """What the server's settings and tokens allow.

    Parameters
    ----------
    settings : Settings

    Raises
    ------
    LodestreamError, OSError
        When the token file cannot be used; when there is no token, and the address can be reached by others without
        ``insecure``, or pages of any site would be let in.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._tokens = Tokens(settings.tokens)
        if not (settings.insecure or self._tokens.used or is_loopback(settings.host)):
            raise LodestreamError(
                f"expected a token, since others can reach {settings.host}, and there is none in {settings.tokens}: "
                "make one with `lodestream token create`, or serve everything to everybody with --insecure"
            )

        anywhere = _ANY_SITE & set(settings.origins)
        if anywhere and not self._tokens.used:
            raise LodestreamError(
                f"expected a token, since LODESTREAM_ORIGINS={min(anywhere)} lets the pages of all sites in, and there "
                f"is none in {settings.tokens}: make one with `lodestream token create`, or name the sites"
            )

    @property
    def alone(self) -> bool:
        """Whether only somebody who sits at this machine can write, so that there is nobody to share with."""
        return not (self._tokens.used or self._settings.insecure)

    def check_origin(self, connection: HTTPConnection) -> None:
        """Refuse what the page of another site asks.

        Raises
        ------
        ForeignOriginError
            When there is an Origin, and it is neither our own nor one that the settings name.
        """
        for origin in connection.headers.getlist("origin"):
            named = self._settings.origins
            if origin not in named and "*" not in named and not _is_own(origin, connection):
                raise ForeignOriginError(
                    f"expected a page of this server or of its origins to ask, got {origin[:80]!a}"
                )

    def authorize(self, connection: HTTPConnection, scope: str) -> Caller:
        """Who asks, once they may do what the scope allows.

        Raises
        ------
        NoTokenError
            When a token is needed and none came.
        BadTokenError, SmallScopeError
            When the token is not known, or does not allow it.
        """
        text = _bearer(connection)
        # A server without tokens cannot tell a good one from a bad one, and whoever sends one gets no more for it.
        if text is not None and self._tokens.used:
            return self._holder(text, scope)
        hindrance = self._hindrance(connection, scope)
        if hindrance is not None:
            raise NoTokenError(f"expected a token (Authorization: Bearer ...), got none, and {hindrance}")
        return replace(anybody(connection), admin=self._hindrance(connection, "admin") is None)

    def reader(self, connection: HTTPConnection) -> Caller | None:
        """Who opens a stream; None when their ``open`` has to hold a token.

        Raises
        ------
        BadTokenError, SmallScopeError
            When there is a token that is not known, or does not allow it.
        """
        try:
            return self.authorize(connection, "read")
        except NoTokenError:
            return None

    def reader_with(self, text: str | None) -> Caller:
        """Who shows a token in ``open``, where reading needs one.

        Raises
        ------
        NoTokenError, BadTokenError, SmallScopeError
            When there is none, or it is not known, or does not allow to read.
        """
        if text is None or not self._tokens.used:
            raise NoTokenError("expected a token with the handshake or in open as the first message, got neither")
        return self._holder(text, "read")

    def check(self, caller: Caller) -> None:
        """Look whether somebody who was let in earlier still may be here.

        Raises
        ------
        BadTokenError
            When their token was revoked or has expired.
        """
        if caller.token is not None and self._tokens.known(caller.token) is None:
            raise BadTokenError("expected a token that is still valid, got one that was revoked or has expired")

    def _holder(self, text: str, scope: str) -> Caller:
        token = self._tokens.find(text)
        if token is None:
            raise BadTokenError("expected a token that this server knows, got one that it does not, or no longer")
        if not token.allows(scope):
            raise SmallScopeError(f"expected a token that allows to {scope}, got one for {', '.join(token.scopes)}")
        return Caller(key_of(token.name), token.name, token.name, token.allows("admin"), token.sha256)

    def _hindrance(self, connection: HTTPConnection, scope: str) -> str | None:
        # Why somebody without a token may not do this; None when they may.
        if scope == "read" and self._settings.public_reads:
            return None
        if self._tokens.used:
            return f"this server wants one from whoever wants to {scope}"
        if self._settings.insecure:
            return None
        return next(_signs_of_others(connection, self._settings), None)


def _signs_of_others(connection: HTTPConnection, settings: Settings) -> Iterator[str]:
    if settings.trusted_proxies:
        yield "this server has a proxy in front"
    if connection.client is None or not is_loopback(connection.client.host):
        yield "the connection does not come from this machine"
    hosts = connection.headers.getlist("host")
    parts = _AUTHORITY.fullmatch(hosts[0]) if len(hosts) == 1 else None
    if parts is None or not is_loopback(parts[1] or parts[2]):
        yield f"the Host is not this machine: {', '.join(hosts)[:80]!a}"
    for name in connection.headers:
        if name in ("forwarded", "via", "x-real-ip") or name.startswith("x-forwarded-"):
            yield f"the header {name} says that a proxy is in between"


def key_of(owner: str | None) -> str:
    """The key of whoever has a token of this name; one for all those who have none, where nothing else is known."""
    return "nobody" if owner is None else f"token {owner}"


def is_loopback(host: str) -> bool:
    """Whether a name or address can only be this machine."""
    if host.lower() == "localhost":
        return True
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return (mapped or address).is_loopback


def _is_own(origin: str, connection: HTTPConnection) -> bool:
    # The scheme is not compared: behind a proxy that ends TLS we see another one than the browser.
    scheme, _, rest = origin.partition("://")
    theirs, ours = _AUTHORITY.fullmatch(rest), _AUTHORITY.fullmatch(connection.headers.get("host", ""))
    if scheme not in _DEFAULT_PORTS or theirs is None or ours is None:
        return False
    default = _DEFAULT_PORTS[scheme]
    return _name(theirs, default) == _name(ours, default)


def _name(parts: re.Match[str], default_port: str) -> tuple[str, str]:
    return (parts[1] or parts[2]).lower(), parts[3] or default_port


def _bearer(connection: HTTPConnection) -> str | None:
    # Another scheme may be meant for a proxy in front.
    scheme, _, text = connection.headers.get("authorization", "").partition(" ")
    return text.strip() if scheme.lower() == "bearer" else None


def anybody(connection: HTTPConnection) -> Caller:
    """Whoever asks without a token: an address."""
    host = connection.client.host if connection.client is not None else "unknown"
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return Caller(f"{_ADDRESS}{host[:80]}", host[:80])
    # One household or machine has at least a /64.
    network = ipaddress.ip_network((address, 64), strict=False) if address.version == 6 else address
    return Caller(f"{_ADDRESS}{network}", host)
