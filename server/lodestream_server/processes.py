"""Processes that call functions, one call at a time each; any of them may die without harm to the others.

Each process has a pipe of its own and shares no lock with anybody: whatever it was doing when it was killed, idling
included, the next call finds another one. Pools in libraries share a queue and its locks between their processes, and
one that is killed at the wrong moment, or merely while it idles, takes the pool with it.
"""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from typing import Any, Final

from lodestream.errors import LodestreamError

__all__ = ["Call", "Pool", "ProcessDiedError", "UnforeseenError"]

# A process gives memory back when it ends: a large call is not paid for by the small ones after it.
_CALLS_PER_PROCESS = 32

# A process may die between the last look at it and the call; one that dies again and again has another reason.
_STARTS: Final = 3

# Spawned, not forked: this process has threads.
_context = multiprocessing.get_context("spawn")


class ProcessDiedError(LodestreamError):
    """The process ended before the call did.

    Attributes
    ----------
    exitcode : int or None
        Its exit code; negative for the signal that ended it.
    """

    def __init__(self, exitcode: int | None) -> None:
        name = ""
        if exitcode is not None and exitcode < 0:
            name = f", {signal.Signals(-exitcode).name}" if -exitcode in set(signal.Signals) else ""
        super().__init__(f"the process ended before it was done (exit code {exitcode}{name})")
        self.exitcode = exitcode


class UnforeseenError(LodestreamError):
    """The function raised.

    Attributes
    ----------
    kind : str
        Name of the exception's class.
    errno : int or None
        Of an operating system's error, its number.
    traceback : str
    """

    def __init__(self, kind: str, errno: int | None, traceback: str) -> None:
        super().__init__(f"the function raised {kind}")
        self.kind = kind
        self.errno = errno
        self.traceback = traceback


