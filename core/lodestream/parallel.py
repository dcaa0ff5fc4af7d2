"""Threads for the kernels, which release Python's lock: their number, and work distributed over them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from queue import SimpleQueue
from threading import RLock, Thread
from typing import Any, Generic, TypeVar
from weakref import WeakMethod, ref

from .errors import OptionError
from .operating_system import keep_out_of_forks, processors, run_in_forks

__all__ = ["VARIABLE", "aside", "spread", "threads"]

#: The environment variable that says how many threads work; unset or empty: one for each processor.
VARIABLE = "LODESTREAM_THREADS"

_MAX_THREADS = 256

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def threads() -> int:
    """Return how many threads work on one surface, the caller's included: 1 or more.

    Raises
    ------
    OptionError
        If ``LODESTREAM_THREADS`` is set to something else than a whole number from 1 to 256.
    """
    setting = os.environ.get(VARIABLE, "").strip()
    if not setting:
        return min(processors(), _MAX_THREADS)
    if setting.isascii() and setting.isdigit() and 1 <= int(setting) <= _MAX_THREADS:
        return int(setting)
    raise OptionError(f"expected {VARIABLE} to be a whole number from 1 to {_MAX_THREADS}, got {setting[:40]!r}")


def spread(work: Callable[[_Item], _Result], items: Iterable[_Item]) -> list[_Result]:
    """Return ``[work(item) for item in items]``, computed by the caller's thread and up to `threads` - 1 others.

    Items are started in order, and results are in the order of the items. The caller takes part and waits only for
    items that others have started, so `work` may call `spread` itself, and all callers share the threads.

    Raises
    ------
    Exception
        The exception that `work` raises for the first item, in order, that fails. No item is started after that, and
        none is running when it is raised. An interrupt of the caller's thread has the same effect.
    """
    queue = list(items)
    if len(queue) < 2 or (count := min(threads(), len(queue))) < 2:
        return [work(item) for item in queue]
    return _Spread(work, queue).results(count - 1)


def aside(work: Callable[[], object]) -> bool:
    """Have another thread do work while the caller goes on; return False, and do nothing, if there is no other thread.

    The work is a method, and is left out if its object is gone by then. Nobody waits for it or hears of its errors: it
    says by itself what has become of it. It may call `spread`. One piece of such work is done at a time in a process,
    and a fork waits for its end: pieces are short, and do not wait for others who may fork.

    Raises
    ------
    OptionError
        See `threads`.
    """
    return threads() > 1 and _pool("aside", 1).take(_Aside(work))


class _Aside:
    """Work of `aside`."""

    def __init__(self, work: Callable[[], object]) -> None:
        self._work = WeakMethod(work)

    def help(self) -> None:
        """Do it if its object still exists."""
        with _forks.kept_out(), suppress(BaseException):  # the thread has other work to do after it
            if (work := self._work()) is not None:
                work()


class _Forks:
    """Keeps forks and work of `aside` apart: threads do not survive a fork, and what they have begun would stay so."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Begin anew, in a process that was forked."""
        self._next = RLock()  # held by a fork that waits, which comes before any work that has not begun
        self._one = RLock()

    def begin(self) -> None:
        """Wait for the work that is being done; called before a fork."""
        self._next.acquire()
        self._one.acquire()

    def end(self) -> None:
        """Let work go on; called after a fork."""
        try:
            self._one.release()
        finally:
            self._next.release()

    @contextmanager
    def kept_out(self) -> Iterator[None]:
        """Let no process be forked by another thread."""
        with self._next:
            one = self._one
            one.acquire()
        try:
            yield
        finally:
            one.release()


