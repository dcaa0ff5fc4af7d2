"""How much credit a client keeps outstanding, measured from the link.

With too little credit the link is idle between grants. With too much, data queue in front of the slowest part of the
link, and still have to be received after a `stop`. A link is busy with as many bytes in flight as it carries in one
round trip. The window is twice that. It starts small: if the link was idle for lack of credit, it doubles from one
round trip to the next, otherwise it stays.

Both quantities are measured from the stream itself. The *round-trip time* is the shortest time seen between a grant and
the first byte that only this grant allowed, or the time until the first answer; queues make these times longer, never
shorter. The *rate* is that at which a whole window arrived, over at least one round trip, because bytes that were held
up arrive together.
"""

from __future__ import annotations

from collections import deque

from ..errors import OptionError
from .messages import MAX_CREDIT, MIN_WINDOW

__all__ = ["FlowWindow"]

_GAIN = 2.0


class FlowWindow:
    """The window of one connection. Times are seconds of any clock that does not go back.

    Parameters
    ----------
    fixed : int or None
        A constant size, 1 to `MAX_CREDIT`; None: measured, between `MIN_WINDOW` and `MAX_CREDIT`.

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
        self.size = MIN_WINDOW if fixed is None else fixed
        self.round_trip: float | None = None
        self._measured = fixed is None
        self._granted = 0
        self._arrived = 0
        self._grants: deque[tuple[int, float]] = deque()
        self._round: tuple[int, float] | None = None

    def heard(self, seconds: float) -> None:
        """A round trip took at most this long."""
        if seconds > 0 and (self.round_trip is None or seconds < self.round_trip):
            self.round_trip = seconds

    def grant(self, size: int, now: float | None = None) -> None:
        """This many bytes have just been granted."""
        if now is not None and self._granted:
            self._grants.append((self._granted, now))
        self._granted += size

    def restart(self) -> None:
        """Forget what was granted and has not arrived; it will not arrive any more."""
        self._granted = self._arrived
        self._grants.clear()
        self._round = None

    def arrive(self, size: int, now: float | None = None) -> None:
        """This many bytes have arrived and been used."""
        self._arrived += size
        if now is None or not self._measured:
            return
        while self._grants and self._grants[0][0] < self._arrived:
            self.heard(now - self._grants.popleft()[1])
        if self._round is None:
            self._round = self._arrived, now
        start, since = self._round
        if self.round_trip is None or self._arrived - start < self.size:
            return
        rate = (self._arrived - start) / max(now - since, self.round_trip)
        self.size = round(min(max(_GAIN * rate * self.round_trip, MIN_WINDOW), MAX_CREDIT))
        self._round = self._arrived, now
