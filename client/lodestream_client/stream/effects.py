"""Effects of a stream as values, which its core yields, and the results that it is given.

The core decides; `EffectIO` only carries out. Where an effect fails, the core is given the error as
the library raised it, and decides what it means.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias, TypeVar

__all__ = [
    "WAITS",
    "Ahead",
    "Dial",
    "DialError",
    "Dialled",
    "Effect",
    "Flow",
    "Get",
    "HangUp",
    "Hear",
    "Read",
    "Send",
    "Wait",
]

T = TypeVar("T")


@dataclass(frozen=True)
class Dial:
    """Open a WebSocket. Result: `Dialled`; fails with `DialError`.

    Attributes
    ----------
    url : str
        Its URL, ``ws`` or ``wss``.
    headers : mapping
        More headers for the handshake.
    seconds, close_seconds : float
        Time for the handshake, and later for closing.
    direct : bool
        Whether the proxies of the environment are not used.
    """

    url: str
    headers: Mapping[str, str] = field(repr=False)
    seconds: float
    close_seconds: float
    direct: bool


@dataclass(frozen=True)
class Dialled:
    """A WebSocket is open: the subprotocol agreed on, and the URL to which redirects led."""

    subprotocol: str | None
    url: str


class DialError(Exception):
    """A WebSocket could not be opened. The cause is the library's error.

    Attributes
    ----------
    url : str
        The URL to which redirects had led.
    """

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.url = url


@dataclass(frozen=True)
class Hear:
    """Wait for the next message of the WebSocket. Result: its bytes, or None if none came in time.

    Fails with ``ConnectionClosed``.

    Attributes
    ----------
    until : float
        Until when, by the session's clock: a wait that is interrupted and taken up again gets no longer by this.
    """

    until: float


@dataclass(frozen=True)
class Send:
    """Send what `Session.messages` returns, in this order. Result: None.

    The messages are not part of the effect, because `stop` and `focus` may add some from another thread, and their
    order counts. Nothing is sent, and it is no failure, where there is no open WebSocket: what the server said before
    it closed is still to be received, and tells more.
    """


@dataclass(frozen=True)
class Get:
    """Send a GET request, after closing what is open. Result: the `Head` of the answer.

    Fails with an ``httpx.HTTPError``. Redirects are followed; `seconds` is for each step, also of the body's.
    """

    url: str
    headers: Mapping[str, str] = field(repr=False)
    seconds: float

    def asks_as(self, other: Get) -> bool:
        """Return whether both request the same, whatever their timeouts are."""
        return (self.url, self.headers) == (other.url, other.headers)


@dataclass(frozen=True)
class Ahead:
    """Send the GET request that comes next, beside the answer that is open, without waiting for its answer.

    The next `Get`, of the same URL and headers, is given that answer. Result: None; if it fails, the `Get` does.
    """

    get: Get


@dataclass(frozen=True)
class Read:
    """Read the next chunk of the answer's body. Result: bytes, empty at the end. Fails with an ``httpx.HTTPError``."""


@dataclass(frozen=True)
class Wait:
    """Wait until this time by the session's clock, or until the stream is told to stop. Result: None."""

    until: float


@dataclass(frozen=True)
class HangUp:
    """Close the WebSocket or the answer that is open, if any. Result: None.

    Attributes
    ----------
    over : bool
        The last messages have been received and sent: nothing of the other side is waited for.
    abort : bool
        Without a word to the other side, which has not been heard of.
    """

    over: bool = False
    abort: bool = False


Effect: TypeAlias = Dial | Hear | Send | Get | Ahead | Read | Wait | HangUp

#: In place of an effect's result: it cannot be carried out without waiting, and was not.
WAITS = object()

#: A part of the core: yields effects, is sent their results or thrown their errors, and returns a `T`. What is sent is
#: what the effect documents; a generator has one type for all of them.
Flow: TypeAlias = Generator[Effect, Any, T]
