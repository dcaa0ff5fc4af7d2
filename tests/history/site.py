"""One server and its folder: started, stopped, killed, filled up, moved about."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import httpx
import pytest

from lodestream_server.access.tokens import TokenFile
from tests.patience import PATIENCE as _PATIENCE
from tests.server import programs
from tests.server.helpers import eventually
from tests.torture.small_disk import can_mount

from .driver import Server
from .events import History

__all__ = ["Disk", "Site", "can_fill"]


def can_fill() -> bool:
    """Whether a disk can be had that is small, and outlives the servers that work on it."""
    return shutil.which("nsenter") is not None and can_mount()


class Disk:
    """A small disk in name spaces of its own, which a process that sleeps keeps alive.

    Parameters
    ----------
    place : Path
        An empty folder; who enters the name spaces finds the disk there.
    size : str
        As ``mount`` takes it.

    Attributes
    ----------
    wrapper : tuple of str
        A command that runs the one that follows it there.
    root : Path
        The disk, as it is seen from outside.
    """

    def __init__(self, place: Path, size: str) -> None:
        mount = f'mount -t tmpfs -o size={size} tmpfs "{place}" && echo mounted && exec sleep infinity'
        self._keeper = subprocess.Popen(["unshare", "-Urm", "sh", "-c", mount], stdout=subprocess.PIPE, text=True)
        assert self._keeper.stdout is not None
        assert self._keeper.stdout.readline() == "mounted\n"
        enter = ("nsenter", "--target", str(self._keeper.pid), "--user", "--mount", "--preserve-credentials", "--")
        self.wrapper = enter
        self.root = Path(f"/proc/{self._keeper.pid}/root{place}")

    def fill(self, left: int) -> None:
        """Leave so many bytes free, or a little less."""
        with (self.root / "ballast").open("ab", buffering=0) as file:
            for size in (1 << 20, 1 << 12):
                while _grows(file, size):
                    pass
            file.truncate(max(0, file.tell() - left))

    def empty(self) -> None:
        """Give back what `fill` has taken."""
        (self.root / "ballast").unlink(missing_ok=True)

    def close(self) -> None:
        """End it, with all that lies there."""
        self._keeper.kill()
        self._keeper.wait()
        if self._keeper.stdout is not None:
            self._keeper.stdout.close()


def _grows(file: io.FileIO, size: int) -> bool:
    """Whether a file took so many bytes more."""
    try:
        return file.write(bytes(size)) == size
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        return False


class Site:
    """A server's folder, and the server that works there, if one does.

    Parameters
    ----------
    root : Path
        An empty folder for all of it.
    history : History
    disk_size : str or None
        It lies on a disk of its own, which can be filled.

    Attributes
    ----------
    data : Path
        The server's folder as it is seen from here.
    disk : Disk or None
    """

    def __init__(self, root: Path, history: History, disk_size: str | None = None) -> None:
        self.disk = Disk(root, disk_size) if disk_size is not None else None
        self._root = root
        self._outside = self.disk.root if self.disk is not None else root
        self._history = history
        self._number = 0
        self._ended: list[str] = []
        self._folder = "data"
        self._running: tuple[programs.Server, Server] | None = None
        self.data.mkdir()

    @property
    def data(self) -> Path:
        """The server's folder as it is seen from here."""
        return self._outside / self._folder

    @property
    def aside(self) -> Path:
        """A place beside the server's folder, for an index that is taken away from it."""
        return self._outside / "aside"

    @property
    def backup(self) -> Path:
        """A place for a copy of the server's folder."""
        return self._outside / f"{self._folder}.backup"

    def servers(self) -> Sequence[Server]:
        """Who can be asked now."""
        running = self._running
        return () if running is None else (running[1],)

    def make_token(self, name: str, scope: str) -> str:
        """A token, as ``lodestream token create`` makes it."""
        return TokenFile(self.data / "tokens.json").create(name, (scope,))[0]

    def start(self, without: Path | None = None, *, ready: bool = False, **settings: Any) -> None:
        """Start a server.

        Parameters
        ----------
        without : Path or None
            A folder with modules that stand before those that are installed.
        ready : bool
            Nobody asks it before it says that it is ready: what it knew at first may be of another folder.
        **settings
            Fields of `Settings`.
        """
        path = os.pathsep.join(filter(None, (str(without or ""), *sys.path)))
        wrapper = [*self._wrapper(), "env", f"PYTHONPATH={path}"]
        self._number += 1
        name = f"server {self._number}"
        try:
            server = programs.Server(self._root / self._folder, wrapper, keep_free=0, **settings)
        except pytest.fail.Exception as failure:
            self._history.found("start", f"{name}: expected a server that starts, got {failure}")
            raise AssertionError(str(failure)) from None
        known, before = Server(name, server.url), list(self._ended)
        if ready:
            self._settle(server, known, before)
        self._running = (server, known)
        if not ready:
            threading.Thread(target=self._settle, args=(server, known, before), daemon=True).start()

    def _settle(self, server: programs.Server, known: Server, before: Sequence[str]) -> None:
        """Wait until a server has taken up what others had begun: that has happened by then, or never will."""
        with httpx.Client(trust_env=False, verify=False, timeout=_PATIENCE) as http:
            while programs.alive(server.pid):
                with contextlib.suppress(httpx.TransportError):
                    if http.get(f"{known.url}/readyz").status_code == 200:
                        break
                time.sleep(0.05)
            else:
                return
        for name in before:
            self._history.server_ended(name)

    def stop(self) -> None:
        """Tell the server to end."""
        server, known = self._gone()
        code = server.stop()
        self._ended.append(known.name)
        if code not in (0, -signal.SIGTERM):
            self._history.found("end", f"{known.name}: expected an end with 0 or by SIGTERM, got {code}")

    def kill(self) -> None:
        """Kill the server, as kill -9 does, and wait for its build processes to end with it."""
        server, known = self._gone()
        children = programs.descendants(server.pid)
        server.kill()
        eventually(lambda: not any(map(programs.alive, children)), "the server's processes to end with it")
        self._ended.append(known.name)

    def kill_builds(self) -> int:
        """Kill the processes that build; how many there were."""
        if self._running is None:
            return 0
        killed = 0
        for process in programs.descendants(self._running[0].pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
                killed += 1
        return killed

    def command(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run the command ``lodestream``, and keep what it says."""
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        command = [*self._wrapper(), sys.executable, "-m", "lodestream_client", *arguments]
        return subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env=environment,
            text=True,
            timeout=_PATIENCE,
            check=False,
        )

    @property
    def inside(self) -> Path:
        """The server's folder as the server sees it."""
        return self._root / self._folder

    def move_to(self, copy: Path) -> None:
        """Put a copy in place of the folder, under another name; no server is running."""
        shutil.rmtree(self.data)
        self._number += 1
        self._folder = f"data-{self._number}"
        copy.rename(self.data)

    def close(self) -> None:
        """End whatever is running."""
        if self._running is not None:
            self.kill()
        if self.disk is not None:
            self.disk.close()

    def _wrapper(self) -> tuple[str, ...]:
        return self.disk.wrapper if self.disk is not None else ()

    def _gone(self) -> tuple[programs.Server, Server]:
        # Nobody is sent there any more; who is there already loses their connection.
        assert self._running is not None
        running, self._running = self._running, None
        return running
