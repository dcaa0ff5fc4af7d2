"""Where a stream is asked for, by which road, and when again after it broke: the policy, without I/O.

The road is the WebSocket, or HTTP Range where something between does not let WebSockets through or the address is that
of a plain file. Every address has its road; a connection that broke is replaced by one to the next address.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from tenacity import RetryCallState, Retrying, wait_random_exponential

from lodestream.errors import LodestreamError, NotFoundError, OptionError

from . import addresses, problems

__all__ = ["Place", "Roads", "Transport"]

Transport = Literal["auto", "ws", "http"]

# At random within twice as long each time: clients that lost the same server do not come back all at once.
_WAIT = wait_random_exponential(multiplier=0.2, max=5.0)


_FIRST_ATTEMPTS = 3


@dataclass
class Place:
    """An address and the road on which it is tried next."""

    url: str
    allowed: tuple[Literal["ws", "http"], ...]
    road: Literal["ws", "http"]
    blocked: LodestreamError | None = None  # what became of its WebSocket


class Roads:
    """The addresses of one stream.

    Parameters
    ----------
    urls : sequence of str
        Of one surface on several servers, or of its container.
    transport : "auto", "ws" or "http"
        Which roads may be taken.
    deadline : float
        Seconds since a connection was lost in which no byte came, after which it is given up.

    Attributes
    ----------
    met : bool
        Some server has answered as it should. Before, every address is tried three times and no more: what is wrong
        with an address is better told than waited for.
    """

    def __init__(self, urls: Sequence[str], transport: Transport, deadline: float) -> None:
        if transport not in ("auto", "ws", "http"):
            raise OptionError(f"expected a transport of auto, ws or http, got {transport!r}")
        if not urls:
            raise OptionError("expected at least one address, got none")
        if not deadline >= 0:
            raise OptionError(f"expected 0 or more seconds until the deadline, got {deadline}")
        self._places = [_place(addresses.source_url(url), transport) for url in urls]
        self._current = 0
        self._deadline = deadline
        self._refused: set[int] = set()
        self._attempts = 0
        self._since = 0.0
        self.met = False

    @property
    def place(self) -> Place:
        """Where to try now."""
        return self._places[self._current]

    def start(self, now: float) -> None:
        """The first attempt begins."""
        self._attempts, self._since = 0, now

    def failed(self, error: LodestreamError, now: float, *, progressed: bool) -> float:
        """An attempt at `place` ended with an error; the seconds to wait before the next one.

        Parameters
        ----------
        error : LodestreamError
        now : float
        progressed : bool
            New bytes had come before.

        Raises
        ------
        LodestreamError
            The error itself, when there is nothing left to try.
        """
        place, number = self.place, self._current
        if progressed:
            self.start(now)
        if place.road == "ws" and "http" in place.allowed and problems.blocks_sockets(error, met=self.met):
            place.road, place.blocked = "http", error
            return 0.0
        # A wrong address is one by either road.
        twice = isinstance(error, NotFoundError) and isinstance(place.blocked, NotFoundError)
        if place.road == "http" and place.blocked is not None and not self.met and not twice:
            error.args = (f"{error} (and by WebSocket: {place.blocked})", *error.args[1:])
        self._current = (number + 1) % len(self._places)
        if not problems.passes(error):
            self._refused.add(number)
            if len(self._refused) == len(self._places) or not problems.elsewhere(error):
                raise error
            return 0.0
        if not self.met and self._attempts >= _FIRST_ATTEMPTS * len(self._places) - 1:
            raise error
        if not progressed:
            place.road = place.allowed[-1] if place.road == place.allowed[0] else place.allowed[0]
        pause = self._pause()
        if now + pause >= self._since + self._deadline:
            raise error
        return pause

    def _pause(self) -> float:
        self._attempts += 1
        state = RetryCallState(Retrying(), None, (), {})
        state.attempt_number = self._attempts
        return _WAIT(state)


def _place(url: str, transport: Transport) -> Place:
    if not addresses.is_surface(url):
        if transport == "ws":
            raise OptionError(f"expected a surface's address for a WebSocket, got that of a file: {url}")
        return Place(url, ("http",), "http")
    allowed: tuple[Literal["ws", "http"], ...] = ("ws", "http") if transport == "auto" else (transport,)
    return Place(url, allowed, allowed[0])
