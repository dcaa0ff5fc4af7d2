"""A server in a process of its own (`alone`): to kill it, to measure it, to look at what is left in it."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.patience import PATIENCE as _PATIENCE

__all__ = ["Server", "Within", "alive", "descendants", "resident", "server"]

# Long enough for a machine that does several other things.


@dataclass(frozen=True)
class Within:
    """What a server holds.

    Attributes
    ----------
    tasks : int
        Tasks of its event loop.
    sockets : int
        Sockets that are open.
    files : tuple of str
        Files of its folder that are open, its lock aside.
    resident : int
        Bytes of memory.
    """

    tasks: int
    sockets: int
    files: tuple[str, ...]
    resident: int


class Server:
    """A server in another process.

    Parameters
    ----------
    data : Path
        Its folder; what it says goes into a file beside it.
    wrapper : sequence of str
        A command that runs the one that follows it.
    preload : str
        The function of `alone` that builds and levels begin with.
    address : str or None
        Of a bucket in which its data are; then the folder only says where what it says goes.
    **settings
        Fields of `Settings`.
    """

    def __init__(
        self,
        data: Path,
        wrapper: Sequence[str] = (),
        preload: str = "preload",
        *,
        address: str | None = None,
        **settings: Any,
    ) -> None:
        self.log = data.with_name(f"{data.name}.log")
        chosen = {"host": "127.0.0.1", "port": 0, "workers": 1, "data": address or str(data), **settings}
        command = [*wrapper, sys.executable, "-m", "tests.server.alone", json.dumps(chosen), preload]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, env=environment, text=True
            )
        self.url = self._line()
        if not self.url.startswith("http"):
            self.kill()
            pytest.fail(f"the server did not start: {self.log.read_text()[-2000:]}")

    @property
    def pid(self) -> int:
        """The process."""
        return self._process.pid

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def look(self) -> Within:
        """What it holds now."""
        assert self._process.stdin is not None
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        values = json.loads(self._line())
        return Within(values["tasks"], values["sockets"], tuple(values["files"]), resident(self.pid))

    def kill(self) -> None:
        """End it as kill -9 does."""
        self._end(signal.SIGKILL)

    def stop(self) -> int:
        """Tell it to end; its exit code."""
        return self._end(signal.SIGTERM)

    def _end(self, number: signal.Signals) -> int:
        if self._process.poll() is None:
            self._process.send_signal(number)
        code = self._process.wait(_PATIENCE)
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        return code

    def client(self) -> httpx.Client:
        """A client that asks no proxy."""
        return httpx.Client(base_url=self.url, trust_env=False, timeout=_PATIENCE)


@contextlib.contextmanager
def server(data: Path, wrapper: Sequence[str] = (), preload: str = "preload", **settings: Any) -> Iterator[Server]:
    """A server, which has ended when the ``with`` block does."""
    running = Server(data, wrapper, preload, **settings)
    try:
        yield running
        assert running.stop() in (0, -signal.SIGTERM)
    finally:
        running.kill()


def resident(process: int) -> int:
    """Bytes of memory that a process has of its own, from /proc."""
    for line in Path(f"/proc/{process}/status").read_text().splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) * 1024
    raise RuntimeError(f"expected RssAnon in /proc/{process}/status, got none")


def descendants(process: int) -> list[int]:
    """The processes that a process has started, and those that they have."""
    found: list[int] = []
    folder = Path(f"/proc/{process}/task")
    with contextlib.suppress(OSError):  # it may end meanwhile
        for task in os.listdir(folder):
            with contextlib.suppress(OSError):
                for child in map(int, (folder / task / "children").read_text().split()):
                    found += [child, *descendants(child)]
    return found


def alive(process: int) -> bool:
    """Whether a process is there and has not ended."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
