"""How much credit a client keeps outstanding, measured from the link.

With too little credit the link is idle between grants. With too much, data queue in front of the slowest part of the
link, and still have to be received after a `stop`. A link is busy with as many bytes in flight as it carries in one
round trip. The window is 1.1 times that, with what the link carries while both ends think, and two messages. It starts
small, and grows fourfold from one round trip to the next as long as more comes for it, and again where whole windows
take hardly longer than the shortest round trip: then the link is idle for lack of credit.

Both quantities are measured from the stream itself. The *round-trip time* is the shortest time seen between a grant and
the first byte that only this grant allowed, or the time until the first answer; queues make these times longer, never
shorter. The *rate* is that at which the last four windows arrived, over at least one round trip, because bytes that
were held up arrive together.
"""

from __future__ import annotations

from collections import deque

from ..errors import OptionError
from .messages import BASE_CREDIT, MAX_CREDIT, MIN_WINDOW

__all__ = ["SMALL_MESSAGE", "FlowWindow"]

#: What the smallest `Segments` of a long slice carry: for fewer bytes its framing costs too much.
SMALL_MESSAGE = 4096

_GAIN = 1.1
_GROWTH = 4.0
# How long both ends together may take to answer, in seconds: without it, the window of a link whose round trip is
# shorter than that would shrink to what it carries in a round trip nobody needs as little as.
_THINKING = 0.005
# A window that takes more round trips than this nearly fills the link, and grows half as fast; so does one that was
# large enough before.
_NEARLY = 1.25
# Growing has an end when the rate grows by less than this.
_RISE = 1.25
# A window that takes at most so many round trips was too small for the link. One that is large enough takes 1.15.
_IDLE = 1.1
# Windows over which the rate is measured: programs that wait for a processor make those of single ones uneven.
_WINDOWS = 4
# Grants a window at most, and at least as long as they are for a small message: between grants the link goes on with
# what is left, so that few of them would need a larger window, and more would be chatter.
_GRANTS = 32


class FlowWindow:
    """The window of one connection. Times are seconds of any clock that does not go back.

    Parameters
    ----------
    fixed : int or None
        A constant size, 1 to `MAX_CREDIT`; None: measured, between `MIN_WINDOW` and what the server allows.

    Attributes
    ----------
    size : int
        Bytes that may be outstanding now.
    round_trip : float or None
        Shortest round-trip time seen, in seconds.
    """

    def __init__(self, fixed: int | None = None) -> None:
        if fixed is not None and not 0 < fixed <= MAX_CREDIT:
            raise OptionError(f"expected a window of 1 to {MAX_CREDIT} bytes, got {fixed}")
        self.round_trip: float | None = None
        self._fixed = fixed
        self._most = BASE_CREDIT
        self.size = MIN_WINDOW if fixed is None else min(fixed, self._most)
        self._granted = 0
        self._arrived = 0
        self._grants: deque[tuple[int, float]] = deque()
        self._rounds: deque[tuple[int, float]] = deque(maxlen=_WINDOWS)  # where, and when, each of the last began
        self._growing, self._was_full, self._was_idle, self._last_rate = True, False, False, 0.0

    def allow(self, most: int) -> None:
        """The server keeps so much credit: `BASE_CREDIT` or more."""
        self._most = most
        if self._fixed is not None:
            self.size = min(self._fixed, most)

    def began(self, now: float) -> None:
        """The first window was asked for at this time: it is measured from there on, and can grow when it has come."""
        if not self._rounds:
            self._rounds.append((self._arrived, now))

    def heard(self, seconds: float) -> None:
        """A round trip took at most this long."""
        if seconds > 0 and (self.round_trip is None or seconds < self.round_trip):
            self.round_trip = seconds

    def due(self, credit: int) -> int:
        """Bytes to grant now, where so many are outstanding; 0 as long as they are not worth a message."""
        missing = self.size - credit
        return missing if missing >= max(self.size / _GRANTS, min(self.size / 4, SMALL_MESSAGE)) else 0

    def grant(self, size: int, now: float | None = None) -> None:
        """This many bytes have just been granted."""
        if now is not None and self._granted:
            self._grants.append((self._granted, now))
        self._granted += size

    def restart(self) -> None:
        """Forget what was granted and has not arrived; it will not arrive any more."""
        self._granted = self._arrived
        self._grants.clear()
        self._rounds.clear()

    def arrive(self, size: int, now: float | None = None) -> None:
        """This many bytes have arrived and been used."""
        self._arrived += size
        if now is None or self._fixed is not None:
            return
        while self._grants and self._grants[0][0] < self._arrived:
            self.heard(now - self._grants.popleft()[1])
        if not self._rounds:
            self._rounds.append((self._arrived, now))
        elif self.round_trip is not None and self._arrived - self._rounds[-1][0] >= self.size:
            self._measure(now, self.round_trip)

    def _measure(self, now: float, round_trip: float) -> None:
        """Set the window by the one that has just arrived and those before it."""
        (first, begun), (start, since) = self._rounds[0], self._rounds[-1]
        came, took = self._arrived - start, now - since
        rate, idle = came / max(took, round_trip), took <= _IDLE * round_trip
        # Once the link was full, a single window that came early is no reason to grow.
        self._growing = rate >= _RISE * self._last_rate if self._growing else idle and self._was_idle
        self._was_idle, self._last_rate = idle, rate
        if self._growing:
            self._rounds.clear()
            fast = took <= _NEARLY * round_trip and not self._was_full
            size = (_GROWTH if fast else _GROWTH / 2) * rate * round_trip
        else:
            self._was_full = True
            answered = round_trip + _THINKING
            size = _GAIN * (self._arrived - first) / max(now - begun, answered) * answered + 2 * SMALL_MESSAGE
        self.size = int(min(max(size, MIN_WINDOW), self._most))
        self._rounds.append((self._arrived, now))
