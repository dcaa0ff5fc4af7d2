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

__all__ = ["Place", "Turns"]

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
        self._waiting: dict[str, list[tuple[int, int, Place]]] = {}
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
        place = Place(self, rank)
        place.join(caller)
        async with place.turn():
            yield

    async def _enter(self, place: Place) -> str:
        """Wait for a turn, and return whose it is."""
        if self._free:  # then nobody waits
            self._free -= 1
            caller = place.callers[0]
            self._running[caller] += 1
            return caller
        place.given = asyncio.get_running_loop().create_future()
        for caller in place.callers:
            self._wait(caller, place)
        try:
            return await place.given
        except asyncio.CancelledError:
            if not place.given.cancelled():  # the turn came at the same moment
                self._leave(place.given.result())
            raise

    def _wait(self, caller: str, place: Place) -> None:
        if caller not in place.lines:
            place.lines.add(caller)
            heapq.heappush(self._waiting.setdefault(caller, []), (place.rank, next(self._numbers), place))

    def _step_out(self, caller: str) -> Place:
        place = heapq.heappop(self._waiting[caller])[2]
        place.lines.discard(caller)
        return place

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
        given.set_result(chosen)

    def _next(self) -> tuple[str, asyncio.Future[str]] | None:
        now = self._clock()
        for caller, waiting in list(self._waiting.items()):
            while waiting and not waiting[0][2].waits_for(caller):
                self._step_out(caller)
            if not waiting:
                del self._waiting[caller]
        if not self._waiting:
            return None
        chosen = min(self._waiting, key=lambda caller: self._order(caller, now))
        given = self._step_out(chosen).given
        assert given is not None, "it waits"
        return chosen, given

    def _order(self, caller: str, now: float) -> tuple[int, float, int]:
        return self._running[caller], self._use(caller, now), self._waiting[caller][0][1]

    def _charge(self, caller: str, began: float) -> None:
        now = self._clock()
        # What was used early in a long turn is forgotten in part by its end.
        spent = self._memory * -math.expm1((began - now) / self._memory)
        self._used[caller] = (self._use(caller, now) + spent, now)
        if len(self._used) > _REMEMBERED:
            del self._used[min(self._used, key=lambda other: self._use(other, now))]

    def _use(self, caller: str, now: float) -> float:
        seconds, when = self._used.get(caller, (0.0, now))
        return seconds * math.exp((when - now) / self._memory)


class Place:
    """A place in the queue of one task, for which several callers may wait: it comes in the first turn of any of them.

    Parameters
    ----------
    turns : Turns
    rank : int
        As in `Turns.turn`.

    Attributes
    ----------
    callers : list of str
        Who waits for the task, once for each time; in order of arrival.
    given : future or None
        While it waits for its turn: whose turn it came in.
    lines : set of str
        Callers in whose lines it stands; those who have left may be among them.
    """

    def __init__(self, turns: Turns, rank: int = 0) -> None:
        self.rank = rank
        self.callers: list[str] = []
        self.given: asyncio.Future[str] | None = None
        self.lines = set[str]()
        self._turns = turns

    def join(self, caller: str) -> None:
        """Let the task come in the turns of this caller too."""
        self.callers.append(caller)
        if self.waits_for(caller):
            self._turns._wait(caller, self)

    def leave(self, caller: str) -> None:
        """Take back one `join` of this caller."""
        self.callers.remove(caller)

    def waits_for(self, caller: str) -> bool:
        """Return whether the task waits for a turn, and may come in one of this caller."""
        return self.given is not None and not self.given.done() and caller in self.callers

    @asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """Wait for a turn, and hold it for the length of the block."""
        caller = await self._turns._enter(self)
        began = self._turns._clock()
        try:
            yield
        finally:
            self._turns._charge(caller, began)
            self._turns._leave(caller)
