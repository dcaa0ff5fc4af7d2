"""The fork server: a process that has loaded everything and reads no untrusted data.

The processes of calls are forked from it. It has one thread, so forking is safe. Each call gets a process of its own,
which gives up all rights that the call does not need before it begins (`lodestream.confinement`), and ends with it. So
whatever a file does to its reader is gone before the next file is read.

Calls arrive over one socket, each with a connection of its own and the pipe for its answer. Over its connection comes
the request. The fork server sends one line there when the process exists and one when it has ended. When the other side
closes the connection, the process is killed. The process itself sends its answer through the pipe, as JSON; the fork
server does not read it.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import json
import math
import os
import re
import selectors
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from inspect import signature
from operator import attrgetter
from pathlib import Path
from typing import Any, NoReturn, get_type_hints

from pydantic import TypeAdapter

from lodestream import parallel
from lodestream.confinement import Rights, available, confine
from lodestream.operating_system import lower_limit

from .answers import answer_of

assert sys.platform == "linux"  # no other system has what follows

__all__ = ["Allowed", "main", "receive_exactly", "resolve"]

_DIE_WITH_PARENT = 1  # PR_SET_PDEATHSIG
_INHERIT_ORPHANS = 36  # PR_SET_CHILD_SUBREAPER
_MOST_FILES = 256
_MOST_SECONDS = 2.0**31

_TRACEBACK = 20_000

# A process that computes gets a third of what one without this gets of a processor that both want.
_NICE = 5


@dataclass(frozen=True)
class Allowed:
    """Rights and limits of the process of a call.

    Attributes
    ----------
    read : tuple of Path
        Files and folders that it may read, in addition to Python and its libraries.
    write : Path or None
        A folder that it may write to, also used for temporary files.
    kept : Path or None
        Another one, which stays when this call has ended.
    processes : bool
        Whether it may start processes; each has the same limits.
    threads : int
        Threads of the kernels.
    memory : int or None
        Bytes of private writable memory beside what the process begins with; code and files mapped for reading do not
        count. Beyond it the process gets MemoryError or ends.
    seconds : float or None
        Processor time of each thread.
    file_bytes : int or None
        Largest file that it may write.
    """

    read: tuple[Path, ...] = ()
    write: Path | None = None
    kept: Path | None = None
    processes: bool = False
    threads: int = 1
    memory: int | None = None
    seconds: float | None = None
    file_bytes: int | None = None


@dataclass(frozen=True)
class _Request:
    function: str
    args: list[Any]
    allowed: Allowed


def main() -> None:
    """Fork for each call that arrives over a socket, whose number is the first argument, until it is closed."""
    control = socket.socket(fileno=int(sys.argv[1]))
    # Ctrl-C, and the end of a service, reach every process: this one is its parent's to end.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # Otherwise nobody would know when what a call has left behind has ended.
    ctypes.CDLL(None).prctl(_INHERIT_ORPHANS, 1)
    gc.disable()  # what is loaded stays
    parent = os.getppid()
    _say(control, {"confinement": _confinement()})
    with _ending_with(parent):
        problem = _preload(sys.argv[2]) if sys.argv[2] else None
    _say(control, {"problem": problem})
    _adapter(_Request)  # which takes longer to make than most calls
    gc.collect()
    gc.freeze()  # or the first collection in each process would copy every page
    gc.enable()
    _Server(control).run()


class _Server:
    """The calls that are under way, each with its connection and its process."""

    def __init__(self, control: socket.socket) -> None:
        self._control = control
        self._calls: dict[int, socket.socket] = {}
        self._selector = selectors.DefaultSelector()
        self._ended, self._wake = os.pipe()

    def run(self) -> None:
        """Serve until the other side has closed, then end all calls."""
        for end in (self._ended, self._wake):
            os.set_blocking(end, False)
        signal.set_wakeup_fd(self._wake, warn_on_full_buffer=False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        self._selector.register(self._control, selectors.EVENT_READ)
        self._selector.register(self._ended, selectors.EVENT_READ)
        while True:
            for key, _ in self._selector.select():
                if key.fileobj is self._control:
                    if not self._accept():
                        for process in self._calls:
                            _kill(process)
                        return
                elif key.fileobj == self._ended:
                    os.read(self._ended, 4096)
                    self._reap()
                elif self._calls.get(key.data) is key.fileobj:
                    # Whatever comes, the other side has no more to say than that it waits no longer.
                    _kill(key.data)
                    self._selector.unregister(key.fileobj)

    def _accept(self) -> bool:
        try:
            message, handles, _, _ = socket.recv_fds(self._control, 1, 2)
        except ConnectionError:
            return False
        if not message:
            return False
        connection = socket.socket(fileno=handles[0])
        try:
            length = int.from_bytes(receive_exactly(connection, 8), "big")
            request = receive_exactly(connection, length)
            self._start(request, connection, handles[1])
        except (OSError, EOFError):
            connection.close()
        finally:
            os.close(handles[1])
        return True

    def _start(self, request: bytes, connection: socket.socket, answer: int) -> None:
        parent = os.getpid()
        try:
            process = os.fork()
        except OSError as error:
            _tell(connection, {"failed": error.errno or 0})
            raise
        if not process:
            try:
                # Of what stands open here only the way of the answer goes along.
                connection.close()
                self._close()
                _become_a_call(parent, answer)
                _answer(answer, request)
            finally:
                os._exit(1)
        with suppress(OSError):
            os.setpgid(process, process)  # whoever comes first
        self._calls[process] = connection
        self._selector.register(connection, selectors.EVENT_READ, process)
        _tell(connection, {"begun": process})

    def _close(self) -> None:
        signal.set_wakeup_fd(-1)
        self._selector.close()
        for connection in (self._control, *self._calls.values()):
            connection.close()
        for end in (self._ended, self._wake):
            os.close(end)

    def _reap(self) -> None:
        for process, connection in list(self._calls.items()):
            options = os.WEXITED | os.WNOHANG | os.WNOWAIT
            if os.waitid(os.P_PID, process, options) is None:
                continue
            _kill(process)  # what it has left behind, as long as its number is its own
            status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
            _wait_for_group(process)
            del self._calls[process]
            with suppress(KeyError):
                self._selector.unregister(connection)
            _tell(connection, {"ended": status})
            connection.close()


def _kill(process: int) -> None:
    """Kill a process with all that it has started: they cannot leave its process group."""
    for kill in (os.killpg, os.kill):  # before it is in a group of its own there is nobody else
        with suppress(ProcessLookupError):
            kill(process, signal.SIGKILL)


def _wait_for_group(group: int) -> None:
    """Wait for the end of a killed process group: until then one of its processes might still write."""
    with suppress(ChildProcessError):
        while True:
            os.waitpid(-group, 0)


def _become_a_call(parent: int, answer: int) -> None:
    os.setpgid(0, 0)
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGCHLD):
        signal.signal(number, signal.SIG_DFL)
    nothing = os.open(os.devnull, os.O_RDWR)
    for standard in (0, 1, 2):  # the log is not its to write
        os.dup2(nothing, standard)
    most = os.sysconf("SC_OPEN_MAX")
    os.closerange(3, answer)
    os.closerange(answer + 1, most if most > 0 else 1 << 16)


def _answer(answer: int, text: bytes) -> NoReturn:
    with os.fdopen(answer, "wb", 0) as pipe:
        pipe.write(_call(text))
    os._exit(0)


def _call(text: bytes) -> bytes:
    def call() -> Any:
        request: _Request = _adapter(_Request).validate_json(text)
        function = resolve(request.function)
        args = _arguments(function, request.args)
        _limit(request.allowed)
        return function(*args)

    return answer_of(call)


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _arguments(function: Callable[..., Any], values: list[Any]) -> list[Any]:
    """Return the arguments of a function, converted from JSON values."""
    hints = get_type_hints(function)
    kinds = [hints.get(name, Any) for name in signature(function).parameters]
    return [_adapter(kind).validate_python(value) for kind, value in zip(kinds, values, strict=False)]


def _limit(allowed: Allowed) -> None:
    if allowed.write is not None:
        tempfile.tempdir = os.environ["TMPDIR"] = os.fspath(allowed.write)
    if allowed.memory is not None:
        # The libraries that are loaded already are the same pages for all processes.
        lower_limit("DATA", allowed.memory + _private_memory())
    if allowed.file_bytes is not None:
        lower_limit("FSIZE", allowed.file_bytes)
    lower_limit("NOFILE", _MOST_FILES)
    lower_limit("CORE", 0)
    if allowed.seconds is not None:
        most = math.ceil(min(time.process_time() + allowed.threads * allowed.seconds, _MOST_SECONDS))
        # The process gets SIGXCPU; if it goes on, it is killed.
        lower_limit("CPU", most, grace=1)
    write = tuple(path for path in (allowed.write, allowed.kept) if path is not None)
    os.environ[parallel.VARIABLE] = str(allowed.threads)
    os.nice(_NICE)  # streams come first
    expected = _confinement()
    held = confine(Rights(allowed.read, write, allowed.processes, allowed.threads > 1))
    if held != expected:
        raise RuntimeError(f"this process is confined by {held}, and not by {expected}, as the first one was")


def _private_memory() -> int:
    """Return the bytes of this process that count under RLIMIT_DATA; 0 on systems that do not tell."""
    try:
        text = Path("/proc/self/status").read_text()
    except OSError:
        return 0
    match = re.search(r"^VmData:\s+(\d+) kB$", text, re.MULTILINE)
    return int(match[1]) << 10 if match else 0


def resolve(name: str) -> Callable[..., Any]:
    """Return the function with this name, ``module:qualified.name``."""
    module, _, qualified = name.partition(":")
    function: Callable[..., Any] = attrgetter(qualified)(importlib.import_module(module))
    return function


def receive_exactly(connection: socket.socket, length: int) -> bytes:
    """Receive exactly so many bytes.

    Raises
    ------
    EOFError
        If fewer arrive.
    """
    data = bytearray()
    while len(data) < length:
        piece = connection.recv(length - len(data))
        if not piece:
            raise EOFError
        data += piece
    return bytes(data)


def _say(control: socket.socket, message: dict[str, Any]) -> None:
    # The other side may have gone; what is read next then says so.
    with suppress(OSError):
        control.send(json.dumps(message).encode())


def _tell(connection: socket.socket, message: dict[str, int]) -> None:
    with suppress(OSError):
        connection.send(json.dumps(message).encode() + b"\n")


@cache
def _confinement() -> tuple[str, ...]:
    """Return how the kernel confines processes. The processes of calls know it from the one that they come from."""
    return available()


def _preload(name: str) -> str | None:
    """Call the function of this name; return the reason if it failed."""
    try:
        resolve(name)()
    except Exception:
        return traceback.format_exc()[-_TRACEBACK:]
    return None


@contextmanager
def _ending_with(process: int) -> Iterator[None]:
    """Within the ``with`` block, end this process as soon as its parent is another than the given one."""

    def look(*_: object) -> None:
        if os.getppid() != process:
            os._exit(1)

    signal.signal(signal.SIGALRM, look)
    signal.setitimer(signal.ITIMER_REAL, 0.5, 0.5)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
