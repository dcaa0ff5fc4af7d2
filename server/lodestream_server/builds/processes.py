"""Calling functions in separate processes, each with one call and only the rights that the call needs.

The processes are forked from one that has loaded everything and has read no untrusted data (`forkserver`). If one of
them dies, the others continue, and the next call gets a new one.

The answer of such a process is not trusted: it is JSON of bounded length, which must have the type that the function
returns, or it is refused.
"""

from __future__ import annotations

import asyncio
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict
from textwrap import indent
from typing import Any, Final, get_type_hints

from pydantic import TypeAdapter, ValidationError
from pydantic_core import to_json

from lodestream.errors import LodestreamError

from .forkserver import Allowed

__all__ = [
    "Allowed",
    "Call",
    "ForkServer",
    "Pool",
    "ProcessDiedError",
    "UnforeseenError",
    "WrongAnswerError",
    "reason_of",
]

# A process may die between the last look at it and the call; one that dies again and again has another reason.
_STARTS: Final = 3

_LOOK_SECONDS = 0.1
_LAST_SECONDS = 5.0

_LONGEST_ANSWER = 256 << 10
_LONGEST_MESSAGE = 64 << 10
_LONGEST_KIND = 100
_LONGEST_REASON = 2000

# What processes that read strangers' files find in their environment: no secret of whoever started the server.
_ENVIRONMENT = ("HOME", "LANG", "LD_LIBRARY_PATH", "LD_PRELOAD", "PATH", "TMPDIR", "TZ", "XDG_CACHE_HOME")
_ENVIRONMENT_PREFIXES = ("CPL_", "GDAL_", "HDF5_", "LC_", "PROJ_", "PYTHON")

# Threads of libraries would not be there in a process that is forked, and a build has one processor.
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("MKL", "OMP", "OPENBLAS")}

_PROGRAM = "import json, sys; sys.path[:] = json.loads(sys.argv.pop()); from {module} import main; main()"


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
        code = "" if exitcode is None else f" (exit code {exitcode}{name})"
        super().__init__(f"the process ended before it was done{code}")
        self.exitcode = exitcode


class WrongAnswerError(ProcessDiedError):
    """The process gave an invalid answer, or did not make what it claims."""

    def __init__(self, words: str) -> None:
        super().__init__(0)
        self.args = (f"the process gave an invalid answer: {words}",)


class UnforeseenError(LodestreamError):
    """The function raised an exception.

    Attributes
    ----------
    kind : str
        Name of the exception's class.
    errno : int or None
        Error number of an OSError.
    traceback : str
        As the process reports it, with a bar before each line.
    """

    def __init__(self, kind: str, errno: int | None, traceback: str) -> None:
        super().__init__(f"the function raised {kind}")
        self.kind = kind
        self.errno = errno
        self.traceback = traceback


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
        self._process: _Process | None = None
        self._ended = False

    @property
    def ended(self) -> bool:
        """Whether nobody waits for it any more."""
        return self._ended

    def attach(self, process: _Process | None) -> None:
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


class _Started:
    """A fork server that was started, and what it has said since."""

    def __init__(self, process: subprocess.Popen[bytes], control: socket.socket) -> None:
        self.process = process
        self.control = control
        self.settled = threading.Event()
        self.confinement: tuple[str, ...] | None = None
        self.problem: str | None = None
        self.ready = False
        threading.Thread(target=self._listen, name="lodestream-forkserver", daemon=True).start()

    def _listen(self) -> None:
        try:
            self.confinement = tuple(self._message()["confinement"])
            self.problem = self._message()["problem"]
            self.ready = True
        except (EOFError, OSError):
            pass
        finally:
            self.settled.set()

    def _message(self) -> dict[str, Any]:
        text = self.control.recv(_LONGEST_MESSAGE)
        if not text:
            raise EOFError
        message: dict[str, Any] = json.loads(text)
        return message

    def end(self) -> None:
        self.process.kill()
        self.process.wait()
        self.settled.wait()
        self.control.close()


