"""Call functions in separate processes, which have only the rights that the calls need.

The processes are forked from one that has loaded everything and has read no untrusted data (`fork_server`). There are
two kinds of worker: one forks a process for each call (`Pool`); the other keeps one, whose caches make its next answer
cheap (`Keeper`). If a process dies, others continue, and the next call gets a new one.

The answer of such a process is not trusted: it is JSON of bounded length, which must have the type that the function
returns, or it is refused.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import pickle
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import Pipe, forkserver, reduction
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

from .answers import LONGEST_ANSWER, ProcessDiedError, WrongAnswerError, result_of
from .fork_server import LONGEST_REQUEST, Allowed, Order, main

assert sys.platform == "linux"  # no other system has what follows

__all__ = ["ONE_THREAD", "Call", "ForkServer", "Keeper", "Pool", "Question", "Started", "Worker", "new_listener"]

# A process may die between the last look at it and the call; one that dies again and again has another reason.
_STARTS: Final = 3
_LOOK_SECONDS = 0.05
_LAST_SECONDS = 5.0
_GROUP_SECONDS = 0.001

# What processes that read strangers' files find in their environment: no secret of whoever started the server.
_ENVIRONMENT = ("HOME", "LANG", "LD_LIBRARY_PATH", "LD_PRELOAD", "PATH", "TMPDIR", "TZ", "XDG_CACHE_HOME")
_ENVIRONMENT_PREFIXES = ("CPL_", "GDAL_", "HDF5_", "LC_", "PROJ_", "PYTHON")

#: Threads of libraries would not be there in a process that is forked, and a build has one processor.
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("MKL", "OMP", "OPENBLAS")}

_PROGRAM = "import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); pickle.load(sys.stdin.buffer)()"


def new_listener() -> tuple[socket.socket, int]:
    """Return a socket that listens, and a handle by which alone one connects to it: it has no name any more."""
    with tempfile.TemporaryDirectory(prefix="lodestream-") as folder, socket.socket(socket.AF_UNIX) as listener:
        inside = os.open(folder, os.O_PATH)  # a socket's name has at most 107 bytes
        try:
            name = f"/proc/self/fd/{inside}/socket"
            listener.bind(name)
            listener.listen()
            return listener.dup(), os.open(name, os.O_PATH)
        finally:
            os.close(inside)


@dataclass
class Started:
    """A fork server that was started.

    Attributes
    ----------
    process : Popen
        With pipes as its standard input and output.
    address : int
        Handle of its listener, see `new_listener`.
    told : dict or None
        What it has said, see `fork_server.main`; None before that.
    """

    process: Any
    address: int
    told: dict[str, Any] | None = None

    def end(self) -> int:
        """End the fork server with its calls, wait for their end, and return its exit code."""
        if self.told is None:
            self.process.kill()
        self.process.stdin.close()
        self.process.stdout.close()
        os.close(self.address)
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(_LAST_SECONDS)
        self.process.kill()
        code: int = self.process.wait()
        return code


class ForkServer:
    """The process from which others are forked; started when first needed, and again after it has died.

    Parameters
    ----------
    preload : callable or None
        Called in it without arguments before it forks for the first time; it imports what calls need.
    """

    def __init__(self, preload: Callable[[], object] | None = None) -> None:
        self._preload = preload
        self._lock = threading.Lock()
        self._started: Started | None = None
        self._closed = False

    @property
    def pid(self) -> int | None:
        """Number of the fork server's process, once it is started."""
        return None if self._started is None else self._started.process.pid

    @property
    def confinement(self) -> tuple[str, ...] | None:
        """How the kernel confines the processes of calls, see `lodestream.confinement`; None before it is known."""
        started = self._started  # another thread may end it meanwhile
        return None if started is None or started.told is None else tuple(started.told["confinement"])

    def wait(self, given_up: Callable[[], bool] = lambda: False) -> str | None:
        """Start the fork server, and wait until it is ready, or until `given_up` returns True.

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
        while not given_up():
            with self._lock:
                told = self._told()
            if told is not None:
                problem: str | None = told["problem"]
                return problem
        return None

    def fork(self, call: Call, *, is_kept: bool = False) -> Process:
        """Fork a process for a call, or one that stays and is asked (`Process.ask`).

        Raises
        ------
        ProcessDiedError
            If there is no fork server, or it is not ready; `wait` starts another one.
        OSError
            If the system has no room for more.
        """
        with self._lock:
            started = self._started
            if started is None or started.told is None:
                raise ProcessDiedError(None)
            address = os.dup(started.address)
        confinement = tuple(started.told["confinement"])
        seconds = None if is_kept else call.seconds
        parent = started.process.pid
        order = Order(call.function, call.args, call.allowed, seconds, parent, confinement, is_kept)
        try:
            return _fork(order, address)
        except (ConnectionError, EOFError):
            with suppress(subprocess.TimeoutExpired):
                started.process.wait(_LAST_SECONDS)
            code = started.process.poll()
            if code is not None and code > 0:
                raise OSError(code, os.strerror(code)) from None
            raise ProcessDiedError(code) from None
        finally:
            os.close(address)

    def close(self) -> None:
        """End the fork server, with all processes that were forked from it."""
        with self._lock:
            self._closed = True
            self._end()

    def _end(self) -> int | None:
        started, self._started = self._started, None
        return None if started is None else started.end()

    def _told(self) -> dict[str, Any] | None:
        """Return what the fork server has said; wait a moment if it has said nothing yet, which is None."""
        if self._closed:
            raise ProcessDiedError(None)
        if self._started is not None and self._started.process.poll() is not None:
            self._end()
        if self._started is None:
            self._started = self._start()
        started = self._started
        if started.told is None and wait([started.process.stdout], _LOOK_SECONDS):
            line = started.process.stdout.readline()
            if not line.endswith(b"\n"):
                raise ProcessDiedError(self._end())
            started.told = json.loads(line)
        return started.told

    def _start(self) -> Started:
        environment = {
            name: value
            for name, value in os.environ.items()
            if name in _ENVIRONMENT or name.startswith(_ENVIRONMENT_PREFIXES)
        }
        listener, address = new_listener()
        with listener:
            try:
                process = subprocess.Popen(
                    [sys.executable, "-P", "-c", _PROGRAM],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    bufsize=0,
                    env=environment | ONE_THREAD,
                    pass_fds=(listener.fileno(),),
                )
            except BaseException:
                os.close(address)
                raise
            program = partial(main, self._preload, listener.fileno())
        path = [place or os.getcwd() for place in sys.path]
        started = Started(process, address)
        with suppress(BrokenPipeError):  # it has died already
            started.process.stdin.write(pickle.dumps(path) + pickle.dumps(program))
        return started


def _fork(order: Order, address: int) -> Process:
    text = pickle.dumps({}) + pickle.dumps(order)  # the first changes nothing in the process
    answer: Connection | socket.socket
    answer, its_answer = socket.socketpair() if order.is_kept else Pipe(duplex=False)
    status, its_status = Pipe(duplex=False)
    its_orders, orders = Pipe(duplex=False)
    try:
        with orders, open(orders.fileno(), "wb", closefd=False) as file:
            # The process has them alone, so that its death is an end of file here.
            with its_answer, its_status, its_orders, socket.socket(socket.AF_UNIX) as client:
                client.connect(f"/proc/self/fd/{address}")
                # Two more stand for what processes of the standard library get, and this one has no use for.
                handles = [its_orders, its_status, its_orders, its_orders, its_answer]
                reduction.sendfds(client, [each.fileno() for each in handles])
            file.write(text)
        return Process(forkserver.read_signed(status.fileno()), status, answer)
    except BaseException:
        answer.close()
        status.close()
        raise


@dataclass(frozen=True)
class Process:
    """A process that was forked for a call; one thread waits for it.

    Attributes
    ----------
    number : int
        Of the process, and of its group.
    status : Connection
        From the fork server, which writes its exit code when it has ended.
    answer : Connection or socket
        From the process.
    """

    number: int
    status: Connection
    answer: Connection | socket.socket

    def finish(self, call: Call) -> bytes:
        """Wait for the end of the process with all that it has started, and return its answer.

        Raises
        ------
        TimeoutError
            If it has not ended after the seconds of the call, or has used up its processor time; it is killed.
        ProcessDiedError
            If it ended with another exit code than 0, or was killed since the call has ended.
        WrongAnswerError
            If the answer is too long.
        """
        until = math.inf if call.seconds is None else time.monotonic() + call.seconds
        try:
            answer = self._read(call, until)
            late = answer is None or not _ready([self.status], call, until)
        finally:
            code = self.end()
        if not call.ended and (answer is None or (late and code == -signal.SIGKILL)):
            raise TimeoutError
        if code == -signal.SIGXCPU:
            raise TimeoutError("processor time")
        if code != 0 or answer is None:
            raise ProcessDiedError(code)
        return answer

    def _read(self, call: Call, until: float) -> bytes | None:
        """Return the whole answer of the process; None when it takes too long."""
        data = bytearray()
        while len(data) <= LONGEST_ANSWER:
            piece = self._piece(call, until)
            if not piece:
                return None if piece is None else bytes(data)
            data += piece
        raise WrongAnswerError(f"expected at most {LONGEST_ANSWER} bytes")

    def _piece(self, call: Call, until: float) -> bytes | None:
        """Return what has come of an answer, nothing at its end; None when it takes too long."""
        while ready := _ready([self.answer, self.status], call, until):
            if self.answer in ready:
                try:
                    return os.read(self.answer.fileno(), 1 << 16)
                except ConnectionResetError:  # it was killed before it had read what it was asked
                    return b""
            self._end_group()  # the process has ended; what it has left behind keeps its pipe open
        return None

    def ask(self, service: Call, question: Question) -> bytes:
        """Ask a process that is kept, and return its answer.

        Raises
        ------
        TimeoutError
            If it takes longer than the seconds of the service.
        ProcessDiedError
            If it has ended, or its answer is too long (`WrongAnswerError`).
        OSError
            If the file of the question cannot be opened.
        """
        assert isinstance(self.answer, socket.socket), "it is kept"
        until = math.inf if service.seconds is None else time.monotonic() + service.seconds
        request = json.dumps(question.args).encode()
        assert len(request) <= LONGEST_REQUEST, "orders are short"
        with question.path.open("rb") as file:
            try:
                # A process that does not read stops nobody: the request before was answered, so that this one fits.
                socket.send_fds(self.answer, [request], [file.fileno()], socket.MSG_DONTWAIT)
            except OSError:
                raise ProcessDiedError(None) from None
        data, size = bytearray(), 4
        while len(data) < size:
            piece = self._piece(service, until)
            if piece is None:
                raise TimeoutError
            if not piece:
                raise ProcessDiedError(None)
            data += piece
            if len(data) >= 4:
                size = 4 + int.from_bytes(data[:4], "little")
            if max(size, len(data)) > question.longest:
                raise WrongAnswerError(f"expected at most {question.longest} bytes")
        if len(data) > size:
            raise WrongAnswerError("expected one answer")
        return bytes(data[4:])

    def end(self) -> int | None:
        """Kill the process and all that it has started, wait for their end, and return the exit code."""
        with self.status, self.answer:
            if not wait([self.status], 0):  # otherwise its number may be another's
                with suppress(ProcessLookupError):
                    os.kill(self.number, signal.SIGKILL)
            code: int | None = None
            with suppress(EOFError):  # the fork server has died, and it with it
                code = forkserver.read_signed(self.status.fileno())
            self._end_group()
            return code

    def _end_group(self) -> None:
        """Kill what the process has started, and wait for its end: until then it might still write."""
        until = time.monotonic() + _LAST_SECONDS
        # The system gives numbers in turn: this one is nobody else's yet.
        with suppress(ProcessLookupError, PermissionError):
            while time.monotonic() < until:
                os.killpg(self.number, signal.SIGKILL)
                time.sleep(_GROUP_SECONDS)


def _ready(pipes: list[Connection | socket.socket], call: Call, until: float) -> list[Any]:
    """Wait until a pipe can be read; return those that can: none when it is too late, or nobody waits for the call."""
    while not call.ended and (left := until - time.monotonic()) > 0:
        if ready := wait(pipes, min(left, _LOOK_SECONDS)):
            return ready
    return []


@dataclass(eq=False)
class Call:
    """One call of a function in a separate process.

    Attributes
    ----------
    function : callable
        A function of a module, found by its name. Its result is a JSON value, or a type that pydantic makes from one by
        the function's annotation.
    args : tuple
        What can be pickled.
    seconds : float or None
        Limit on its duration and on its processor time.
    before : callable or None
        Called in this process when a process is free, before the call begins.
    allowed : Allowed
        Rights and limits of its process; by default none.
    begun : threading.Event
        Set when a process runs the call.
    ended : bool
        Set when nobody waits for it any more: its process is killed.
    """

    function: Callable[..., Any]
    args: tuple[Any, ...] = ()
    seconds: float | None = None
    before: Callable[[], object] | None = None
    allowed: Allowed = field(default_factory=Allowed)
    begun: threading.Event = field(default_factory=threading.Event, init=False)
    ended: bool = field(default=False, init=False)


@dataclass(eq=False)
class Question:
    """What a process that is kept is asked.

    Attributes
    ----------
    function : callable
        Its annotation says of which type the answer must be.
    args : tuple
        JSON values, at most `LONGEST_REQUEST` bytes.
    path : Path
        A file of which the process gets a descriptor.
    longest : int
        Bytes of the longest answer.
    ended : bool
        Set when nobody waits for it any more.
    """

    function: Callable[..., Any]
    args: tuple[Any, ...]
    path: Path
    longest: int = LONGEST_ANSWER
    ended: bool = field(default=False, init=False)


_Call = TypeVar("_Call", Call, Question)


class Worker(ABC, Generic[_Call]):
    """Makes up to ``size`` calls at a time, each in a thread that waits for the process.

    Parameters
    ----------
    size : int
    server : ForkServer
        May be shared; it is closed by whoever created it.
    """

    def __init__(self, size: int, server: ForkServer) -> None:
        self._server = server
        self._threads = ThreadPoolExecutor(size, "lodestream-process")
        self._calls: set[_Call] = set()
        self._closed = False

    async def run(self, call: _Call) -> Any:
        """Make a call when a place is free, and return its result.

        Cancelling it ends the call, which has ended when this raises.

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
            If no process could be started, or from `Call.before`, or if the file of a question cannot be opened.
        """
        self._calls.add(call)
        try:
            future = self._threads.submit(self._run, call)
            waiting = asyncio.wrap_future(future)
            return await asyncio.shield(waiting)
        except asyncio.CancelledError:
            call.ended = True
            if not future.cancel():
                await asyncio.wait((waiting,))
                waiting.exception()  # nobody wants to know any more
            raise
        finally:
            self._calls.discard(call)

    def close(self) -> None:
        """Kill all processes; their calls raise `ProcessDiedError`."""
        self._closed = True
        for call in self._calls.copy():
            call.ended = True
        self._threads.shutdown(wait=True, cancel_futures=True)

    @abstractmethod
    def _run(self, call: _Call) -> Any:
        """Make a call, in a thread; return and raise as `run` does."""

    def _fork(self, call: Call, *, is_kept: bool = False) -> Process:
        """Fork a process as soon as the fork server is ready."""
        call.ended |= self._closed
        died, ready = ProcessDiedError(None), False
        for _ in range(_STARTS):
            try:
                self._server.wait(lambda: call.ended)
                if call.ended:
                    break
                if call.before is not None and not ready:
                    call.before()
                ready = True
                return self._server.fork(call, is_kept=is_kept)
            except ProcessDiedError as error:
                died = error
        raise died


class Pool(Worker[Call]):
    """Forks a process for each call. Cancelling a call kills its process, which has ended then."""

    def _run(self, call: Call) -> Any:
        process = self._fork(call)
        call.begun.set()
        return result_of(call.function, process.finish(call))


class Keeper(Worker[Question]):
    """Asks one process, which stays: it is forked when it is first needed, and anew after a crash or many questions.

    So what a file does to its reader lasts for so many questions at most. A question that was begun is answered, also
    if nobody waits for it any more.

    Parameters
    ----------
    server : ForkServer
    service : Call
        Its function returns the one that answers: from the arguments of a question and a descriptor of its file, which
        is closed afterwards. Its seconds are those of one answer.
    most : int
        Questions to one process.
    """

    def __init__(self, server: ForkServer, service: Call, most: int) -> None:
        super().__init__(1, server)
        self._service = service
        self._most = most
        self._process: Process | None = None
        self._asked = 0

    @property
    def pid(self) -> int | None:
        """Number of the process, once there is one."""
        return None if self._process is None else self._process.number

    def close(self) -> None:
        """Kill the process."""
        self._service.ended = True
        super().close()
        self._end()

    def _run(self, call: Question) -> Any:
        if call.ended or self._closed:
            raise ProcessDiedError(None)
        try:
            return self._ask(call)
        except ProcessDiedError as error:
            # It may have died since its last answer.
            if isinstance(error, WrongAnswerError) or self._closed:
                raise
        except MemoryError:
            # What it kept of other questions may have been too much beside this one.
            if self._asked == 1 or self._closed:
                raise
        return self._ask(call)

    def _ask(self, question: Question) -> Any:
        if self._process is None:
            self._process, self._asked = self._fork(self._service, is_kept=True), 0
        self._asked += 1
        try:
            result = result_of(question.function, self._process.ask(self._service, question))
        except BaseException:
            self._end()
            raise
        if self._asked >= self._most:
            self._end()
        return result

    def _end(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.end()
