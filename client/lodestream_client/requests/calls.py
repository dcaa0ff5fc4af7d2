"""Requests over HTTP as values, and the arguments with which httpx makes them."""

from __future__ import annotations

import functools
import ssl
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from . import addresses
from .answers import LONGEST_ANSWER, Answer
from .bodies import Body

if TYPE_CHECKING:
    import httpx

__all__ = ["TIMEOUT", "Aside", "Call", "Flow", "Pause", "client_options", "request_options"]

T = TypeVar("T")

#: Seconds for each step of a request: connecting, one chunk sent, one chunk received.
TIMEOUT = 30.0

# Seconds that a connection stays open for the next request: less than a server allows (uvicorn: 5), or a request meets
# its end.
_KEPT = 4.0


@dataclass(frozen=True)
class Call:
    """A request to make; the complete answer is sent back.

    With ``partial``, an answer that is a whole file is sent back without being read. Of other answers at most `most`
    bytes are read. Redirects are followed if `redirected` says so, and never where the request changes something. What
    is sent is `body`, or `json`.
    """

    method: str
    url: str
    parameters: Mapping[str, str | list[str]] = field(default_factory=dict)
    headers: Mapping[str, str] = field(default_factory=dict)
    body: Body | None = None
    json: Mapping[str, str | None] | None = None
    partial: bool = False
    most: int = LONGEST_ANSWER
    redirected: bool = True


@dataclass(frozen=True)
class Pause:
    """A wait of so many seconds."""

    seconds: float


@dataclass(frozen=True)
class Aside:
    """Work that takes long, such as reading a file, to be done where nobody else waits for it."""

    work: Callable[[], None]


Flow: TypeAlias = Generator[Call | Pause | Aside, Answer | None, T]


def client_options(url: str, *, direct: bool) -> dict[str, Any]:
    """Return the arguments of the asyncio client of httpx.

    Parameters
    ----------
    url : str
        URL of the server to which a token may be sent.
    direct : bool
        Whether the proxies of the environment are not used.
    """

    async def guard(request: httpx.Request) -> None:
        # httpx itself lets a token go on from a host's port 80 to its port 443; here an origin is an origin.
        if not addresses.same_origin(str(request.url), url):
            request.headers.pop("Authorization", None)

    import httpx

    return {
        "follow_redirects": True,
        "timeout": TIMEOUT,
        "verify": _trusted(),
        "trust_env": not direct,
        "headers": {"Accept-Encoding": "identity"},
        "event_hooks": {"request": [guard]},
        "limits": httpx.Limits(max_connections=None, max_keepalive_connections=20, keepalive_expiry=_KEPT),
    }


@functools.cache
def _trusted() -> ssl.SSLContext:
    # Reading all the certificates takes longer than many a request.
    import httpx

    return httpx.create_ssl_context()


def request_options(call: Call, url: str, token: str | None) -> dict[str, Any]:
    """Return the arguments of the ``request`` method of an httpx client, except the body of a single file.

    The token is sent only to the server at `url`, wherever redirects lead.
    """
    headers = dict(call.headers)
    if token is not None and addresses.same_origin(call.url, url):
        headers["Authorization"] = f"Bearer {token}"
    options: dict[str, Any] = {"method": call.method, "url": call.url, "headers": headers}
    if not call.redirected or call.method not in ("GET", "HEAD"):
        options["follow_redirects"] = False  # nothing is changed, and no file sent, where nobody said so
    if call.parameters:
        options["params"] = dict(call.parameters)
    if call.json is not None:
        options["json"] = dict(call.json)
    if call.body is not None and len(call.body.files) > 1:
        options["files"] = call.body.form()
    elif call.body is not None:
        headers["Content-Length"] = str(call.body.left)
        headers.setdefault("Content-Type", "application/octet-stream")
    return options
