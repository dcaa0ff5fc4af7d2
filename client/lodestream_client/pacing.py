"""Reading at a limited rate: how long each message would have taken on a link of that speed."""

from __future__ import annotations

__all__ = ["Link", "window_for"]

# A window holds a quarter of a second of the link, so that the server is stopped soon, and never less than what carries
# a message and its framing well, nor more than the server grants anyway.
_WINDOW_SECONDS = 0.25
_WINDOW_LEAST = 1024
_WINDOW_MOST = 256 * 1024


class Link:
    """A link of limited rate on this side of the real one: a token bucket without burst, clock passed in.

    Credit is granted only for bytes that have come through, so the server follows.

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
        """Seconds from `now` until `size` more bytes have come through."""
        self._free_at = max(self._free_at, now) + size / self.rate
        return self._free_at - now


def window_for(rate: float) -> int:
    """Bytes of credit that keep a link of `rate` bytes per second busy and no more."""
    return round(min(max(rate * _WINDOW_SECONDS, _WINDOW_LEAST), _WINDOW_MOST))
