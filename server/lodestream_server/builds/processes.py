"""Call functions in separate processes, each with one call and only the rights that the call needs.

The processes are forked from one that has loaded everything and has read no untrusted data (`forkserver`). If one of
them dies, the others continue, and the next call gets a new one.

The answer of such a process is not trusted: it is JSON of bounded length, which must have the type that the function
returns, or it is refused.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from typing import Any, Final

from pydantic_core import to_json

from .answers import ProcessDiedError, name_of, result_of
from .fork_control import ForkServer, Process
from .forkserver import Allowed

__all__ = ["Call", "Pool"]

# A process may die between the last look at it and the call; one that dies again and again has another reason.
_STARTS: Final = 3


class Call:
    """One call of a function in a separate process.

    Parameters
    ----------
    function : callable
        A function of a module, found by its name. Arguments and result are JSON values, or types that pydantic makes
        from them by the function's annotations: paths, tuples, dataclasses.
    args : tuple
    seconds : float or None
        Limit on its duration and on its processor time.
    before : callable or None
        Called in this process when a process is free, before the call begins.
    allowed : Allowed
        Rights and limits of its process; by default none.

    Attributes
    ----------
    begun : threading.Event
        Set when a process runs the call.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        args: tuple[Any, ...] = (),
        seconds: float | None = None,
        before: Callable[[], object] | None = None,
        allowed: Allowed | None = None,
    ) -> None:
        self.function = function
        self.args = args
        self.seconds = seconds
        self.before = before
        self.allowed = Allowed() if allowed is None else allowed
        self.begun = threading.Event()
        self._lock = threading.Lock()
        self._process: Process | None = None
        self._ended = False

    @property
    def ended(self) -> bool:
        """Whether nobody waits for it any more."""
        return self._ended

    def attach(self, process: Process | None) -> None:
        """Set the process that runs it now."""
        with self._lock:
            if self._ended and process is not None:
                process.kill()
            self._process = process

    def end(self) -> None:
        """Kill the process that runs it, now or as soon as there is one."""
        with self._lock:
            self._ended = True
            if self._process is not None:
                self._process.kill()


class Pool:
    """Runs up to ``size`` calls at a time.

    Parameters
    ----------
    size : int
    server : ForkServer
        May be shared; it is closed by whoever created it.
    """

    def __init__(self, size: int, server: ForkServer) -> None:
        self._server = server
        self._threads = ThreadPoolExecutor(size, "lodestream-process")
        self._lock = threading.Lock()
        self._busy: set[Process] = set()
        self._closed = False

    async def run(self, call: Call) -> Any:
        """Make a call when a place is free, and return its result.

        Cancelling it kills the process; the process has ended when this raises.

        Raises
        ------
        ProcessDiedError
            If the process ended, or gave an invalid answer (`WrongAnswerError`).
        TimeoutError
            If the call exceeded its seconds, or its processor time (then the error says so); its process was killed.
        MemoryError
            If the function ran out of memory.
        UnforeseenError
            If the function raised anything else.
        OSError
            If no process could be started, or from `before`.
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
        """Kill all processes; their calls raise `ProcessDiedError`."""
        with self._lock:
            self._closed = True
            for process in self._busy:
                process.kill()
        self._threads.shutdown(wait=True, cancel_futures=True)

    def _run(self, call: Call) -> Any:
        allowed = {**asdict(call.allowed), "seconds": call.seconds}
        request = to_json({"function": name_of(call.function), "args": call.args, "allowed": allowed})
        died, ready = ProcessDiedError(None), False
        for _ in range(_STARTS):
            if call.ended or self._closed:
                break
            try:
                self._server.wait(lambda: call.ended or self._closed)
                if call.ended or self._closed:
                    break
                if call.before is not None and not ready:
                    call.before()
                ready = True
                process = self._server.fork(request)
            except ProcessDiedError as error:
                died = error
                continue
            self._add(process)
            call.attach(process)
            try:
                if process.begin():
                    call.begun.set()
                    return result_of(call.function, process.finish(call.seconds))
            finally:
                call.attach(None)
                self._remove(process)
        raise died

    def _add(self, process: Process) -> None:
        with self._lock:
            self._busy.add(process)
            if self._closed:
                process.kill()

    def _remove(self, process: Process) -> None:
        with self._lock:
            self._busy.discard(process)
        process.end()