class ForkServer:
    """The process from which others are forked; started when first needed, and again after it has died.

    Parameters
    ----------
    preload : callable or None
        Called in it without arguments before it forks for the first time; it imports what calls need.
    """

    def __init__(self, preload: Callable[[], object] | None = None) -> None:
        self._preload = "" if preload is None else _name(preload)
        self._lock = threading.Lock()
        self._started: _Started | None = None
        self._closed = False

    @property
    def pid(self) -> int | None:
        """Number of its process, once it is started."""
        return None if self._started is None else self._started.process.pid

    @property
    def confinement(self) -> tuple[str, ...] | None:
        """How the kernel confines the processes of calls, see `lodestream.confinement`; None before it is known."""
        return None if self._started is None else self._started.confinement

    def wait(self, given_up: Callable[[], bool] = lambda: False) -> str | None:
        """Start it, and wait until it is ready, or until `given_up` returns True.

        Returns
        -------
        str or None
            What went wrong in `preload`, if anything did.

        Raises
        ------
        ProcessDiedError
            If it ended, or was closed.
        OSError
            If it could not be started.
        """
        started = self._running()
        while not started.settled.wait(_LOOK_SECONDS):
            if given_up():
                return None
        if not started.ready:
            raise ProcessDiedError(self._exitcode(started))
        return started.problem

    def fork(self, request: bytes) -> _Process:
        """Fork a process for a call.

        Raises
        ------
        ProcessDiedError
            If there is no fork server; the next call starts another one.
        OSError
        """
        started = self._running()
        ours, theirs = socket.socketpair()
        answer, end = os.pipe()
        try:
            with self._lock:
                socket.send_fds(started.control, [b"c"], [theirs.fileno(), end])
        except OSError:
            ours.close()
            os.close(answer)
            raise ProcessDiedError(self._exitcode(started)) from None
        finally:
            # The process has them alone, so that its death is an end of file here.
            theirs.close()
            os.close(end)
        return _Process(ours, answer, request)

    def close(self) -> None:
        """End it, with all processes that were forked from it."""
        with self._lock:
            self._closed = True
            started = self._started
        if started is not None:
            started.end()

    def _running(self) -> _Started:
        with self._lock:
            if self._closed:
                raise ProcessDiedError(None)
            if self._started is not None and self._started.process.poll() is not None:
                self._started.end()
                self._started = None
            if self._started is None:
                self._started = self._start()
            return self._started

    def _start(self) -> _Started:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        program = _PROGRAM.format(module=Allowed.__module__)
        path = json.dumps([place or os.getcwd() for place in sys.path])
        environment = {
            name: value
            for name, value in os.environ.items()
            if name in _ENVIRONMENT or name.startswith(_ENVIRONMENT_PREFIXES)
        }
        command = [sys.executable, "-c", program, str(theirs.fileno()), self._preload, path]
        try:
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, env=environment | _ONE_THREAD, pass_fds=(theirs.fileno(),)
            )
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
        return _Started(process, ours)

    def _exitcode(self, started: _Started) -> int | None:
        with suppress(subprocess.TimeoutExpired):
            return started.process.wait(_LAST_SECONDS)
        return None


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
        self._busy: set[_Process] = set()
        self._closed = False

    async def run(self, call: Call) -> Any:
        """Make a call when a place is free; returns what the function returns.

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
        request = to_json({"function": _name(call.function), "args": call.args, "allowed": allowed})
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
                    return _result(call.function, process.finish(call.seconds))
            finally:
                call.attach(None)
                self._remove(process)
        raise died

    def _add(self, process: _Process) -> None:
        with self._lock:
            self._busy.add(process)
            if self._closed:
                process.kill()

    def _remove(self, process: _Process) -> None:
        with self._lock:
            self._busy.discard(process)
        process.end()


class _Process:
    """A process that was forked for a call: the connection to whoever forked it, and the pipe of its answer."""

    def __init__(self, connection: socket.socket, answer: int, request: bytes) -> None:
        self._connection = connection
        self._lines = connection.makefile("rb")
        self._answer = answer
        self._request = request
        self._exitcode: int | None = None
        self._over = False

    def begin(self) -> bool:
        """Hand over the call; False when there is nobody to take it.

        Raises
        ------
        OSError
            When the system has no room for another process.
        """
        try:
            self._connection.sendall(len(self._request).to_bytes(8, "big") + self._request)
        except OSError:
            return False
        message = self._message()
        if "failed" in message:
            raise OSError(message["failed"], os.strerror(message["failed"]))
        return "begun" in message

    def finish(self, seconds: float | None) -> bytes:
        """The answer, once the process has ended."""
        until = None if seconds is None else time.monotonic() + seconds
        answer = self._read(until)
        if answer is None or not self._wait(self._connection.fileno(), until):
            self.end()
            if answer is None or self._exitcode == -signal.SIGKILL:
                raise TimeoutError
        self.end()
        if self._exitcode == -signal.SIGXCPU:
            raise TimeoutError("processor time")
        if self._exitcode != 0:
            raise ProcessDiedError(self._exitcode)
        return answer

    def kill(self) -> None:
        """Have it killed; from any thread."""
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_WR)

    def end(self) -> None:
        """Kill it, and wait for its end; nothing of it is left then."""
        if self._over:
            return
        self._over = True
        self.kill()
        while message := self._message():
            self._exitcode = message.get("ended", self._exitcode)
        if self._exitcode is None:  # the fork server has died, and it with it, though perhaps not yet
            self._drain(time.monotonic() + _LAST_SECONDS)
        self._lines.close()
        self._connection.close()
        os.close(self._answer)

    def _read(self, until: float | None) -> bytes | None:
        """All that it says; None when it takes too long."""
        data = bytearray()
        while len(data) <= _LONGEST_ANSWER:
            if not self._wait(self._answer, until):
                return None
            piece = os.read(self._answer, 1 << 16)
            if not piece:
                return bytes(data)
            data += piece
        raise WrongAnswerError(f"expected at most {_LONGEST_ANSWER} bytes")

    def _drain(self, until: float) -> None:
        while self._wait(self._answer, until) and os.read(self._answer, 1 << 16):
            pass

    def _wait(self, handle: int, until: float | None) -> bool:
        poll = select.poll()
        poll.register(handle, select.POLLIN)
        return bool(poll.poll(None if until is None else max(0.0, 1000 * (until - time.monotonic()))))

    def _message(self) -> dict[str, int]:
        """The next word of whoever forked it; nothing when they have gone."""
        try:
            line = self._lines.readline()
        except OSError:
            line = b""
        message: dict[str, int] = json.loads(line) if line.endswith(b"\n") else {}
        return message


def _name(function: Callable[..., Any]) -> str:
    return f"{function.__module__}:{function.__qualname__}"


def _result(function: Callable[..., Any], answer: bytes) -> Any:
    """What a function returned, or raised, by the word of its process."""
    try:
        told = json.loads(answer)
    except (ValueError, RecursionError):
        raise WrongAnswerError("expected JSON") from None
    match told:
        case {"returned": value}:
            kind = get_type_hints(function).get("return", Any)
            try:
                return TypeAdapter(kind).validate_python(value)
            except (ValidationError, RecursionError):
                raise WrongAnswerError(f"expected what {function.__name__} returns") from None
        case {"memory": str(words)}:
            raise MemoryError(words)
        case {"raised": {"kind": str(kind), "errno": int() | None as number, "traceback": str(text)}} if (
            kind.isidentifier() and len(kind) <= _LONGEST_KIND
        ):
            raise UnforeseenError(kind, number, indent(_printable(text), "| ", lambda line: True))
    raise WrongAnswerError("expected what was returned or raised")


def _printable(text: str) -> str:
    return "".join(character if character.isprintable() or character == "\n" else "?" for character in text)


def reason_of(text: str) -> str:
    """A reason given by a process, as one printable line of limited length."""
    words = " ".join("".join(character if character.isprintable() else " " for character in text).split(" "))
    return words if len(words) <= _LONGEST_REASON else words[: _LONGEST_REASON - 3] + "..."
