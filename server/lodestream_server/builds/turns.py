"""Fair turns for work of which only a little can be done at the same time.

Everything here runs in the event loop, between two awaits, so no lock is needed.
"""

from __future__ import annotations

import asyncio
import heapq
import itertools
import math
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

__all__ = ["Turns"]

# Of so many callers it is remembered what they have used.
_REMEMBERED = 1000


class Turns:
    """Gives out a limited number of turns. The next turn goes to the waiting caller with the fewest current turns, and
    among equals to the one that has used the least time recently.

    So a caller with one task waits for at most one turn to end, however many tasks another caller has.

    Parameters
    ----------
    size : int
        Number of turns at the same time.
    memory : float
        Seconds after which used time counts for 1/e of it. A caller that never pauses counts as having used this many
        seconds.
    clock : callable
        Returns seconds.
    """

    def __init__(self, size: int, memory: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._free = size
        self._memory = memory
        self._clock = clock
        self._running: Counter[str] = Counter()
        self._used: dict[str, tuple[float, float]] = {}  # seconds, and when that was so
        self._waiting: dict[str, list[tuple[int, int, asyncio.Future[None]]]] = {}
        self._numbers = itertools.count()

    @asynccontextmanager
    async def turn(self, caller: str, rank: int = 0) -> AsyncIterator[None]:
        """Wait for this caller's turn, and hold it for the length of the block.

        Parameters
        ----------
        caller : str
            Key of the caller.
        rank : int
            Tasks of the same caller run in the order of their ranks, equal ones in order of arrival.
        """
        await self._enter(caller, rank)
        began = self._clock()
        try:
            yield
        finally:
            now = self._clock()
            # What was used early in a long turn is forgotten in part by its end.
            spent = self._memory * -math.expm1((began - now) / self._memory)
            self._used[caller] = (self._use(caller, now) + spent, now)
            self._forget(now)
            self._leave(caller)

    def _use(self, caller: str, now: float) -> float:
        seconds, when = self._used.get(caller, (0.0, now))
        return seconds * math.exp((when - now) / self._memory)

    def _forget(self, now: float) -> None:
        if len(self._used) > _REMEMBERED:
            del self._used[min(self._used, key=lambda caller: self._use(caller, now))]

    async def _enter(self, caller: str, rank: int) -> None:
        if self._free:  # then nobody waits
            self._free -= 1
        else:
            given: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            heapq.heappush(self._waiting.setdefault(caller, []), (rank, next(self._numbers), given))
            try:
                await given
            except asyncio.CancelledError:
                if not given.cancelled():  # the turn came at the same moment
                    self._leave(caller)
                raise
            return
        self._running[caller] += 1

    def _leave(self, caller: str) -> None:
        self._running[caller] -= 1
        if not self._running[caller]:
            del self._running[caller]
        following = self._next()
        if following is None:
            self._free += 1
            return
        chosen, given = following
        self._running[chosen] += 1
        given.set_result(None)

    def _next(self) -> tuple[str, asyncio.Future[None]] | None:
        now = self._clock()
        for caller, waiting in list(self._waiting.items()):
            while waiting and waiting[0][2].cancelled():  # gave up
                heapq.heappop(waiting)
            if not waiting:
                del self._waiting[caller]
        if not self._waiting:
            return None
        chosen = min(self._waiting, key=lambda caller: self._order(caller, now))
        return chosen, heapq.heappop(self._waiting[chosen])[2]

    def _order(self, caller: str, now: float) -> tuple[int, float, int]:
        return self._running[caller], self._use(caller, now), self._waiting[caller][0][1]
