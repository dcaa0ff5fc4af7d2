"""Kill -9 of a server and of its build processes at random moments, under upload, build, stream and delete.

After each kill the folder is checked as it lies there, then once a server has taken it again; then everything that was
acknowledged is asked for. What was under way and not answered may be there or not, but whole or not at all.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import httpx
import numpy as np

import lodestream as ls
from tests.server.connections.sockets import Place, Reader, read_stream
from tests.server.helpers import eventually, hills, npy
from tests.server.programs import Server, alive, descendants

__all__ = ["Kills", "run"]

_Act: TypeAlias = Callable[[Server, httpx.Client, random.Random], None]

_BODIES = 12


@dataclass
class Ledger:
    """What the server has acknowledged.

    Attributes
    ----------
    stored : dict
        For each surface that is there, the number of its upload: one that comes again is another.
    containers : dict
        For each surface that was seen ready, the SHA-256 of its container.
    doubtful : set
        Surfaces that a request without an answer concerns, so that they may be there or not.
    busy : set
        Surfaces that a request is changing.
    """

    stored: dict[str, int] = field(default_factory=dict)
    containers: dict[str, str] = field(default_factory=dict)
    doubtful: set[str] = field(default_factory=set)
    busy: set[str] = field(default_factory=set)
    lock: threading.Lock = field(default_factory=threading.Lock)


@dataclass
class Kills:
    """What happened.

    Attributes
    ----------
    servers, workers : int
        Processes killed.
    uploads, deletes, streams, builds : int
        What was acknowledged, or came to its end, between the kills.
    """

    servers: int = 0
    workers: int = 0
    uploads: int = 0
    deletes: int = 0
    streams: int = 0
    builds: int = 0
    seconds: float = 0.0


class _Torment:
    def __init__(self, data: Path, seed: int, longest: float) -> None:
        self.data = data
        self.longest = longest
        self.random = random.Random(seed)
        self.points = [hills(30 + 7 * number, 40, seed=number) for number in range(_BODIES)]
        self.bodies = [npy(points) for points in self.points]
        self.ids: dict[str, int] = {}
        self.ledger = Ledger()
        self.kills = Kills()
        self.checked: set[str] = set()
        self.failures: list[str] = []
        self._stored = 0

    def round(self) -> None:
        """Start a server, compare it with the ledger, keep it busy, kill it, look at what is left."""
        server = Server(self.data)
        try:
            if self.random.random() < 0.2:  # before it has seen what the one before it had begun
                time.sleep(self.random.uniform(0, 0.5))
                self.kills.servers += 1
                return
            with server.client() as http:
                self._compare(http)
            over = threading.Event()
            threads = [
                threading.Thread(target=self._busy, args=(server, over, act, self.random.random()))
                for act in (self._upload, self._upload, self._delete, self._stream, self._watch)
            ]
            for thread in threads:
                thread.start()
            try:
                self._kill(server)
            finally:
                over.set()
                for thread in threads:
                    thread.join()
        finally:
            server.kill()
        self._look()
        assert not self.failures, self.failures

    def _kill(self, server: Server) -> None:
        if not self.kills.uploads:  # however slow the machine is, something is there to be lost
            eventually(lambda: self.kills.uploads, "an upload that is acknowledged")
        moment = self.random.uniform(0.02, self.random.choice((self.longest / 5, self.longest)))
        if self.random.random() < 0.5:
            # Later: when the processes that build are warm, and builds come to their end.
            self._await_build()
        if self.random.random() < 0.4:
            time.sleep(moment / 2)
            for worker in descendants(server.pid):
                with contextlib.suppress(ProcessLookupError):
                    os.kill(worker, signal.SIGKILL)
                    self.kills.workers += 1
            time.sleep(moment / 2)
        else:
            time.sleep(moment)
        children = descendants(server.pid)
        server.kill()
        self.kills.servers += 1
        eventually(lambda: not any(map(alive, children)), "the server's processes to end with it")

    def _await_build(self) -> None:
        seen, until = self.kills.builds, time.monotonic() + 5 * self.longest
        while self.kills.builds == seen and time.monotonic() < until:
            time.sleep(0.02)

    def _look(self) -> None:
        command = [sys.executable, "-m", "lodestream_client", "fsck", str(self.data)]
        found = subprocess.run(command, capture_output=True, text=True, check=False)
        assert found.returncode == 0, found.stdout + found.stderr

    def _compare(self, http: httpx.Client) -> None:
        eventually(lambda: http.get("/readyz").status_code == 200, "the server to be ready")
        entries = http.get("/v1/surfaces?limit=1000").raise_for_status().json()["surfaces"]
        listed = {entry["id"]: entry for entry in entries}
        ledger = self.ledger
        for surface in ledger.doubtful:
            ledger.stored.pop(surface, None)
            ledger.containers.pop(surface, None)
            if surface in listed:
                ledger.stored[surface] = self._number()
        ledger.doubtful.clear()
        assert listed.keys() == ledger.stored.keys(), listed.keys() ^ ledger.stored.keys()
        for surface, entry in listed.items():
            assert entry["state"] != "failed", entry
            if entry["state"] == "waiting":  # its processes were killed too often
                http.post(f"{entry['url']}/retry").raise_for_status()
            if surface in ledger.containers:
                assert (entry["state"], entry["container_sha256"]) == ("ready", ledger.containers[surface])
            if entry["state"] == "ready":
                self._whole(http, entry)

    def _whole(self, http: httpx.Client, entry: dict[str, Any]) -> None:
        container = http.get(f"{entry['url']}/container", follow_redirects=True).raise_for_status().content
        assert hashlib.sha256(container).hexdigest() == entry["container_sha256"]
        if entry["container_sha256"] not in self.checked:
            assert np.array_equal(ls.decode(container).points, self.points[self.ids[entry["id"]]])
            self.checked.add(entry["container_sha256"])

    def _busy(
        self,
        server: Server,
        over: threading.Event,
        act: Callable[[Server, httpx.Client, random.Random], None],
        seed: float,
    ) -> None:
        random_ = random.Random(seed)
        try:
            with server.client() as http:
                while not over.is_set():
                    act(server, http, random_)
                    over.wait(random_.uniform(0, 0.05))
        except (httpx.TransportError, ConnectionError, asyncio.IncompleteReadError):
            # The server is gone in the middle of it; were it not, the next comparison would show it.
            return
        except Exception as error:
            self.failures.append(f"{act.__name__}: {error!r}")

    def _upload(self, server: Server, http: httpx.Client, random_: random.Random) -> None:
        number = random_.randrange(_BODIES)
        surface = self._id(number)
        with self._alone(surface) as alone:
            if not alone:
                return
            new = surface not in self.ledger.stored
            if new:
                self.ledger.doubtful.add(surface)
            if random_.random() < 0.5:
                answer = http.post("/v1/surfaces", content=self.bodies[number])
            else:
                answer = http.post("/v1/surfaces", files={"file": ("a.npy", self.bodies[number])})
            assert answer.status_code in (200, 202), answer.text
            assert answer.headers["location"].endswith(surface)
            if new:
                with self.ledger.lock:
                    self.ledger.stored[surface] = self._number()
                    self.ledger.doubtful.discard(surface)
                    self.kills.uploads += 1

    def _delete(self, server: Server, http: httpx.Client, random_: random.Random) -> None:
        with self.ledger.lock:
            there = sorted(self.ledger.stored)
        if len(there) < 3:
            return
        surface = random_.choice(there)
        with self._alone(surface) as alone:
            if not alone or surface not in self.ledger.stored:
                return
            self.ledger.doubtful.add(surface)
            assert http.delete(f"/v1/surfaces/{surface}").status_code == 204
            with self.ledger.lock:
                self.ledger.stored.pop(surface)
                self.ledger.containers.pop(surface, None)
                self.ledger.doubtful.discard(surface)
                self.kills.deletes += 1
        time.sleep(random_.uniform(0, 0.3))

    @contextlib.contextmanager
    def _alone(self, surface: str) -> Iterator[bool]:
        """Whether nobody else changes this surface: only then it is known what has become of it."""
        with self.ledger.lock:
            alone = surface not in self.ledger.busy
            self.ledger.busy.add(surface)
        try:
            yield alone
        finally:
            if alone:
                self.ledger.busy.discard(surface)

    def _stream(self, server: Server, http: httpx.Client, random_: random.Random) -> None:
        with self.ledger.lock:
            ready = sorted(self.ledger.containers)
        if not ready:
            return
        surface = random_.choice(ready)
        place = Place.of(f"{server.url}/v1/surfaces/{surface}")
        try:
            reader = asyncio.run(read_stream(place, Reader(window=random_.choice((500, 5000, 100_000)))))
        except ConnectionError as error:
            if "not-found" in str(error) or "not-ready" in str(error):
                return  # deleted since, and perhaps uploaded again
            raise
        assert (reader.ended, reader.closed) == ("complete", 1000)
        self.kills.streams += 1

    def _watch(self, server: Server, http: httpx.Client, random_: random.Random) -> None:
        with self.ledger.lock:
            left = self.ledger.containers.keys() | self.ledger.doubtful
            waiting = {surface: number for surface, number in self.ledger.stored.items() if surface not in left}
        for surface, number in waiting.items():
            answer = http.get(f"/v1/surfaces/{surface}")
            with self.ledger.lock:
                # What was deleted meanwhile, and perhaps uploaded again, is not what this answer speaks of.
                if surface in self.ledger.doubtful or self.ledger.stored.get(surface) != number:
                    continue
                if answer.status_code == 200 and answer.json()["state"] == "ready":
                    self.ledger.containers[surface] = answer.json()["container_sha256"]
                    self.kills.builds += 1

    def _number(self) -> int:
        self._stored += 1
        return self._stored

    def _id(self, number: int) -> str:
        digest = hashlib.sha256(self.bodies[number] + len(self.bodies[number]).to_bytes(8, "big"))
        digest.update(b'["npy", []]')
        surface = digest.hexdigest()[:20]
        self.ids[surface] = number
        return surface


def run(folder: Path, count: int, seconds: float | None = None, *, seed: int = 1, longest: float = 4.0) -> Kills:
    """Kill a server so many times, or as often as the seconds allow.

    Raises
    ------
    AssertionError
        When something that was acknowledged is gone or another, something is half there, or an answer is wrong.
    """
    torment = _Torment(folder / "data", seed, longest)
    started = time.monotonic()
    while torment.kills.servers < count and (seconds is None or time.monotonic() - started < seconds):
        torment.round()
    # At last everything is built, and the server ends as it should.
    server = Server(folder / "data")
    try:
        with server.client() as http:
            torment._compare(http)
            for surface in torment.ledger.stored:
                entry = eventually(lambda surface=surface: _settled(http, surface), "the build to end")  # type: ignore[misc]
                assert entry["state"] == "ready", entry
                torment._whole(http, entry)
        assert server.stop() in (0, -signal.SIGTERM)
    finally:
        server.kill()
    torment._look()
    torment.kills.seconds = time.monotonic() - started
    return torment.kills


def _settled(http: httpx.Client, surface: str) -> dict[str, Any] | None:
    entry: dict[str, Any] = http.get(f"/v1/surfaces/{surface}").raise_for_status().json()
    return entry if entry["state"] in ("ready", "failed", "waiting") else None
