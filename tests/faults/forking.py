"""Commands of ``lodestream`` in processes that are forked from one that has imported everything.

A case that needs a server, or fsck, of its own then begins in milliseconds. So does its first build: its fork server is
forked from here too, where the kernels are loaded, and from then on is what it always is.

Each line of standard input is an order in JSON, answered by one line: ``{"run": [arguments], "log": path}`` with
``{"pid": n}``, and ``{"wait": n, "seconds": s}`` with ``{"code": exit code}``, null where the process goes on.
"""

from __future__ import annotations

import ctypes
import faulthandler
import gc
import json
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from importlib import import_module
from typing import Any

from lodestream_client import program
from lodestream_server.builds import builder, fork_server, processes, worker
from tests import data_folder

__all__ = ["DIED", "main"]

#: The exit code of a command that an exception has ended.
DIED = 70

_MODULES = (
    "anyio._backends._asyncio",
    "encodings.idna",
    "lodestream_client.__main__",
    "lodestream_client.program",
    "lodestream_server.app",
    "lodestream_server.commands.fsck",
    "lodestream_server.running",
    "lodestream_server.commands.token",
    "uvicorn.lifespan.on",
    "uvicorn.loops.asyncio",
    "uvicorn.protocols.http.auto",
    "uvicorn.protocols.websockets.websockets_sansio_impl",
)
_EACH = 0.005

_PR_SET_PDEATHSIG = 1


class _Forked:
    """A fork server that was forked from this process, with what is asked of one that `subprocess` has started.

    Attributes
    ----------
    pid : int
    stdin, stdout : binary file
        Its other ends.
    address : int
        Handle of its listener.
    """

    def __init__(self) -> None:
        alive, stdin = os.pipe()
        stdout, told = os.pipe()
        listener, self.address = processes.new_listener()
        self._code: int | None = None
        self._lock = threading.Lock()
        self.pid = os.fork()
        if not self.pid:
            try:
                for theirs, standard in ((alive, 0), (told, 1)):
                    os.dup2(theirs, standard)
                for handle in (alive, stdin, stdout, told, self.address):
                    os.close(handle)
                fork_server.main(None, listener.detach())
            finally:
                os._exit(0)
        listener.close()
        os.close(alive)
        os.close(told)
        self.stdin, self.stdout = os.fdopen(stdin, "wb", 0), os.fdopen(stdout, "rb", 0)

    def poll(self) -> int | None:
        """Its exit code, once it has ended."""
        with self._lock:
            if self._code is None:
                ended, status = os.waitpid(self.pid, os.WNOHANG)
                self._code = os.waitstatus_to_exitcode(status) if ended else None
            return self._code

    def kill(self) -> None:
        """Kill it, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)

    def wait(self, timeout: float | None = None) -> int:
        """Its exit code, when it has ended.

        Raises
        ------
        subprocess.TimeoutExpired
        """
        until = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if timeout is not None and until is not None and time.monotonic() >= until:
                raise subprocess.TimeoutExpired("the fork server", timeout)
            time.sleep(_EACH)
        return code


class _ForkServer(processes.ForkServer):
    """Has one fork server already; when that has died, it starts another as it always does."""

    def __init__(self, preload: Callable[[], object] | None, forked: _Forked) -> None:
        super().__init__(preload)
        self._forked: Any = forked

    def _start(self) -> processes.Started:
        forked, self._forked = self._forked, None
        return super()._start() if forked is None else processes.Started(forked, forked.address)


def main() -> None:
    """Take orders until standard input ends."""
    # Now, not in each process.
    for module in _MODULES:
        import_module(module)
    worker.preload()
    # What each process would make first: both take as long as looking through a small folder.
    data_folder.warm()
    parser = program.build_parser()
    names: Any = program
    names.build_parser = lambda _: parser
    gc.collect()
    gc.freeze()  # or the first collection in each process would copy every page
    # A fork server that is started anew belongs to the shim, too.
    shim: Any = processes
    shim._ENVIRONMENT += ("LODE_FAULT_CONTROL", "LODE_FAULT_CALLS")
    # What shim.c asks for: from which lines a call comes. The processes of builds keep this file open, and no other.
    preloaded = ctypes.CDLL(None)
    faulthandler.register(signal.SIGUSR2, preloaded.lode_calls(), all_threads=False)
    if preloaded.lode_leave_signal_stack():
        raise OSError("expected handlers of signals to leave the stack that faulthandler gave them")
    for line in sys.stdin:
        order = json.loads(line)
        answer = _run(order["run"], order["log"]) if "run" in order else _wait(order["wait"], order["seconds"])
        print(json.dumps(answer), flush=True)


def _run(arguments: list[str], log: str) -> dict[str, Any]:
    process = os.fork()
    if process:
        return {"pid": process}
    code = DIED
    try:
        code = _be(arguments, log)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _be(arguments: list[str], log: str) -> int:
    from lodestream_client.__main__ import main

    # A group of its own, to be killed as a whole, but no session: Linux gives each of those the processor in turn, so
    # that whoever runs many of them in the background would take it from everybody else. Killed with the process that
    # it comes from: it is in no group of anybody's.
    os.setpgid(0, 0)
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    said = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for theirs, ours in ((nothing, 0), (said, 1), (said, 2)):
        os.dup2(theirs, ours)
    if "serve" in arguments:
        _fork_server()  # while this process has one thread
    return main(arguments)


def _fork_server() -> None:
    forked = _Forked()
    names: Any = builder
    names.ForkServer = lambda preload: _ForkServer(preload, forked)


def _wait(process: int, seconds: float) -> dict[str, Any]:
    until = time.monotonic() + seconds
    while True:
        ended, status = os.waitpid(process, os.WNOHANG)
        if ended:
            return {"code": os.waitstatus_to_exitcode(status)}
        if time.monotonic() >= until:
            return {"code": None}
        time.sleep(_EACH)
