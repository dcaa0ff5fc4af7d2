"""Conversion of server answers and socket errors to the exceptions of Lodestream."""

from __future__ import annotations

import os
import ssl
from collections.abc import Mapping
from typing import Any, TypeVar

from lodestream.errors import (
    FormatError,
    InputError,
    LodestreamError,
    NotFoundError,
    OptionError,
    RemoteError,
    RemoteProtocolError,
    TooLargeError,
    TruncatedStreamError,
)
from lodestream.protocol.messages import CODES

from ..errors import SilenceError, UnreachableError
from . import addresses
from .answers import parse

__all__ = ["NoStreamError", "blocks_sockets", "from_code", "from_connection", "from_response", "is_ours", "passes"]

_E = TypeVar("_E", bound=BaseException)

_LONGEST = 1000

# What a connection says of itself while it waits, whatever ends that wait.
_WAITING = (ssl.SSLWantReadError, ssl.SSLWantWriteError)

# The server's words, over HTTP and in the stream alike; then statuses, for what other servers and proxies answer.
_BY_CODE: Mapping[str, type[LodestreamError]] = {
    "bad-file": FormatError,
    "bad-input": InputError,
    "bad-option": OptionError,
    "bad-target": OptionError,
    "not-found": NotFoundError,
    "too-large": TooLargeError,
}
_BY_STATUS: Mapping[int, type[LodestreamError]] = {
    400: InputError,
    404: NotFoundError,
    413: TooLargeError,
    415: InputError,
    422: InputError,
}


# What a server says when it may be otherwise a little later.
_PASSING = {"restarting", "idle", "busy", "too-many", "internal"}
_PASSING |= {f"http-{status}" for status in (408, 425, 429, 500, 502, 503, 504)}


# What is answered to the handshake of a WebSocket that has lost its Upgrade, or the subprotocol, on its way.
_NO_HANDSHAKE = {400, 404, 405, 426}


class NoStreamError(RemoteProtocolError):
    """A WebSocket was opened, but it does not speak the stream protocol."""


def from_code(code: str, message: str) -> LodestreamError:
    """Return the exception for an error code of the server."""
    kind = _BY_CODE.get(code)
    return RemoteError(code, message) if kind is None else kind(message)


def from_response(status: int, reason: str, body: bytes, url: str) -> LodestreamError:
    """Return the exception for an HTTP answer.

    Parameters
    ----------
    status, reason : int, str
        The status line.
    body : bytes
        A problem document (RFC 9457), whose ``detail`` becomes the message, or anything else.
    url : str
        The URL of the request; named if the answer does not explain itself.
    """
    document = _document(body)
    detail = document.get("detail") or document.get("title")
    code = document.get("code")
    message = f"the server answered {status} {reason} for {url}"
    if detail:
        message = (str(detail) if isinstance(code, str) else f"{message}: {detail}")[:_LONGEST]
    if isinstance(code, str):
        return from_code(code, message)
    return _BY_STATUS[status](message) if status in _BY_STATUS else RemoteError(f"http-{status}", message)


def is_ours(body: bytes) -> bool:
    """Return whether the body of an answer is a problem document of a Lodestream server."""
    code = _document(body).get("code")
    return isinstance(code, str) and code in CODES


def passes(error: LodestreamError) -> bool:
    """Return whether the same request may succeed a little later."""
    if isinstance(error, RemoteError):
        return error.code in _PASSING
    from lodestream.transfer.range_download import CutShortError

    if isinstance(error, CutShortError):
        return False
    return isinstance(error, UnreachableError | SilenceError | TruncatedStreamError) or _broke_off(error)


def blocks_sockets(error: LodestreamError, *, met: bool) -> bool:
    """Return whether something on the way seems to block WebSockets only, so that plain HTTP may work.

    A connection that broke during its handshake counts as a sign of this only if no handshake has succeeded (`met`).
    """
    from websockets import exceptions as ws

    cause = error.__cause__
    if isinstance(cause, ws.InvalidStatus):
        # A server that is asked for a stream by a plain GET, since something between took the rest of the handshake
        # away, answers 426. What else it says in its own words it would say by the other transport too.
        return not is_ours(bytes(cause.response.body or b"")) or cause.response.status_code in _NO_HANDSHAKE
    if _broke_off(error):
        return not met
    return isinstance(error, NoStreamError) or isinstance(cause, ws.InvalidHandshake | ws.InvalidURI)


def _broke_off(error: BaseException) -> bool:
    """Return whether a connection ended in the middle of an answer."""
    import httpx

    cause = error.__cause__
    while cause is not None:
        if isinstance(cause, EOFError | ConnectionError | httpx.RemoteProtocolError | httpx.NetworkError):
            return True
        cause = cause.__cause__
    return False


def _document(body: bytes) -> Mapping[str, Any]:
    try:
        return parse(body)
    except ValueError:  # also what is not UTF-8
        return {}


def from_connection(error: Exception, url: str) -> LodestreamError:
    """Return the exception for a failed connection of websockets or httpx; `url` is that of the surface or server."""
    import httpx
    from websockets import exceptions as ws

    if isinstance(error, LodestreamError):
        return error
    if isinstance(error, ws.InvalidStatus):
        response = error.response
        return from_response(response.status_code, response.reason_phrase, bytes(response.body or b""), url)
    if isinstance(error, ws.InvalidURI):  # ours is one
        use = addresses.counterpart(url, addresses.stream_url(url), error.uri)
        return RemoteProtocolError(f"{url} redirects its stream to an address that is not a WebSocket's; use {use}")
    if isinstance(error, (ws.InvalidHandshake, httpx.RemoteProtocolError, httpx.DecodingError)):
        return RemoteProtocolError(f"{url} does not answer like a Lodestream server: {error}")
    if untrusted := _first(error, ssl.SSLCertVerificationError):
        return UnreachableError(
            f"no secure connection to {url}: its certificate is not trusted here ({untrusted.verify_message}); the "
            "environment variable SSL_CERT_FILE names a file with all authorities that are, in place of the usual ones"
        )
    if insecure := _first(error, ssl.SSLError):
        return UnreachableError(f"no secure connection to {url}: {insecure.strerror or insecure}")
    if isinstance(error, TimeoutError | httpx.TimeoutException):
        return UnreachableError(f"no answer from {url} in time")
    return UnreachableError(f"no connection to {url}: {_reason(error)}")


def _first(error: BaseException, kind: type[_E]) -> _E | None:
    """Return the first error of a kind among an error and its causes: httpx has its own around those of the system."""
    cause: BaseException | None = error
    while cause is not None and (not isinstance(cause, kind) or isinstance(cause, _WAITING)):
        cause = cause.__cause__ or cause.__context__
    return cause


def _reason(error: BaseException) -> str:
    """Return the system's words for a failed connection, such as connection refused, in place of a library's."""
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno is not None:
            words = os.strerror(cause.errno) if cause.errno > 0 else cause.strerror or str(cause)
            return f"{words[:1].lower()}{words[1:]}"
        cause = cause.__cause__ or cause.__context__
    return str(error) or type(error).__name__
