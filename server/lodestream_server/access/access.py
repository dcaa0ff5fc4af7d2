"""Access control: tokens, and the exception for callers on the same machine.

Without a token a caller may read if `Settings.public_reads` is set. It may do everything if nobody else can be calling:
the socket and the Host header belong to this machine, no header shows a proxy, and no page of another site is asking.
This exception ends as soon as there is a token, or a proxy in the settings, because a proxy on this machine looks like
a caller on this machine.
"""

from __future__ import annotations

import ipaddress
import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass, replace

from fastapi.requests import HTTPConnection

from lodestream.errors import LodestreamError

from ..operation.settings import Settings
from ..problems import BadTokenError, ForeignOriginError, NoTokenError, SmallScopeError
from .tokens import Tokens, tokens_of

__all__ = ["Access", "Caller", "anybody", "is_loopback", "key_of"]

# What the key of somebody without a token begins with.
_ADDRESS = "address "

# Origins that the page of any site can have: one in a frame of a certain kind is called null.
_ANY_SITE = {"*", "null"}


_AUTHORITY = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([^\s:/@\[\]]+))(?::(\d{1,5}))?", re.ASCII)
_DEFAULT_PORTS = {"http": "80", "https": "443"}


@dataclass(frozen=True)
class Caller:
    """The caller of a request.

    Attributes
    ----------
    key : str
        What limits for one client are counted by: a token, or an address (for IPv6 its /64 network).
    name : str
        Name for the log.
    owner : str or None
        Name of the token, which owns what is uploaded with it.
    admin : bool
        Whether the caller may do what the scope ``admin`` allows.
    token : str or None
        Hash of the token.
    """

    key: str
    name: str
    owner: str | None = None
    admin: bool = False
    token: str | None = None

    def may_change(self, owner: str | None) -> bool:
        """Return whether this caller may delete or retry a surface of this owner: its owner and an admin may."""
        return self.admin or (owner is not None and owner == self.owner)


class Access:
    """Decides what the settings and tokens of a server allow.

    Parameters
    ----------
    settings : Settings

    Attributes
    ----------
    look : callable
        See `TokenList.look`; it waits for the store.

    Raises
    ------
    LodestreamError, OSError
        If the token file cannot be used; or if there is no token, and others can reach the address without
        ``insecure``, or pages of any site would be allowed.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        tokens = tokens_of(settings)
        self._tokens = Tokens(tokens)
        self.look = tokens.look
        if not (settings.insecure or self._tokens.used or is_loopback(settings.host)):
            raise LodestreamError(
                f"expected a token in {tokens.place}, since others can reach {settings.host}, got none; create one "
                f"with `{_creation(settings)}`, or allow everything to everybody with --insecure"
            )

        anywhere = _ANY_SITE & set(settings.origins)
        if anywhere and not self._tokens.used:
            raise LodestreamError(
                f"expected a token in {tokens.place}, since LODESTREAM_ORIGINS={min(anywhere)} allows the pages of "
                f"all sites, got none; create one with `{_creation(settings)}`, or name the sites"
            )

    @property
    def alone(self) -> bool:
        """Whether only programs on this machine can write, so that there is nobody to share limits with."""
        return not (self._tokens.used or self._settings.insecure)

    def check_origin(self, connection: HTTPConnection) -> None:
        """Refuse requests of pages of other sites.

        Raises
        ------
        ForeignOriginError
            If there is an Origin header that is neither the server's own nor one of the settings.
        """
        for origin in connection.headers.getlist("origin"):
            named = self._settings.origins
            if origin not in named and "*" not in named and not _is_own(origin, connection):
                raise ForeignOriginError(
                    f"Pages of {origin[:80]!a} may not use this server; its setting origins says whose may"
                )

    def authorize(self, connection: HTTPConnection, scope: str) -> Caller:
        """Return the caller, if it may do what the scope allows.

        Raises
        ------
        NoTokenError
            If a token is needed and there is none.
        BadTokenError, SmallScopeError
            If the token is not known, or does not allow it.
        """
        text = _bearer(connection)
        # A server without tokens cannot tell a good one from a bad one, and whoever sends one gets no more for it.
        if text is not None and self._tokens.used:
            return self._holder(text, scope)
        hindrance = self._hindrance(connection, scope)
        if hindrance is not None:
            raise NoTokenError(f"This needs a token (Authorization: Bearer ...): {hindrance}")
        return replace(anybody(connection), admin=self._hindrance(connection, "admin") is None)

    def reader(self, connection: HTTPConnection) -> Caller | None:
        """Return the caller that opens a stream; None if its ``open`` message must contain a token.

        Raises
        ------
        BadTokenError, SmallScopeError
            If there is a token that is not known, or does not allow it.
        """
        try:
            return self.authorize(connection, "read")
        except NoTokenError:
            return None

    def reader_with(self, text: str | None) -> Caller:
        """Return the caller with the token of an ``open`` message, if reading needs one.

        Raises
        ------
        NoTokenError, BadTokenError, SmallScopeError
            If there is no token, it is not known, or it does not allow reading.
        """
        if text is None or not self._tokens.used:
            raise NoTokenError(
                "No token came with the handshake or the first message, and this server needs one for the scope read"
            )
        return self._holder(text, "read")

    def check(self, caller: Caller) -> None:
        """Check that a caller that was admitted earlier still has access.

        Raises
        ------
        BadTokenError
            If its token was revoked or has expired.
        """
        if caller.token is not None and self._tokens.known(caller.token) is None:
            raise BadTokenError("The token was revoked or has expired")

    def _holder(self, text: str, scope: str) -> Caller:
        token = self._tokens.find(text)
        if token is None:
            raise BadTokenError("The token is unknown, expired or revoked")
        if not token.allows(scope):
            raise SmallScopeError(f"This needs a token with the scope {scope}; this one has {', '.join(token.scopes)}")
        return Caller(key_of(token.name), token.name, token.name, token.allows("admin"), token.sha256)

    def _hindrance(self, connection: HTTPConnection, scope: str) -> str | None:
        # Why somebody without a token may not do this; None when they may.
        if scope == "read" and self._settings.public_reads:
            return None
        if self._tokens.used:
            return f"this server needs one for the scope {scope}"
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
    """Return the key of callers with a token of this name, or of all callers without a token."""
    return "nobody" if owner is None else f"token {owner}"


def is_loopback(host: str) -> bool:
    """Return whether a name or address can only be this machine."""
    if host.lower() == "localhost":
        return True
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return (mapped or address).is_loopback


def _creation(settings: Settings) -> str:
    """Return the command that makes a token for this server."""
    place = ("--token-file", settings.token_file) if settings.token_file else ("--data", settings.data)
    return f"lodestream token create NAME --scope write {shlex.join(map(str, place))}"


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
    """Return a caller without a token, known by its address."""
    host = connection.client.host if connection.client is not None else "unknown"
    return Caller(f"{_ADDRESS}{_network_of(host)}", host[:80])


def _network_of(host: str) -> str:
    """Return the network of a household or machine: the address, of IPv6 its /64 network."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host[:80]
    return str(ipaddress.ip_network((address, 64), strict=False) if address.version == 6 else address)
