"""Servers of one bucket that are killed and stopped, behind a network that fails: nothing acknowledged is lost."""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

import lodestream as ls
from tests.server.helpers import eventually, npy
from tests.server.programs import Server
from tests.stores.emulators import Emulator, ministack, s3
from tests.stores.faults import Fault, FaultProxy, fault_proxy

__all__ = ["ministack", "s3"]

SECONDS = float(os.environ.get("LODESTREAM_TAKEOVERS", "25"))
LEASE, LOOK = 3.0, 0.5
#: Seconds beyond what is promised, for a machine that does several other things.
SLACK = 10.0


def surface(number: int) -> Any:
    return np.arange(35, dtype=np.float32).reshape(5, 7) * number


class Site:
    """Two servers that may write, and two that only read."""

    def __init__(self, address: str, folder: Path, stack: ExitStack) -> None:
        self._address, self._folder, self._stack = address, folder, stack
        self.servers: dict[str, Server] = {}
        for name in ("first", "second", "one", "two"):
            self.start(name)

    def start(self, name: str) -> None:
        reads = name in ("one", "two")
        server = Server(
            self._folder / name,
            address=self._address,
            scratch=str(self._folder / f"{name}-scratch"),
            read_only=reads,
            lease_seconds=LEASE,
            look_seconds=LOOK,
            list_seconds=15.0,
        )
        self._stack.callback(server.kill)
        self.servers[name] = server
        if name == "first" and len(self.servers) == 1:
            eventually(lambda: self.role(name) == "writer", "the first one to write")

    def ask(self, name: str, method: str, path: str, **given: Any) -> httpx.Response | None:
        """The answer; None if none comes soon."""
        with suppress(httpx.TransportError), httpx.Client(base_url=self.servers[name].url, trust_env=False) as http:
            return http.request(method, path, timeout=8.0, **given)
        return None

    def role(self, name: str) -> str | None:
        answer = self.ask(name, "GET", "/readyz")
        return None if answer is None else answer.json()["role"]

    def states(self, name: str) -> dict[str, str] | None:
        answer = self.ask(name, "GET", "/v1/surfaces?limit=1000")
        if answer is None or answer.status_code != 200:
            return None
        return {it["id"]: it["state"] for it in answer.json()["surfaces"]}


class Client:
    """Uploads and deletes, at whichever server takes them, and remembers what was acknowledged."""

    def __init__(self, site: Site, random_: random.Random) -> None:
        self._site, self._random = site, random_
        self.kept: dict[str, int] = {}  # surfaces, and the numbers of what was uploaded
        self.gone: set[str] = set()
        self.open: set[str] = set()  # of which it is not known whether they are deleted
        self.when: dict[str, float] = {}
        self.number = 0
        self.ending = threading.Event()

    def run(self) -> None:
        while not self.ending.wait(0.05):
            for name in self._random.sample(["first", "second"], 2):
                if self._random.random() < 0.25 and self.kept.keys() - self.open:
                    self._delete(name, self._random.choice(sorted(self.kept.keys() - self.open)))
                else:
                    self._upload(name)

    def _upload(self, name: str) -> None:
        self.number += 1
        answer = self._site.ask(name, "POST", "/v1/surfaces", content=npy(surface(self.number)))
        if answer is not None and answer.status_code in (200, 202):
            self.when[answer.json()["id"]] = time.monotonic()
            self.kept[answer.json()["id"]] = self.number
        else:
            assert answer is None or answer.status_code == 503, answer.text

    def _delete(self, name: str, id_: str) -> None:
        answer = self._site.ask(name, "DELETE", f"/v1/surfaces/{id_}")
        if answer is not None and answer.status_code in (204, 404):
            self.gone.add(id_)
            del self.kept[id_]
        elif answer is None or answer.json()["detail"].startswith("It is not known"):
            self.open.add(id_)
        else:
            # A server that is no longer the one that writes may have deleted it, and does not acknowledge that.
            assert answer.status_code == 503, answer.text
            self.open.add(id_)


