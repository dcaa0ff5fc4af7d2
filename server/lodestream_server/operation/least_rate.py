"""The least rate at which clients send uploads and read answers."""

from __future__ import annotations

from collections.abc import Callable

__all__ = ["LeastRate"]


class LeastRate:
    """Checks that bytes move at a least rate, on average over each interval of some seconds.

    Parameters
    ----------
    rate : int
        Bytes a second. With 0 it is enough that something moves.
    seconds : float
        Least length of an interval.
    clock : callable
        Returns seconds.
    """

    def __init__(self, rate: int, seconds: float, clock: Callable[[], float]) -> None:
        self._least = max(rate * seconds, 1)
        self._seconds = seconds
        self._clock = clock
        self.begin(0)

    def begin(self, count: int) -> None:
        """Begin an interval.

        Parameters
        ----------
        count : int
            Bytes that have moved so far, in all.
        """
        self._began, self._before = self._clock(), count

    def shortfall(self, count: int) -> tuple[int, float] | None:
        """Bytes and seconds of an interval that is over and was too slow; None otherwise.

        If an interval is over, the next one begins.

        Parameters
        ----------
        count : int
            Bytes that have moved so far, in all.
        """
        moved, elapsed = count - self._before, self._clock() - self._began
        if elapsed < self._seconds:
            return None
        self.begin(count)
        return (moved, elapsed) if moved < self._least else None
