"""The event loop of all blocking clients of a process, in one thread of its own.

The thread is made at first use, and anew after a fork: threads do not survive one. It ends with the interpreter.
"""

from __future__ import annotations

import asyncio
import atexit
import os
import threading
from collections.abc import Callable, Coroutine
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Any, Generic, Protocol, TypeAlias, TypeVar

__all__ = ["Calls", "LoopThread", "Turn", "Work", "current", "relayed", "release"]

T = TypeVar("T")

# Seconds: Windows does not interrupt a wait for Ctrl-C, so a wait is many short ones.
_WAIT = 0.1
# Seconds that connections may take to close when the interpreter ends.
_END = 1.0

#: What is to be done on the loop. The coroutine is made there, so that an interrupt leaves none that nobody awaits.
Work: TypeAlias = Callable[[], Coroutine[Any, Any, T]]

#: Calls that a thread makes while it waits for the loop.
Calls: TypeAlias = "SimpleQueue[Callable[[], object] | None]"


class Closing(Protocol):
    """What is closed on the loop."""

    async def close(self) -> None:
        """Close it."""


class Turn(Generic[T]):
    """Work on the loop; `result` waits for it.

    Parameters
    ----------
    loop : AbstractEventLoop
    work : callable
        Returns a coroutine.
    calls : Calls or None
        What the work asks the waiting thread to call, see `relayed`.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop, work: Work[T], calls: Calls | None = None) -> None:
        self._loop = loop
        self._work = work
        self._calls: Calls = SimpleQueue() if calls is None else calls
        self._task: asyncio.Task[None] | None = None
        self._results: list[T] = []
        self._error: BaseException | None = None
        self._cancelled = False
        loop.call_soon_threadsafe(self._begin)

    def _begin(self) -> None:
        self._task = self._loop.create_task(self._carried_out())

    async def _carried_out(self) -> None:
        try:
            self._results.append(await self._work())
        except asyncio.CancelledError as error:
            if not self._cancelled:
                return  # the interpreter ends, and with it whoever waits: a thread that it does not wait for
            self._error = error
        except BaseException as error:  # whoever waits is told
            self._error = error
        self._calls.put(None)

    def result(self) -> T:
        """Wait, make the calls that the work asks for, and return its result.

        Raises
        ------
        BaseException
            What the work raises; or what a call raises or a signal brings, and then the work is cancelled.
        """
        try:
            self._wait(None)
        except BaseException:
            with suppress(RuntimeError):  # a loop that is closed has cancelled it
                self._loop.call_soon_threadsafe(self._cancel)
                self._wait(_WAIT)
            raise
        if self._error is not None:
            try:
                raise self._error
            finally:
                self._error = None  # or the traceback would keep itself
        return self._results.pop()

    def _wait(self, seconds: float | None) -> None:
        """Wait until the work has ended; with `seconds` at most so long, and without calls."""
        while True:
            try:
                call = self._calls.get(timeout=_WAIT)
            except Empty:
                if seconds is not None:
                    return
                continue
            if call is None:
                return
            if seconds is None:
                call()

    def _cancel(self) -> None:
        self._cancelled = True
        if self._task is not None:
            self._task.cancel()


class LoopThread:
    """A thread with an event loop."""

    def __init__(self) -> None:
        self._process = os.getpid()
        self._loop = asyncio.new_event_loop()
        self._held: set[Closing] = set()
        self._thread = threading.Thread(target=self._loop.run_forever, name="lodestream-loop", daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the thread is of this process, not of the one that was forked."""
        return self._process == os.getpid()

    def begin(self, work: Work[T], calls: Calls | None = None) -> Turn[T]:
        """Begin work, after all work that was begun before; see `Turn`.

        Raises
        ------
        RuntimeError
            If the process was forked since, or the interpreter ends.
        """
        if not self.alive:
            raise RuntimeError("expected a stream of this process, got one that was opened before a fork")
        return Turn(self._loop, work, calls)

    def run(self, work: Work[T], calls: Calls | None = None) -> T:
        """Carry out work, and return its result; errors as of `Turn.result` and `begin`."""
        return self.begin(work, calls).result()

    def hold(self, closing: Closing) -> None:
        """Close something at the end of the interpreter, unless it is released before."""
        self._held.add(closing)

    def release(self, closing: Closing) -> None:
        """Close something that is held, and that nobody uses any more, without waiting."""
        if closing in self._held:
            self._held.discard(closing)
            with suppress(RuntimeError):  # the loop is closed, and has closed this
                self._loop.call_soon_threadsafe(self._close, closing)

    def _close(self, closing: Closing) -> None:
        task = self._loop.create_task(closing.close())
        task.add_done_callback(lambda task: task.cancelled() or task.exception())  # of no concern to anybody

    def end(self) -> None:
        """Cancel all work, close what is held, and end the thread."""
        self._loop.call_soon_threadsafe(lambda: self._loop.create_task(self._end()))
        self._thread.join(2 * _END)
        if not self._thread.is_alive():
            self._loop.close()

    async def _end(self) -> None:
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        closing = [asyncio.create_task(held.close()) for held in self._held]
        if waited := [*others, *closing]:
            await asyncio.wait(waited, timeout=_END)
        await self._loop.shutdown_asyncgens()
        self._loop.stop()


def relayed(call: Callable[..., object], calls: Calls) -> Callable[..., None]:
    """Return a function for the loop that has the waiting thread call `call`, without waiting for it."""

    def relay(*given: Any) -> None:
        calls.put(lambda: call(*given))

    return relay


_current: LoopThread | None = None
_making = threading.Lock()


def current() -> LoopThread:
    """Return the thread of this process."""
    global _current
    with _making:
        if _current is None:
            _current = LoopThread()
        return _current


def release(closing: Closing) -> None:
    """Close something that this process holds; see `LoopThread.release`. What another one holds is its own."""
    if _current is not None:
        _current.release(closing)


def _forget() -> None:
    # Nothing of the other process's loop may be touched: both have the same sockets, and the same epoll.
    global _current, _making
    _current, _making = None, threading.Lock()


def _end() -> None:
    if _current is not None:
        _current.end()


atexit.register(_end)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
