"""Flow control of a client: how much credit it keeps outstanding, measured from the link.

With too little credit the link is idle between grants. With too much, data queue in front of the slowest part of the
link, and still have to be received after a `stop`. A link is busy with as many bytes in flight as it carries in one
round trip. The window is 1.1 times that, with what the link carries while both ends think, and two messages. It starts
small, and grows from one round trip to the next as long as more comes for it, and again where whole windows take hardly
longer than the shortest round trip: then the link is idle for lack of credit.

Both quantities are measured from the stream itself. The *round-trip time* is the shortest time seen between a grant and
the first byte that only this grant allowed, or the time until the first answer; queues make these times longer, never
shorter. The *rate* is that at which the last four windows arrived, over at least one round trip, because bytes that
were held up arrive together.

While the window grows, its *spread* says how much the link would have carried: how long the client waited for the
messages of a window, less the longest of these waits, in which the grant was under way. A link that carries a window in
a tenth of a round trip takes ten of them. The rest of the time the client computed, which bounds the growth less
strictly: the first layers take the most time for their bytes.
"""

from __future__ import annotations

from collections import deque

from ..errors import OptionError
from .messages import BASE_CREDIT, MAX_CREDIT, MIN_WINDOW

__all__ = ["FIRST_WINDOW", "SMALL_MESSAGE", "FlowWindow"]

#: What the smallest `Segments` of a long slice carry: for fewer bytes its framing costs too much.
SMALL_MESSAGE = 4096

#: The window while nothing is known of the link: as much as 256 kbit/s may have to carry after a stop.
FIRST_WINDOW = 32 * 1024

_GAIN = 1.1
_GROWTH = 2.0
# The most that a window grows by its spread, and of how many times what the client used in a round trip.
_MAX_GROWTH, _FASTER = 16.0, 4.0
# How long both ends together may take to answer, in seconds: without it, the window of a link whose round trip is
# shorter than that would shrink to what it carries in a round trip nobody needs as little as. A client that computes
# longer for each message answers so much later, but of that no more counts than a part of the round trip.
_MIN_THINKING_SECONDS, _MAX_THINKING_ROUND_TRIPS = 0.005, 0.25
# The spread counts up to so many round trips that a window takes: with more the link is nearly full, or the client so
# slow that its waits say little of the link.
_NEARLY = 1.5
# Growing has an end when the rate grows by less than this.
_RISE = 1.25
# A window that takes at most so many round trips was too small for the link. One that is large enough takes 1.15.
_IDLE = 1.1
# Windows over which the rate is measured: programs that wait for a processor make those of single ones uneven.
_WINDOWS = 4
# A server's messages are this part of the most credit that there was. Where they are a larger part of the window, since
# it has shrunk or the server is of an earlier release, the window holds as much more.
_SHARES = 16
# Grants a window at most, and at least as long as they are for a small message: between grants the link goes on with
# what is left, so that few of them would need a larger window, and more would be chatter.
_GRANTS = 32