class Call:
    """One call of a function in another process.

    Parameters
    ----------
    function : callable
        It can be pickled, as can its arguments and what it returns.
    args : tuple
    seconds : float or None
        Longest time that it may take.
    before : callable or None
        Called in this process when a process is free, before the call begins.

    Attributes
    ----------
    begun : threading.Event
        Set once a process works for it.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        args: tuple[Any, ...] = (),
        seconds: float | None = None,
        before: Callable[[], object] | None = None,
    ) -> None:
        self.function = function
        self.args = args
        self.seconds = seconds
        self.before = before
        self.begun = threading.Event()
        self._lock = threading.Lock()
        self._process: _Process | None = None
        self._ended = False

    @property
    def ended(self) -> bool:
        """Nobody waits for it any more."""
        return self._ended

    def attach(self, process: _Process | None) -> None:
        """Say which process works for it now."""
        with self._lock:
            if self._ended and process is not None:
                process.kill()
            self._process = process

    def end(self) -> None:
        """Kill the process that works for it, now or as soon as one does."""
        with self._lock:
            self._ended = True
            if self._process is not None:
                self._process.kill()


class Pool:
    """Up to ``size`` processes.

    Parameters
    ----------
    size : int
    prepare : callable or None
        Called without arguments in each process before anything else; it can be pickled.
    """

    def __init__(self, size: int, prepare: Callable[[], object] | None = None) -> None:
        self._prepare = prepare
        self._threads = ThreadPoolExecutor(size, "lodestream-process")
        self._lock = threading.Lock()
        self._idle: list[_Process] = []
        self._busy: set[_Process] = set()
        self._closed = False

    async def run(self, call: Call) -> Any:
        """Make a call when a process is free; what the function returns.

        Cancelling it kills the process, which has ended when this raises.

        Raises
        ------
        ProcessDiedError
            When the process ended.
        TimeoutError
            When the call took longer than its seconds; its process was killed.
        MemoryError
            When the function ran out of memory; its process is not used again.
        UnforeseenError
            When the function raised anything else.
        OSError
            When no process could be started, or from what is called before.
        """
        future = self._threads.submit(self._run, call)
        waiting = asyncio.wrap_future(future)
        try:
            return await asyncio.shield(waiting)
        except asyncio.CancelledError:
            call.end()
            if not future.cancel():
                await asyncio.wait((waiting,))
                waiting.exception()  # nobody wants to know any more
            raise

    def close(self) -> None:
        """Kill every process; calls that are under way raise `ProcessDiedError`."""
        with self._lock:
            self._closed = True
            processes = [*self._idle, *self._busy]
        for process in processes:
            process.kill()
        self._threads.shutdown(wait=True, cancel_futures=True)
        for process in processes:
            process.join()

    def _run(self, call: Call) -> Any:
        if call.before is not None:
            call.before()
        for _ in range(_STARTS):
            process = self._take()
            call.attach(process)
            try:
                if process.begin(call):
                    call.begun.set()
                    return process.finish(call)
            finally:
                call.attach(None)
                self._give_back(process)
            if call.ended:
                break
        raise ProcessDiedError(process.exitcode)

    def _take(self) -> _Process:
        with self._lock:
            while self._idle:
                process = self._idle.pop()
                if process.alive:
                    break
                process.join()
            else:
                process = _Process(self._prepare)
            self._busy.add(process)
            if self._closed:
                process.kill()
            return process

    def _give_back(self, process: _Process) -> None:
        with self._lock:
            self._busy.discard(process)
            if process.usable and not self._closed:
                self._idle.append(process)
                return
        process.kill()
        process.join()


class _Process:
    """A process and this side's end of its pipe."""

    def __init__(self, prepare: Callable[[], object] | None) -> None:
        self._pipe, theirs = _context.Pipe()
        self._process = _context.Process(target=_serve, args=(theirs, prepare), name="lodestream-build", daemon=True)
        self._calls = 0
        self._healthy = True
        try:
            self._process.start()
        finally:
            # The other end is the process's alone, so that its death is an end of file here.
            theirs.close()

    @property
    def alive(self) -> bool:
        return self._process.is_alive()

    @property
    def usable(self) -> bool:
        return self._healthy and self._calls < _CALLS_PER_PROCESS

    @property
    def exitcode(self) -> int | None:
        self._process.join()
        return self._process.exitcode

    def begin(self, call: Call) -> bool:
        """Hand over a call; False when there is nobody to take it any more."""
        self._calls += 1
        self._healthy = False
        try:
            self._pipe.send((call.function, call.args))
            self._pipe.recv()
        except (EOFError, OSError):
            return False
        return True

    def finish(self, call: Call) -> Any:
        """Wait for the end of the call that was begun."""
        try:
            if not self._pipe.poll(call.seconds):
                self.kill()
                raise TimeoutError
            kind, value = self._pipe.recv()
        except (EOFError, ConnectionError):
            raise ProcessDiedError(self.exitcode) from None
        if kind == "memory":
            raise MemoryError(value)
        self._healthy = True
        if kind == "raised":
            raise UnforeseenError(*value)
        return value

    def kill(self) -> None:
        self._healthy = False
        self._process.kill()

    def join(self) -> None:
        self._process.join()
        self._pipe.close()


def _serve(pipe: Connection, prepare: Callable[[], object] | None) -> None:
    # Ctrl-C reaches every process of a terminal: this one is its parent's to end.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_follow_parent, daemon=True).start()
    if prepare is not None:
        prepare()
    while True:
        try:
            function, args = pipe.recv()
            pipe.send("begun")
            answer = _call(function, args)
            pipe.send(answer)
        except (EOFError, OSError):
            return
        if answer[0] == "memory":
            return


def _call(function: Callable[..., Any], args: tuple[Any, ...]) -> tuple[str, Any]:
    # Not every exception survives the way between processes: its name and its text do.
    try:
        return "returned", function(*args)
    except MemoryError as error:
        return "memory", str(error)
    except Exception as error:
        return "raised", (type(error).__name__, getattr(error, "errno", None), traceback.format_exc())


def _follow_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        # Nobody waits for the result, and another server may already work in the folder.
        os._exit(1)
