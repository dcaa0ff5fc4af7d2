"""From what a server or a socket reports to the errors of Lodestream."""

from __future__ import annotations

import json
import ssl
from collections.abc import Mapping
from typing import Any

from lodestream.errors import (
    FormatError,
    InputError,
    LodestreamError,
    NotFoundError,
    OptionError,
    RemoteError,
    RemoteProtocolError,
    TooLargeError,
)

from .errors import UnreachableError

__all__ = ["from_code", "from_connection", "from_response"]

_LONGEST = 1000

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


def from_code(code: str, message: str) -> LodestreamError:
    """The error that a code of the server stands for."""
    kind = _BY_CODE.get(code)
    return RemoteError(code, message) if kind is None else kind(message)


def from_response(status: int, reason: str, body: bytes, url: str) -> LodestreamError:
    """The error that an HTTP answer stands for.

    Parameters
    ----------
    status, reason : int, str
        First line of the answer.
    body : bytes
        A problem document (RFC 9457), whose ``detail`` becomes the message, or anything else.
    url : str
        What was asked for; named where the answer does not explain itself.
    """
    document = _document(body)
    detail = document.get("detail") or document.get("title")
    message = str(detail)[:_LONGEST] if detail else f"the server answered {status} {reason} for {url}"
    code = document.get("code")
    if isinstance(code, str):
        return from_code(code, message)
    return _BY_STATUS[status](message) if status in _BY_STATUS else RemoteError(f"http-{status}", message)


def _document(body: bytes) -> Mapping[str, Any]:
    try:
        document = json.loads(body)
    except ValueError:  # also what is not UTF-8
        return {}
    return document if isinstance(document, dict) else {}


def from_connection(error: Exception, url: str) -> LodestreamError:
    """The error that a failed connection of websockets or httpx stands for; `url` is the surface's or server's."""
    import httpx
    from websockets import exceptions as ws

    if isinstance(error, LodestreamError):
        return error
    if isinstance(error, ws.InvalidStatus):
        response = error.response
        return from_response(response.status_code, response.reason_phrase, bytes(response.body or b""), url)
    if isinstance(error, (ws.InvalidHandshake, httpx.RemoteProtocolError, httpx.DecodingError)):
        return RemoteProtocolError(f"{url} does not answer like a Lodestream server: {error}")
    if isinstance(error, (ssl.SSLError, ssl.CertificateError)):
        return UnreachableError(f"no secure connection to {url}: {error}")
    if isinstance(error, TimeoutError | httpx.TimeoutException):
        return UnreachableError(f"no answer from {url} in time")
    return UnreachableError(f"no connection to {url}: {error or type(error).__name__}")
