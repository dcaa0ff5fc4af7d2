"""The least rate at which clients send uploads and read answers."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from time import monotonic
from typing import TypeVar

__all__ = ["LeastRate", "WaitingClock"]

T = TypeVar("T")

#: Seconds between two looks of a `WaitingClock`: what passes beyond them the server was busy.
_LOOK = 0.25


class WaitingClock:
    """A clock that goes only while a server waits for a client: a callable that returns seconds.

    It stands while the server does something else with what came, and while the event loop is held up, since then
    nobody reads what the client sends.

    Parameters
    ----------
    loop : asyncio.AbstractEventLoop
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self._waited = 0.0
        self._last = 0.0
        self._timer: asyncio.TimerHandle | None = None

    def __call__(self) -> float:
        """Return the seconds waited so far."""
        return self._waited

    async def waiting(self, coming: Awaitable[T]) -> T:
        """Await something from the client while the clock runs."""
        self._last = monotonic()
        self._timer = self._loop.call_later(_LOOK, self._look)
        try:
            return await coming
        finally:
            self._timer.cancel()
            self._count()

    def _look(self) -> None:
        self._count()
        self._timer = self._loop.call_later(_LOOK, self._look)

    def _count(self) -> None:
        now = monotonic()
        self._waited += min(now - self._last, _LOOK)
        self._last = now


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
        """Return the bytes and seconds of an interval that has ended and was too slow; None otherwise.

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
