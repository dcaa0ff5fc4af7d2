"""The choice of a stream's transport, and when to try again after it broke: the policy, without I/O.

The transport is a WebSocket, or HTTP Range if WebSockets do not get through or the URL is that of a plain file.
"""

from __future__ import annotations

import random
from typing import Literal

from lodestream.errors import LodestreamError, NotFoundError, OptionError

from ..requests import addresses, problems

__all__ = ["Transport", "Transports"]

Transport = Literal["auto", "ws", "http"]

# Seconds between attempts: at random within twice as long each time, so that clients that lost the same server do not
# come back all at once.
_FIRST_PAUSE = 0.2
_LONGEST_PAUSE = 5.0

_FIRST_ATTEMPTS = 3


class Transports:
    """The transports to one URL.

    Parameters
    ----------
    url : str
        URL of a surface, or of its container.
    transport : "auto", "ws" or "http"
        Transports that may be used.
    deadline : float
        Seconds without data after a connection was lost, after which the client gives up.

    Attributes
    ----------
    url : str
    transport : "ws" or "http"
        The transport of the next attempt.
    met : bool
        Whether the server has answered as expected. Before that there are only three attempts, because a wrong URL
        should be reported soon.
    beside : bool
        Whether a request over HTTP may be made while the answer to another comes. A server that has refused one may
        take only one at a time.
    """

    def __init__(self, url: str, transport: Transport, deadline: float) -> None:
        if transport not in ("auto", "ws", "http"):
            raise OptionError(f"expected a transport of auto, ws or http, got {transport!r}")
        if not deadline >= 0:
            raise OptionError(f"expected 0 or more seconds until the deadline, got {deadline}")
        self.url = addresses.source_url(url)
        self._allowed = _allowed(self.url, transport)
        self.transport = self._allowed[0]
        self._blocked: LodestreamError | None = None  # what became of its WebSocket
        self._deadline = deadline
        self._attempts = 0
        self._since = 0.0
        self.met = False
        self.beside = True

    def start(self, now: float) -> None:
        """Begin the first attempt."""
        self._attempts, self._since = 0, now

    def failed(self, error: LodestreamError, now: float, *, progressed: bool) -> float:
        """Record a failed attempt, and return the seconds to wait before the next one.

        Parameters
        ----------
        error : LodestreamError
        now : float
            Seconds of any clock that does not go back.
        progressed : bool
            Whether new data had arrived before.

        Raises
        ------
        LodestreamError
            The error itself, if no further attempt is made.
        """
        if progressed:
            self.start(now)
        if self.transport == "ws" and "http" in self._allowed and problems.blocks_sockets(error, met=self.met):
            self.transport, self._blocked = "http", error
            return 0.0
        # What is wrong over either transport in the same way, such as the address, is said once.
        twice = isinstance(error, NotFoundError) or str(error) == str(self._blocked)
        if self.transport == "http" and self._blocked is not None and not self.met and not twice:
            error.args = (f"{error} (and by WebSocket: {self._blocked})", *error.args[1:])
        if not problems.passes(error):
            raise error
        if not self.met and self._attempts >= _FIRST_ATTEMPTS - 1:
            raise error
        if not progressed:
            self.transport = self._allowed[-1] if self.transport == self._allowed[0] else self._allowed[0]
        pause = self._pause()
        if now + pause >= self._since + self._deadline:
            raise error
        return pause

    def _pause(self) -> float:
        self._attempts += 1
        return random.uniform(0.0, min(_FIRST_PAUSE * 2 ** min(self._attempts, 10), _LONGEST_PAUSE))


def _allowed(url: str, transport: Transport) -> tuple[Literal["ws", "http"], ...]:
    if not addresses.is_served(url):
        if transport == "ws":
            raise OptionError(f"expected a surface's address for a WebSocket, got that of a file: {url}")
        return ("http",)
    return ("ws", "http") if transport == "auto" else (transport,)
