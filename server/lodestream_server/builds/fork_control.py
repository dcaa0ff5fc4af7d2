"""Control of the fork server: starts it for the first call, and asks it to fork a process for each call."""

from __future__ import annotations

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
from contextlib import suppress
from typing import Any

from .answers import LONGEST_ANSWER, ProcessDiedError, WrongAnswerError, name_of
from .forkserver import Allowed

assert sys.platform == "linux"  # no other system has what follows

__all__ = ["ONE_THREAD", "ForkServer", "Process", "Started"]

_LOOK_SECONDS = 0.1
_LAST_SECONDS = 5.0
_LONGEST_MESSAGE = 64 << 10

# What processes that read strangers' files find in their environment: no secret of whoever started the server.
_ENVIRONMENT = ("HOME", "LANG", "LD_LIBRARY_PATH", "LD_PRELOAD", "PATH", "TMPDIR", "TZ", "XDG_CACHE_HOME")
_ENVIRONMENT_PREFIXES = ("CPL_", "GDAL_", "HDF5_", "LC_", "PROJ_", "PYTHON")

#: Threads of libraries would not be there in a process that is forked, and a build has one processor.
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("MKL", "OMP", "OPENBLAS")}

_PROGRAM = "import json, sys; sys.path[:] = json.loads(sys.argv.pop()); from {module} import main; main()"


class Started:
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
        """Kill the fork server, and wait for its end."""
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
        self._preload = "" if preload is None else name_of(preload)
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
        return None if started is None else started.confinement

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
        started = self._running()
        while not started.settled.wait(_LOOK_SECONDS):
            if given_up():
                return None
        if not started.ready:
            raise ProcessDiedError(self._exitcode(started))
        return started.problem

    def fork(self, request: bytes) -> Process:
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
        return Process(ours, answer, request)

    def close(self) -> None:
        """End the fork server, with all processes that were forked from it."""
        with self._lock:
            self._closed = True
            started = self._started
        if started is not None:
            started.end()

    def _running(self) -> Started:
        with self._lock:
            if self._closed:
                raise ProcessDiedError(None)
            if self._started is not None and self._started.process.poll() is not None:
                self._started.end()
                self._started = None
            if self._started is None:
                self._started = self._start()
            return self._started

    def _start(self) -> Started:
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
                command, stdin=subprocess.DEVNULL, env=environment | ONE_THREAD, pass_fds=(theirs.fileno(),)
            )
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
        return Started(process, ours)

    def _exitcode(self, started: Started) -> int | None:
        with suppress(subprocess.TimeoutExpired):
            return started.process.wait(_LAST_SECONDS)
        return None


class Process:
    """A process that was forked for a call: the connection to whoever forked it, and the pipe of its answer."""

    def __init__(self, connection: socket.socket, answer: int, request: bytes) -> None:
        self._connection = connection
        self._lines = connection.makefile("rb")
        self._answer = answer
        self._request = request
        self._exitcode: int | None = None
        self._over = False

    def begin(self) -> bool:
        """Hand over the call; return False when the fork server has ended.

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
        """Wait for the end of the process, and return its answer.

        Raises
        ------
        TimeoutError
            If it has not ended after so many ``seconds``, or has used up its processor time; it is killed.
        ProcessDiedError
            If it ended with another exit code than 0.
        WrongAnswerError
            If the answer is too long.
        """
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
        """Have the process killed; may be called from any thread."""
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_WR)

    def end(self) -> None:
        """Kill the process and all that it has started, and wait for their end."""
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
        """Return the whole answer of the process; None when it takes too long."""
        data = bytearray()
        while len(data) <= LONGEST_ANSWER:
            if not self._wait(self._answer, until):
                return None
            piece = os.read(self._answer, 1 << 16)
            if not piece:
                return bytes(data)
            data += piece
        raise WrongAnswerError(f"expected at most {LONGEST_ANSWER} bytes")

    def _drain(self, until: float) -> None:
        while self._wait(self._answer, until) and os.read(self._answer, 1 << 16):
            pass

    def _wait(self, handle: int, until: float | None) -> bool:
        poll = select.poll()
        poll.register(handle, select.POLLIN)
        return bool(poll.poll(None if until is None else max(0.0, 1000 * (until - time.monotonic()))))

    def _message(self) -> dict[str, int]:
        """Return the next message of the fork server; an empty one when it has ended."""
        try:
            line = self._lines.readline()
        except OSError:
            line = b""
        message: dict[str, int] = json.loads(line) if line.endswith(b"\n") else {}
        return message
