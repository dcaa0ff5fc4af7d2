"""The fork server: a process that has loaded everything and reads no untrusted data.

The processes of calls are forked from it, by the standard library's loop (`multiprocessing.forkserver`). It has one
thread, so forking is safe. Each call gets a process of its own, which gives up all rights that the call does not need
before it begins (`lodestream.confinement`), and ends with it. So whatever a file does to its reader is gone before the
next file is read. What is unpickled here comes from the server; the answer of a call is JSON.
"""

from __future__ import annotations

import ctypes
import gc
import json
import math
import os
import re
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing import forkserver
from pathlib import Path
from socket import AF_UNIX, SOCK_STREAM, recv_fds, socket
from typing import Any, NoReturn

from lodestream import parallel
from lodestream.confinement import Rights, available, confine
from lodestream.operating_system import lower_limit

from .answers import answer_of

assert sys.platform == "linux"  # no other system has what follows

__all__ = ["LONGEST_REQUEST", "Allowed", "Order", "main"]

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
    file_bytes : int or None
        Largest file that it may write.
    """

    read: tuple[Path, ...] = ()
    write: Path | None = None
    kept: Path | None = None
    processes: bool = False
    threads: int = 1
    memory: int | None = None
    file_bytes: int | None = None


#: Longest request to a process that is kept, in bytes.
LONGEST_REQUEST = 4 << 10


@dataclass(frozen=True)
class Order:
    """A call for a new process; the server pickles it, and the standard library unpickles it there and runs it.

    Attributes
    ----------
    function : callable
    args : tuple
    allowed : Allowed
    seconds : float or None
        Processor time of each thread.
    parent : int
        Process of the fork server.
    confinement : tuple of str
        How the kernel must confine the process.
    is_kept : bool
        Whether the process stays: the function then returns another one, which answers requests, see `_serve`.
    """

    function: Callable[..., Any]
    args: tuple[Any, ...]
    allowed: Allowed
    seconds: float | None
    parent: int
    confinement: tuple[str, ...]
    is_kept: bool = False

    def _bootstrap(self, _: object) -> NoReturn:
        # The name is the standard library's. Nothing of it comes after this.
        try:
            answer = (forkserver.get_inherited_fds() or [])[0]
            _stand_alone(self.parent, answer)
            if self.is_kept:
                with socket(AF_UNIX, SOCK_STREAM, 0, answer) as ours:
                    _serve(ours, self._call())
            else:
                with os.fdopen(answer, "wb", 0) as pipe:
                    pipe.write(answer_of(self._call))
            os._exit(0)
        finally:
            os._exit(1)

    def _call(self) -> Any:
        _limit(self.allowed, self.seconds, self.confinement, descriptors=self.is_kept)
        return self.function(*self.args)


def _serve(ours: socket, respond: Callable[..., Any]) -> None:
    """Answer requests until the server closes its end.

    A request is the JSON of the arguments, in one message with the descriptor of a file, which is closed afterwards. An
    answer is the number of its bytes in four bytes, and JSON as of a process that ends (`answer_of`).
    """
    while True:
        message, descriptors, _, _ = recv_fds(ours, LONGEST_REQUEST, 1)
        if not message:
            return
        try:
            answer = answer_of(lambda: respond(*json.loads(message), *descriptors))  # noqa: B023  # called at once
        finally:
            for each in descriptors:
                os.close(each)
        _write(ours.fileno(), len(answer).to_bytes(4, "little") + answer)


def _write(descriptor: int, data: bytes) -> None:
    # Not `send`, which a confined process may not call.
    left = memoryview(data)
    while left:
        left = left[os.write(descriptor, left) :]


def main(preload: Callable[[], object] | None, listener: int) -> None:
    """Fork for each call until the standard input is closed; then end all calls, and exit.

    The exit code is 0, or the number of the system's error where it could not fork.

    The standard output gets one line of JSON when `preload` was called: how the kernel confines processes, and the
    traceback if the call failed.

    Parameters
    ----------
    preload : callable or None
        Imports what calls need.
    listener : int
        Socket over which processes are asked for, as the standard library does.
    """
    # Ctrl-C, and the end of a service, reach every process: this one is its parent's to end.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    # Otherwise nobody would know when what a call has left behind has ended.
    ctypes.CDLL(None).prctl(_INHERIT_ORPHANS, 1)
    warnings.filterwarnings("ignore", "forkserver: waitpid returned unexpected pid")  # which is one of those
    alive, told = os.dup(0), os.dup(1)
    os.dup2(2, 1)  # what a library prints is no message
    gc.disable()  # what is loaded stays
    message = {"confinement": available(), "problem": _problem(preload)}
    gc.collect()
    gc.freeze()  # or the first collection in each process would copy every page
    gc.enable()
    with suppress(BrokenPipeError), os.fdopen(told, "w") as pipe:
        pipe.write(json.dumps(message) + "\n")
    code = 0
    try:
        with suppress(SystemExit):
            forkserver.main(listener, alive, [])
    except OSError as error:  # there is no room for another process
        code = error.errno or 0
    except Exception:
        traceback.print_exc()
    _end_all()
    os._exit(code)


def _problem(preload: Callable[[], object] | None) -> str | None:
    """Call a function; return the reason if it failed."""
    try:
        if preload is not None:
            preload()
    except Exception:
        return traceback.format_exc()[-_TRACEBACK:]
    return None


def _end_all() -> None:
    """Kill all calls and what they have started, which come here when those have ended."""
    children = Path(f"/proc/self/task/{os.getpid()}/children")
    with suppress(FileNotFoundError, ChildProcessError):  # a kernel without that file: calls end with their parent
        while True:
            for process in children.read_text().split():
                os.kill(int(process), signal.SIGKILL)
            os.wait()


def _stand_alone(parent: int, answer: int) -> None:
    """Share nothing with the fork server but its memory, and end with it."""
    os.setpgid(0, 0)
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    os.umask(0o077)  # what it makes is for the server's user alone
    nothing = os.open(os.devnull, os.O_RDWR)
    for standard in (0, 1, 2):  # the log is not its to write
        os.dup2(nothing, standard)
    # What the standard library gives to its processes: pipes to them, to the fork server, and to other processes.
    most = os.sysconf("SC_OPEN_MAX")
    os.closerange(3, answer)
    os.closerange(answer + 1, most if most > 0 else 1 << 16)


def _limit(allowed: Allowed, seconds: float | None, expected: tuple[str, ...], *, descriptors: bool = False) -> None:
    if allowed.write is not None:
        tempfile.tempdir = os.environ["TMPDIR"] = os.fspath(allowed.write)
    if allowed.memory is not None:
        # The libraries that are loaded already are the same pages for all processes.
        lower_limit("DATA", allowed.memory + _private_memory())
    if allowed.file_bytes is not None:
        lower_limit("FSIZE", allowed.file_bytes)
    lower_limit("NOFILE", _MOST_FILES)
    lower_limit("CORE", 0)
    if seconds is not None:
        most = math.ceil(min(time.process_time() + allowed.threads * seconds, _MOST_SECONDS))
        # The process gets SIGXCPU; if it goes on, it is killed.
        lower_limit("CPU", most, grace=1)
    write = tuple(path for path in (allowed.write, allowed.kept) if path is not None)
    os.environ[parallel.VARIABLE] = str(allowed.threads)
    os.nice(_NICE)  # streams come first
    held = confine(Rights(allowed.read, write, allowed.processes, allowed.threads > 1, descriptors))
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
