"""Commands of ``lodestream`` under the shim: servers, fsck, token."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx

from tests.data_folder import PLACES
from tests.patience import PATIENCE as PATIENCE

from .shim import Shim, library

__all__ = ["PATIENCE", "Program", "Programs", "Server"]

#: The longest that anything may take, in seconds: what takes longer hangs.

# A process from which others are forked has one thread.
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("MKL", "OMP", "OPENBLAS")}

_LISTENING = re.compile(r"Lodestream serving (http://[\d.]+:\d{1,5})")  # what is logged may follow without a space


class Programs:
    """Starts commands in processes whose calls can be made to fail.

    Parameters
    ----------
    folder : Path
        For what belongs to it; made if there is none.

    Raises
    ------
    CannotError
        As `library` says.
    """

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        self.shim = Shim(library(folder, PLACES), folder / "page")
        # A program without a file: a process that is spawned from it would import that file again.
        command = [sys.executable, "-c", "from tests.faults.forking import main; main()"]
        environment = self.shim.environment() | _ONE_THREAD | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment, text=True
        )
        self._logs = 0

    def start(self, *arguments: str) -> Program:
        """Start a command."""
        self._logs += 1
        log = self.folder / f"{self._logs}.log"
        return Program(self, self._ask({"run": arguments, "log": str(log)})["pid"], log)

    def run(self, *arguments: str) -> Program:
        """Run a command to its end; one that does not come to it is killed, and its code is None."""
        program = self.start(*arguments)
        program.wait(2 * PATIENCE)
        program.kill()
        return program

    def wait(self, process: int, seconds: float) -> int | None:
        """The exit code of a process that ends in time."""
        code: int | None = self._ask({"wait": process, "seconds": seconds})["code"]
        return code

    def _ask(self, order: dict[str, Any]) -> dict[str, Any]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps(order), file=self._process.stdin, flush=True)
        answer: dict[str, Any] = json.loads(self._process.stdout.readline())
        return answer

    def kill(self) -> None:
        """End it and what it has started, as when the machine is short of memory."""
        self._process.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(PATIENCE)
        self._process.stdout.close()


class Program:
    """A command that was started.

    Attributes
    ----------
    pid : int
    code : int or None
        Its exit code, once it is known to have ended.
    """

    def __init__(self, programs: Programs, process: int, log: Path) -> None:
        self.code: int | None = None
        self._programs = programs
        self.pid = process
        self._log = log
        self._over = False

    def text(self) -> str:
        """What it has said, on standard output and standard error."""
        return self._log.read_text(errors="replace") if self._log.exists() else ""

    def wait(self, seconds: float) -> int | None:
        """Wait for its end, but not for ever."""
        if not self._over:
            self.code = self._programs.wait(self.pid, seconds)
            self._over = self.code is not None
        return self.code

    def stop(self) -> int | None:
        """Tell it to end; its exit code, None where it does not."""
        if not self._over:
            os.kill(self.pid, signal.SIGTERM)
        code = self.wait(PATIENCE)
        self.kill()
        return code

    def kill(self) -> None:
        """End it and what it has started."""
        if self._over:
            return
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)  # before it had a group of its own
        self._programs.wait(self.pid, PATIENCE)
        self._over = True


class Server:
    """A server, or what would have been one.

    Attributes
    ----------
    url : str or None
        Where it listens; None where it has refused to start, or hangs.
    """

    def __init__(self, programs: Programs, data: Path) -> None:
        options = ("--host", "127.0.0.1", "--port", "0", "--workers", "1", "--keep-free", "0", "--public-reads")
        self.program = programs.start("serve", "--data", str(data), *options)
        self.url: str | None = None
        until = time.monotonic() + PATIENCE
        while self.url is None and time.monotonic() < until and self.program.wait(0.005) is None:
            found = _LISTENING.search(self.program.text())
            self.url = found and found[1]

    @contextlib.contextmanager
    def client(self, token: str | None = None) -> Iterator[httpx.Client]:
        """A client that asks no proxy, with a token."""
        assert self.url is not None, self.program.text()[-2000:]
        headers = {} if token is None else {"authorization": f"Bearer {token}"}
        # Certificates, which nobody shows here, take longer to load than a start is looked at.
        with httpx.Client(base_url=self.url, headers=headers, trust_env=False, verify=False, timeout=PATIENCE) as http:
            yield http
