"""Clients that send, and send, what nobody wants: pings, fragments, the rest of what was refused."""

from __future__ import annotations

import asyncio
import logging
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from lodestream.protocol.messages import Open
from lodestream.protocol.wire import serialize
from lodestream_server.connections.cuts import REASONS, Cuts
from lodestream_server.operation.metrics import Metrics
from tests.server.connections.sockets import (
    CHUNKS,
    CONTINUATION,
    PING,
    PONG,
    Place,
    Reader,
    chunked,
    frame,
    handshake,
    read_stream,
)
from tests.server.helpers import PATIENCE, eventually, hills, npy, push
from tests.server.programs import Server, resident, server
from tests.torture.parts import sent as hash_of_stream

# What both ends' systems may hold of what was sent and not read.
SYSTEM = 24 << 20


@dataclass(frozen=True)
class Flood:
    """What an offender sends: once, then over and over.

    Attributes
    ----------
    reason : str
        Why its connection is to be cut.
    stream : bool
        It begins with the handshake of a stream.
    """

    reason: str
    stream: bool
    first: bytes
    block: bytes


FLOODS = {
    "pings": Flood("frames", True, frame(serialize(Open(credit=1000))), frame(bytes(125), PING) * 2000),
    "empty fragments": Flood("frames", True, frame(b"", last=False), frame(b"", CONTINUATION, last=False) * 40_000),
    "pongs": Flood("frames", True, frame(serialize(Open(credit=1000))), frame(b"", PONG) * 40_000),
    "refused chunks": Flood("refused-body", False, chunked(b"POST /nothing"), CHUNKS),
    "refused body": Flood(
        "refused-body",
        False,
        b"POST /v1/surfaces HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000000000000\r\n\r\n",
        bytes(1 << 18),
    ),
}


class Offender(threading.Thread):
    """Sends a flood, reads nothing, and comes back when it was cut.

    Attributes
    ----------
    cuts : int
        How often it was.
    most : int
        The most bytes that went out over one connection.
    """

    def __init__(self, place: Place, flood: Flood) -> None:
        super().__init__(daemon=True)
        self.cuts = 0
        self.most = 0
        self._place = place
        self._flood = flood
        self._over = threading.Event()

    def __enter__(self) -> Offender:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self.join()

    def run(self) -> None:
        while not self._over.is_set():
            with socket.create_connection((self._place.host, self._place.port), timeout=PATIENCE) as connection:
                self._send(connection)

    def _send(self, connection: socket.socket) -> None:
        size, todo = 0, memoryview(self._flood.first)
        try:
            if self._flood.stream:
                connection.sendall(handshake(self._place))
                assert connection.recv(12).startswith(b"HTTP/1.1 101")
            connection.settimeout(0.2)
            while not self._over.is_set():
                try:
                    size += (went := connection.send(todo))
                except TimeoutError:
                    continue
                self.most = max(self.most, size)
                todo = todo[went:] or memoryview(self._flood.block)
        except (ConnectionResetError, BrokenPipeError):
            self.cuts += 1


@dataclass(frozen=True)
class Running:
    """A server in a process of its own with a surface, and the hash of what a stream of it carries."""

    server: Server
    place: Place
    sha256: str

    def kinds(self) -> dict[str, float]:
        """What its metrics say of errors, by kind."""
        with self.server.client() as http:
            lines = http.get("/metrics").text.splitlines()
        found = [line.split('"') for line in lines if line.startswith("lodestream_errors_total{")]
        return {kind: float(number.split()[-1]) for _, kind, number in found}


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    data = tmp_path_factory.mktemp("flooded") / "data"
    with server(data, upload_bytes=4 << 20) as program:
        with program.client() as http:
            surface = push(http, npy(hills(420, 400)))
        container = (data / "containers" / f"{surface['container_sha256']}.lode").read_bytes()
        yield Running(program, Place.of(program.url + surface["url"]), hash_of_stream(container))


@pytest.mark.parametrize("name", FLOODS)
def test_others_are_served_while_a_flood_goes_on(running: Running, name: str) -> None:
    flood = FLOODS[name]
    before, counted = running.server.look().resident, running.kinds().get(flood.reason, 0)
    most, answers = before, 0
    with Offender(running.place, flood) as offender, running.server.client() as http:
        until = time.monotonic() + PATIENCE
        while answers < 3 or not offender.cuts:
            assert time.monotonic() < until, "the server takes whatever comes"
            http.get("/healthz").raise_for_status()
            answers += 1
            most = max(most, resident(running.server.pid))
            reader = asyncio.run(read_stream(running.place, Reader()))
            assert (reader.ended, reader.closed, reader.sha256) == ("complete", 1000, running.sha256)
    assert offender.most < SYSTEM
    assert most - before < 16 << 20
    assert running.kinds()[flood.reason] - counted >= offender.cuts
    # A thread of its own writes the log.
    eventually(lambda: f"connection cut: {flood.reason} " in running.server.log.read_text(), "a line of the log")
    assert "Traceback" not in running.server.log.read_text()


@pytest.mark.long
def test_nothing_remains_of_floods(running: Running) -> None:
    before = running.server.look()
    for flood in FLOODS.values():
        with Offender(running.place, flood) as offender:
            eventually(lambda offender=offender: offender.cuts, "the connection to be cut")  # type: ignore[misc]

    def gone() -> bool:
        now = running.server.look()
        return now.tasks <= before.tasks and now.sockets <= before.sockets

    eventually(gone, "tasks and sockets to be as before")


def test_each_cut_is_told_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    metrics = Metrics()
    cuts = Cuts(metrics)
    with caplog.at_level(logging.WARNING, "lodestream_server"):
        for number in range(1000):
            cuts.note("frames", (f"192.0.2.{number % 200}", 5))
    assert [record.getMessage() for record in caplog.records] == ["connection cut: frames"] * 1000
    assert b'lodestream_errors_total{kind="frames"} 1000.0' in metrics.text()


def test_every_reason_is_in_the_manual() -> None:
    manual = Path(__file__).parents[3].joinpath("docs/operating.md").read_text()
    for reason in REASONS:
        assert f"`{reason}`" in manual, reason
