"""How much credit a client has outstanding, by what it measures of the link.

Too little leaves the link idle between grants; too much stands in a queue before the slowest part of the way, and still
has to be taken after a `stop`. What fills a link is the bytes that it carries in one round trip. The window is twice
that: grants come in steps and the first of them are small, so that a link that was idle for want of credit is given
twice as much from one round to the next, and one that was busy keeps what it needs.

Both quantities are measured without sending anything for it. The *round trip* is the shortest time seen between a grant
and the first byte that only this grant allowed, or what the first answer took: in a queue times are longer, never
shorter. The *rate* is that of a whole window as it came, over at least a round trip, since bytes that were held up
somewhere arrive together and prove nothing.
"""

from __future__ import annotations

from collections import deque

from .errors import OptionError
from .messages import MAX_CREDIT, MIN_WINDOW

__all__ = ["Window"]

_GAIN = 2.0


class Window:
    """The window of one connection, fed with times in seconds of any clock that does not go back.

    Parameters
    ----------
    fixed : int or None
        A size of 1 to `MAX_CREDIT` that stays as it is; None for one between `MIN_WINDOW` and `MAX_CREDIT` that is
        measured.

    Attributes
    ----------
    size : int
        Bytes that may be outstanding now.
    round_trip : float or None
        Shortest time seen, in seconds.
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
        """A round trip took at most so long."""
        if seconds > 0 and (self.round_trip is None or seconds < self.round_trip):
            self.round_trip = seconds

    def grant(self, size: int, now: float | None = None) -> None:
        """So many bytes have just been granted."""
        if now is not None and self._granted:
            self._grants.append((self._granted, now))
        self._granted += size

    def restart(self) -> None:
        """What was granted and has not come will not come any more."""
        self._granted = self._arrived
        self._grants.clear()
        self._round = None

    def arrive(self, size: int, now: float | None = None) -> None:
        """So many bytes have come and been used."""
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
