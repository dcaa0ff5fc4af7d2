"""Limit the rate of receiving: the time that each message would take on a link of that rate."""

from __future__ import annotations

from lodestream.protocol.messages import MAX_CREDIT

__all__ = ["Link", "window_for"]

# A window holds a quarter of a second of the link, so that the server is stopped soon, and never less than what carries
# a message and its framing well, nor more than the server grants anyway.
_WINDOW_SECONDS = 0.25
_WINDOW_LEAST = 1024


class Link:
    """A simulated link of limited rate behind the real one: a token bucket without burst; the caller passes the time.

    Credit is granted only for data that have passed it, so the server adapts its rate.

    Parameters
    ----------
    rate : float
        Bytes per second.
    """

    def __init__(self, rate: float) -> None:
        if not rate > 0:
            raise ValueError(f"expected a positive rate, got {rate}")
        self.rate = rate
        self._free_at = float("-inf")

    def delay(self, size: int, now: float) -> float:
        """Return the seconds from `now` until `size` more bytes have passed."""
        self._free_at = max(self._free_at, now) + size / self.rate
        return self._free_at - now


def window_for(rate: float) -> int:
    """Return the credit, in bytes, that keeps a link of `rate` bytes per second busy and no more."""
    return round(min(max(rate * _WINDOW_SECONDS, _WINDOW_LEAST), MAX_CREDIT))
