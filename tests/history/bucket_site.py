"""Servers of one bucket: two of which one writes and the other waits, and two that only read."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import httpx

from tests.server import programs

from .driver import Server
from .events import History

__all__ = ["READERS", "WRITERS", "BucketSite"]

WRITERS = ("first", "second")
READERS = ("reader one", "reader two")

#: So many clients wait for a server that is stopped; the others go on.
_WAITING = 2

#: Seconds after which a server that is asked what it is counts as one that does not answer.
_SOON = 8.0

#: Until all is settled: so many times as long as the lease lasts, and the seconds that servers and what they were asked
#: take on a machine that does several other things.
_LEASES, _SETTLED = 3, 120.0


@dataclass
class _Running:
    program: programs.Server
    only_reads: bool
    starts: int
    stopped: bool = False
    gone: bool = False


class BucketSite:
    """Servers of one bucket, each a process with a scratch folder of its own.

    Parameters
    ----------
    address : str
        Of the bucket.
    root : Path
        An empty folder.
    history : History
    lease_seconds : float
        How long the lease lasts.
    **settings
        Fields of `Settings` of all servers.

    Attributes
    ----------
    patience : float
        Seconds within which everything settles while nothing fails.
    """

    def __init__(self, address: str, root: Path, history: History, lease_seconds: float, **settings: Any) -> None:
        self._address = address
        self._root = root
        self._history = history
        self._lease = lease_seconds
        self._settings = {"lease_seconds": lease_seconds, **settings}
        self.patience = _LEASES * lease_seconds + _SETTLED
        self._chapter = 0
        self._running: dict[str, _Running] = {}
        self._left: list[str] = []

    def open(self) -> None:
        """Start all of them, the first one before the others: it makes what they need."""
        self.start(WRITERS[0])
        self.wait(lambda: self.role(WRITERS[0]) == "writer", "the first server to write")
        for name in (*WRITERS[1:], *READERS):
            self.start(name)
        self.settle()

    def start(self, name: str) -> None:
        """Start one."""
        before = self._running.get(name)
        program = programs.Server(
            self._root / name.replace(" ", "-"),
            address=self._address,
            scratch=str(self._root / f"{name.replace(' ', '-')}-scratch"),
            read_only=name in READERS,
            **self._settings,
        )
        self._running[name] = _Running(program, name in READERS, 1 if before is None else before.starts + 1)

    def servers(self, *names: str) -> Sequence[Server]:
        """Who can be asked now, of these or of all: of those that are stopped, ones for which few wait."""
        running = ((name, each) for name, each in self._running.items() if not names or name in names)
        return tuple(
            Server(self.called(name), each.program.url, each.only_reads)
            for name, each in running
            if not each.gone and (not each.stopped or self._history.open(self.called(name)) < _WAITING)
        )

    def called(self, name: str) -> str:
        """What a server is called in the history now: otherwise after a restart, and each time that all is settled."""
        return f"{name} ({self._running[name].starts}, {self._chapter})"

    def role(self, name: str) -> str | None:
        """What a server says that it is; None if it does not answer soon, or is not ready."""
        with suppress(httpx.TransportError), httpx.Client(trust_env=False, timeout=_SOON) as http:
            answer = http.get(f"{self._running[name].program.url}/readyz")
            if answer.status_code == 200:
                return str(answer.json()["role"])
        return None

    def writer(self) -> str | None:
        """Who writes."""
        return next((name for name in WRITERS if self.role(name) == "writer"), None)

    def kill(self, name: str) -> None:
        """End one as kill -9 does."""
        self._gone(name)
        self._running[name].program.kill()

    def end(self, name: str) -> None:
        """Tell one to end."""
        self._gone(name)
        code = self._running[name].program.stop()
        if code not in (0, -signal.SIGTERM):
            self._history.found("end", f"{name}: expected an end with 0 or by SIGTERM, got {code}")

    def _gone(self, name: str) -> None:
        self._running[name].gone = True
        self._left.append(self.called(name))

    def stop(self, name: str) -> None:
        """Let one stand still."""
        self._running[name].stopped = True
        os.kill(self._running[name].program.pid, signal.SIGSTOP)

    def go_on(self, name: str) -> None:
        """Let one that stands still go on."""
        os.kill(self._running[name].program.pid, signal.SIGCONT)
        self._running[name].stopped = False

    def settle(self) -> str:
        """Wait until one writes, one waits, and the others read; who writes.

        What servers were asked until now has been answered by then, and so has happened or never will.

        Raises
        ------
        AssertionError
            If two write at once, or all of this does not come; the history has that as a finding.
        """
        self.wait(self._one_writes, "one to write, and one to wait")
        for name in READERS:
            self.wait(lambda name=name: self.role(name) == "reader", f"{name} to answer")  # type: ignore[misc]
        old = [self.called(name) for name in self._running]
        self._chapter += 1
        for name in (*self._left, *old):
            self.wait(lambda name=name: self._history.ended_if_quiet(name), f"all answers of {name}")  # type: ignore[misc]
        self._left = []
        writer = self.writer()
        assert writer is not None, "expected a server that writes, got none"
        return writer

    def _one_writes(self) -> bool:
        """Whether one says that it writes and the other one that it waits."""
        first, other = WRITERS
        asked = time.monotonic()
        roles = self.role(first), self.role(other)
        # It may have passed from one to the other between the two answers; it does not come back so soon.
        if roles == ("writer", "writer") and self.role(first) == "writer":
            seconds = time.monotonic() - asked
            if seconds < self._lease / 2:
                self._fail(
                    "two writers", f"expected one server to write, got {first} and {other} within {seconds:.1f} s"
                )
        return sorted(role or "" for role in roles) == ["waiting", "writer"]

    def wait(self, look: Callable[[], object], what: str) -> None:
        """Wait for what comes while nothing fails.

        Raises
        ------
        AssertionError
            If it does not come; the history has that as a finding.
        """
        until = time.monotonic() + self.patience
        while not look():
            if time.monotonic() > until:
                roles = ", ".join(f"{name} {self.role(name) or 'does not answer'}" for name in self._running)
                self._fail("unsettled", f"expected {what} within {self.patience:.0f} s, got: {roles}")
            time.sleep(0.05)

    def _fail(self, rule: str, text: str) -> NoReturn:
        self._history.found(rule, text)
        raise AssertionError(f"{rule}: {text}")

    @contextmanager
    def ended_by_failures(self) -> Iterator[None]:
        """Give a block in which an error ends the servers, or clients would wait for those that stand still."""
        try:
            yield
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End whatever is running."""
        for each in self._running.values():
            each.program.kill()