class _Spread(Generic[_Item, _Result]):
    """Items that several threads take one after another.

    A signal may raise KeyboardInterrupt in the caller's thread between any two lines: also after a Condition is
    acquired and before its block is entered, and then all others would wait for ever. So there is no lock here. Each
    step that threads share is one call of a deque or a queue, which are written in C and do it whole.
    """

    def __init__(self, work: Callable[[_Item], _Result], items: list[_Item]) -> None:
        self._work, self._count = work, len(items)
        self._waiting = deque(enumerate(items))
        self._places: deque[None] = deque()
        self._left: deque[None] = deque()
        self._woken: SimpleQueue[None] = SimpleQueue()
        self._found: dict[int, _Result] = {}
        self._errors: dict[int, BaseException] = {}

    def results(self, others: int) -> list[_Result]:
        """Return all results in order, with the help of ``others`` threads."""
        self._places.extend([None] * others)
        try:
            _pool("spread", threads() - 1).ask(self, others)
            self._take()
        finally:
            self._waiting.clear()
            helping = others - self._close()
            try:
                self._wait(helping)
            except KeyboardInterrupt:
                self._wait(helping)
                raise
        if self._errors:
            raise self._errors[min(self._errors)]
        return [self._found[number] for number in range(self._count)]

    def help(self) -> None:
        """Process items in another thread. After the end there is no place, and this does nothing."""
        try:
            self._places.pop()
        except IndexError:
            return
        with suppress(BaseException):  # it is in `_errors`, for the caller
            self._take()
        self._left.append(None)
        self._woken.put(None)

    def _take(self) -> None:
        """Process items until none is waiting."""
        while True:
            try:
                number, item = self._waiting.popleft()
            except IndexError:
                return
            try:
                self._found[number] = self._work(item)
            except BaseException as error:
                self._errors[number] = error
                self._waiting.clear()
                if not isinstance(error, Exception):
                    raise

    def _close(self) -> int:
        """Remove the places that no thread has taken; return their number."""
        free = 0
        with suppress(IndexError):
            while True:
                self._places.pop()
                free += 1
        return free

    def _wait(self, helping: int) -> None:
        """Wait until ``helping`` threads have finished; it may be interrupted and called again."""
        while len(self._left) < helping:
            self._woken.get()


class _Pool:
    """Threads that start when there is work, and end with the process."""

    def __init__(self, most: int) -> None:
        self._asked: SimpleQueue[Callable[[], _Spread[Any, Any] | _Aside | None]] = SimpleQueue()
        self._most = most
        self._unborn = deque(range(most))

    def ask(self, work: _Spread[Any, Any], count: int) -> None:
        """Ask ``count`` threads to help when they are free. Where no thread can be started, the caller works alone."""
        for _ in range(count):
            # The reference is weak, so that finished work need not wait for a thread that has not started on it.
            self._asked.put(ref(work))
            self._start()

    def take(self, work: _Aside) -> bool:
        """Have a thread do this when it is free; return False if no thread can be started."""
        self._start()
        if len(self._unborn) == self._most:
            return False
        self._asked.put(lambda: work)
        return True

    def _start(self) -> None:
        """Start a thread if there are fewer than the maximum."""
        try:
            number = self._unborn.pop()
        except IndexError:
            return
        try:
            Thread(target=self._serve, name=f"lodestream_{number}", daemon=True).start()
        except RuntimeError:  # a limit of the process, or the interpreter is ending
            self._unborn.append(number)

    def _serve(self) -> None:
        """Process requests for help."""
        while True:
            self._help(self._asked.get()())

    @staticmethod
    def _help(work: _Spread[Any, Any] | _Aside | None) -> None:
        """Help with work that still exists."""
        if work is not None:
            work.help()


#: The threads of this process, by what they do and how many there are at most.
_pools: dict[tuple[str, int], _Pool] = {}


def _pool(use: str, most: int) -> _Pool:
    """Return the pool of a use with so many threads."""
    return _pools.get((use, most)) or _pools.setdefault((use, most), _Pool(most))


_forks = _Forks()
keep_out_of_forks(_forks.begin, _forks.end)
run_in_forks(_forks.clear)
run_in_forks(_pools.clear)  # threads do not survive a fork
