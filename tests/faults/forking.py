"""Commands of ``lodestream`` in processes that are forked from one that has imported everything.

A case that needs a server, or fsck, of its own then begins in milliseconds. Each line of standard input is an order in
JSON, answered by one line: ``{"run": [arguments], "log": path}`` with ``{"pid": n}``, and ``{"wait": n, "seconds": s}``
with ``{"code": exit code}``, null where the process goes on.
"""

from __future__ import annotations

import ctypes
import faulthandler
import json
import os
import signal
import sys
import time
import traceback
from importlib import import_module
from typing import Any

__all__ = ["DIED", "main"]

#: The exit code of a command that an exception has ended.
DIED = 70

_MODULES = (
    "lodestream_client.__main__",
    "lodestream_client.program",
    "lodestream_server.app",
    "lodestream_server.fsck_command",
    "lodestream_server.repair",
    "lodestream_server.running",
    "lodestream_server.token_command",
    "uvicorn.protocols.http.auto",
    "uvicorn.protocols.websockets.websockets_sansio_impl",
)
_EACH = 0.005

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Take orders until standard input ends."""
    # Now, not in each process.
    for module in _MODULES:
        import_module(module)
    # The processes of builds are asked by the shim whether their calls are to fail; nothing else is told to them.
    processes: Any = import_module("lodestream_server.processes")
    processes._ENVIRONMENT += ("LODE_FAULT_CONTROL",)
    # What shim.c asks for: from which lines a call comes. The file stays open as long as the process lives.
    calls = open(os.environ["LODE_FAULT_CALLS"], "a")  # noqa: SIM115
    faulthandler.register(signal.SIGUSR2, calls, all_threads=False)
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

    # Killed with the process that it comes from: it is in no group of anybody's.
    os.setsid()
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    said = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for theirs, ours in ((nothing, 0), (said, 1), (said, 2)):
        os.dup2(theirs, ours)
    return main(arguments)


def _wait(process: int, seconds: float) -> dict[str, Any]:
    until = time.monotonic() + seconds
    while True:
        ended, status = os.waitpid(process, os.WNOHANG)
        if ended:
            return {"code": os.waitstatus_to_exitcode(status)}
        if time.monotonic() >= until:
            return {"code": None}
        time.sleep(_EACH)