class Watch:
    """When a reader first saw each surface."""

    def __init__(self, site: Site, name: str) -> None:
        self._site, self._name = site, name
        self.seen: dict[str, float] = {}
        self.ending = threading.Event()

    def run(self) -> None:
        while not self.ending.wait(0.1):
            for id_ in self._site.states(self._name) or {}:
                self.seen.setdefault(id_, time.monotonic())


@contextmanager
def threads(*workers: Client | Watch) -> Iterator[None]:
    failures: list[BaseException] = []

    def run(worker: Client | Watch) -> None:
        try:
            worker.run()
        except BaseException as error:
            failures.append(error)

    running = [threading.Thread(target=run, args=(worker,)) for worker in workers]
    for thread in running:
        thread.start()
    try:
        yield
    finally:
        for worker in workers:
            worker.ending.set()
        for thread in running:
            thread.join()
    if failures:
        raise failures[0]


def disaster(site: Site, proxy: FaultProxy, random_: random.Random, takeovers: list[float]) -> None:
    """Kill or stop whoever writes, and let the network fail; another one has to take over."""
    proxy.faults = [
        Fault(
            random_.choice(["lost", "closed", "409", "503"]), random_.randint(1, 4), random_.choice(["PUT", "GET", "."])
        )
    ]
    writer = next((name for name in ("first", "second") if site.role(name) == "writer"), None)
    if writer is None:
        return
    other = "second" if writer == "first" else "first"
    stops = random_.random() < 0.5
    begun = time.monotonic()
    if stops:
        os.kill(site.servers[writer].pid, signal.SIGSTOP)
    else:
        site.servers[writer].kill()
    try:
        eventually(lambda: site.role(other) == "writer", f"{other} to take over")
        takeovers.append(time.monotonic() - begun)
    finally:
        if stops:
            os.kill(site.servers[writer].pid, signal.SIGCONT)
    if not stops:
        site.start(writer)


@pytest.mark.long
def test_nothing_is_lost_or_wrong_whoever_is_killed(
    s3: Emulator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    random_ = random.Random(os.environ.get("LODESTREAM_SEED", "1"))
    takeovers: list[float] = []
    with fault_proxy(s3.port) as proxy, ExitStack() as stack:
        for name, value in s3.at(proxy.port).items():
            monkeypatch.setenv(name, value)
        site = Site(s3.address(), tmp_path, stack)
        client, watches = Client(site, random_), [Watch(site, name) for name in ("one", "two")]
        with threads(client, *watches):
            end = time.monotonic() + SECONDS
            while time.monotonic() < end:
                time.sleep(random_.uniform(1, 3))
                disaster(site, proxy, random_, takeovers)
            proxy.faults = []
            eventually(lambda: "writer" in (site.role("first"), site.role("second")), "a writer")
            client.ending.set()
            time.sleep(LOOK + SLACK)
        assert len(takeovers) >= 2
        assert len(client.kept) >= 10
        assert max(takeovers) < LEASE + 3 + SLACK
        lags = []
        for name, watch in zip(("one", "two"), watches, strict=True):

            def settled(name: str = name) -> dict[str, str] | None:
                found = site.states(name)
                left = None if found is None else {found.get(id_) for id_ in client.kept.keys() - client.open}
                return found if left == {"ready"} else None

            states = eventually(settled, f"all to be ready at {name}")
            assert not client.gone & states.keys(), "it came back"
            # What was uploaded and not acknowledged may be there, and nothing else.
            assert len(states) <= client.number
            for id_ in client.kept.keys() & states.keys():
                found = site.ask(name, "GET", f"/v1/surfaces/{id_}/container")
                assert found is not None
                decoded = ls.decode(found.content)
                assert np.array_equal(decoded.points, surface(client.kept[id_])), "it is wrong"
            lags += [watch.seen[id_] - client.when[id_] for id_ in client.kept if id_ in watch.seen]
        lags.sort()
        print(
            f"{len(client.when)} acknowledged, {len(client.gone)} deleted; takeovers "
            f"{', '.join(f'{each:.1f}' for each in takeovers)} s; lag of readers median {lags[len(lags) // 2]:.1f} s, "
            f"most {lags[-1]:.1f} s"
        )
        assert lags[len(lags) // 2] < 5.0
        assert lags[-1] < LEASE + 3 + 5 + SLACK