class FlowWindow:
    """The window of one connection. Times are seconds of any clock that does not go back.

    Parameters
    ----------
    fixed : int or None
        A constant size, 1 to `MAX_CREDIT`; None: measured, first ``first``, then between `MIN_WINDOW` and what the
        server allows.
    first : int
        The window before anything is measured: `FIRST_WINDOW`, or what an earlier connection found, of which at most
        `BASE_CREDIT` counts.

    Attributes
    ----------
    size : int
        Bytes that may be outstanding now.
    measured : bool
        Whether the size is what this connection found.
    round_trip : float or None
        Shortest round-trip time seen, in seconds.
    """

    def __init__(self, fixed: int | None = None, first: int = FIRST_WINDOW) -> None:
        if fixed is not None and not 0 < fixed <= MAX_CREDIT:
            raise OptionError(f"expected a window of 1 to {MAX_CREDIT} bytes, got {fixed}")
        self.round_trip: float | None = None
        self.measured = False
        self._fixed = fixed
        self._most = BASE_CREDIT
        self.size = min(max(first, MIN_WINDOW) if fixed is None else fixed, self._most)
        self._granted = 0
        self._arrived = 0
        self._grants: deque[tuple[int, float]] = deque()
        self._rounds: deque[tuple[int, float]] = deque(maxlen=_WINDOWS)  # where, and when, each of the last began
        self._growing, self._was_full, self._was_idle, self._last_rate = True, False, False, 0.0
        self._waits = 0.0, 0.0  # for messages of this window: all together, and the longest
        self._messages = self._largest = 0

    def allow(self, most: int) -> None:
        """Set the credit that the server keeps, `BASE_CREDIT` or more."""
        self._most = most
        if self._fixed is not None:
            self.size = min(self._fixed, most)

    def began(self, asked: float, now: float) -> None:
        """Start measuring: the first window was requested at ``asked``, and its answer arrived at ``now``."""
        if not self._rounds:
            self._rounds.append((self._arrived, asked))
            self._waits = now - asked, now - asked

    def heard(self, seconds: float) -> None:
        """Record a round trip that took at most this long."""
        if seconds > 0 and (self.round_trip is None or seconds < self.round_trip):
            self.round_trip = seconds

    def waited(self, seconds: float) -> None:
        """Record that the client waited so long for a message, with nothing else to do."""
        together, longest = self._waits
        self._waits = together + seconds, max(longest, seconds)

    def due(self, credit: int) -> int:
        """Return the bytes to grant now, with ``credit`` outstanding; 0 as long as they are not worth a message."""
        missing = self.size - credit
        return missing if missing >= max(self.size / _GRANTS, min(self.size / 4, SMALL_MESSAGE)) else 0

    def grant(self, size: int, now: float | None = None) -> None:
        """Record that this many bytes have been granted."""
        if now is not None and self._granted:
            self._grants.append((self._granted, now))
        self._granted += size

    def restart(self) -> None:
        """Forget credit that was granted and not used; the data for it will not arrive."""
        self._granted = self._arrived
        self._grants.clear()
        self._rounds.clear()

    def arrive(self, size: int, now: float | None = None) -> None:
        """Record that this many bytes have arrived and been used."""
        self._arrived += size
        self._messages += 1
        self._largest = max(self._largest, size)
        if now is None or self._fixed is not None:
            return
        while self._grants and self._grants[0][0] < self._arrived:
            self.heard(now - self._grants.popleft()[1])
        if not self._rounds:
            self._rounds.append((self._arrived, now))
        elif self.round_trip is not None and self._arrived - self._rounds[-1][0] >= self.size * (1 - 1 / _GRANTS):
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
            size = _GROWTH * rate * round_trip
            if took <= _NEARLY * round_trip and not self._was_full:
                size = max(size, came * self._growth(took, round_trip))
        else:
            self._was_full = True
            answered = round_trip + self._thinking(took, round_trip)
            size = _GAIN * (self._arrived - first) / max(now - begun, answered) * answered
            size += max(2 * SMALL_MESSAGE, self._largest - size / _SHARES)
        self.size, self.measured = int(min(max(size, MIN_WINDOW), self._most)), True
        self._rounds.append((self._arrived, now))
        self._waits, self._messages, self._largest = (0.0, 0.0), 0, 0

    def _growth(self, took: float, round_trip: float) -> float:
        """Return how many windows like the last one are used in a round trip."""
        together, longest = self._waits
        return round_trip / max(together - longest, (took - together) / _FASTER, round_trip / _MAX_GROWTH)

    def _thinking(self, took: float, round_trip: float) -> float:
        """Return the seconds between a message and the grant that answers it."""
        computing = (took - self._waits[0]) / self._messages
        return max(_MIN_THINKING_SECONDS, min(computing, _MAX_THINKING_ROUND_TRIPS * round_trip))
