"""Threads for the kernels, which let go of Python's lock: how many there are, and work spread over them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Condition
from typing import Generic, TypeVar

from .errors import OptionError

__all__ = ["VARIABLE", "spread", "threads"]

#: The environment variable that says how many threads work; unset or empty: one for each processor.
VARIABLE = "LODESTREAM_THREADS"

_MOST = 256

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def threads() -> int:
    """How many threads work on one surface, the caller's included: 1 or more.

    Raises
    ------
    OptionError
        If ``LODESTREAM_THREADS`` is set to something else than a whole number from 1 to 256.
    """
    told = os.environ.get(VARIABLE, "").strip()
    if not told:
        return min(_processors(), _MOST)
    if told.isascii() and told.isdigit() and 1 <= int(told) <= _MOST:
        return int(told)
    raise OptionError(f"expected {VARIABLE} to be a whole number from 1 to {_MOST}, got {told[:40]!r}")


def _processors() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return max(1, len(os.sched_getaffinity(0)))
    return os.cpu_count() or 1


def spread(work: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """``[work(item) for item in items]``, by the caller's thread and as many others as `threads` allows.

    Items are begun in their order, and results stand in the order of the items. The caller takes part and waits only
    for items that others have begun, so `work` may call this itself, and all callers share the threads.

    Raises
    ------
    Exception
        Whatever `work` raises for the first item, in their order, for which it does. No item is begun after that, and
        none is still being worked on when it is raised. An interruption of the caller's thread ends it alike.
    """
    queue = list(items)
    if len(queue) < 2 or (count := min(threads(), len(queue))) < 2:
        return [work(item) for item in queue]
    return _Spread(work, queue).results(count - 1)


class _Spread(Generic[_Item, _Result]):
    """Items that several threads take one after another."""

    def __init__(self, work: Callable[[_Item], _Result], items: list[_Item]) -> None:
        self._work, self._items, self._lock = work, items, Condition()
        self._next, self._end, self._helping = 0, len(items), 0
        self._found: dict[int, _Result] = {}
        self._errors: dict[int, Exception] = {}

    def results(self, others: int) -> list[_Result]:
        """All results in order, with the help of so many other threads."""
        helping: list[Future[None]] = []
        try:
            helping += _helpers(self._help, others)
            self._take()
        finally:
            with self._lock:
                self._end = 0
            for helper in helping:
                if not helper.cancel():
                    helper.result()
            with self._lock:
                # A pool that could not start a thread has taken the work all the same: another thread may be at it.
                self._lock.wait_for(lambda: not self._helping)
        if self._errors:
            raise self._errors[min(self._errors)]
        return [self._found[number] for number in range(len(self._items))]

    def _help(self) -> None:
        with self._lock:
            if not self._end:
                return
            self._helping += 1
        try:
            self._take()
        finally:
            with self._lock:
                self._helping -= 1
                self._lock.notify_all()

    def _take(self) -> None:
        while True:
            with self._lock:
                number, self._next = self._next, self._next + 1
            if number >= self._end:
                return
            try:
                self._found[number] = self._work(self._items[number])
            except Exception as error:
                self._errors[number], self._end = error, 0


#: The threads of this process, by how many there are at most. They begin when there is something to do.
_pools: dict[int, ThreadPoolExecutor] = {}


def _helpers(work: Callable[[], None], count: int) -> Iterator[Future[None]]:
    """So many threads at work, or fewer where no more can be started."""
    most = threads() - 1
    pool = _pools.get(most) or _pools.setdefault(most, ThreadPoolExecutor(most, "lodestream"))
    for _ in range(count):
        try:
            yield pool.submit(work)
        except RuntimeError:  # a limit of the process, or the interpreter is ending
            return


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pools.clear)  # threads do not survive a fork
