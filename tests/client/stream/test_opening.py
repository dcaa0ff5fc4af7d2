"""The client's `open` in the address: where it is read, where it is not, and on every later connection."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from numpy.typing import NDArray
from websockets.sync.server import ServerConnection, serve
from websockets.typing import Subprotocol

import lodestream as ls
from lodestream.protocol.handshake import from_address
from lodestream.protocol.messages import BASE_CREDIT, SUBPROTOCOL, Bye, End, Event, Open, Opened, Segments
from lodestream.protocol.wire import parse, serialize
from lodestream.transfer.receiver_state import MemoryStore
from lodestream_client import AsyncClient, Client
from lodestream_client.stream import effects, reconnecting
from lodestream_client.stream.effect_io import EffectIO
from lodestream_client.stream.stream import BaseStream
from tests.links import Fault, Link, linked
from tests.patience import PATIENCE

Terrain = NDArray[np.float32]


@pytest.fixture(params=[False, True], ids=["sync", "async"])
def asynchronous(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.fixture(autouse=True)
def hasty(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reconnecting, "_FIRST_PAUSE", 0.002)
    monkeypatch.setattr(reconnecting, "_LONGEST_PAUSE", 0.05)


@dataclass(frozen=True)
class Dialled:
    """What one handshake said, and how it was answered."""

    opening: Open | None
    subprotocol: str | None


@pytest.fixture
def dialled(monkeypatch: pytest.MonkeyPatch) -> list[Dialled]:
    """All handshakes of a test's streams."""
    found: list[Dialled] = []
    plain = EffectIO._dial

    def note(asked: effects.Dial, answer: effects.Dialled) -> effects.Dialled:
        found.append(Dialled(opening_of(asked.url), answer.subprotocol))
        return answer

    async def dial(self: EffectIO, asked: effects.Dial) -> effects.Dialled:
        return note(asked, await plain(self, asked))

    monkeypatch.setattr(EffectIO, "_dial", dial)
    return found


def opening_of(url: str) -> Open | None:
    values = parse_qs(urlsplit(url).query).get("open")
    if values is None:
        return None
    message = parse(from_address(values[0]))
    assert isinstance(message, Open)
    return message


def follow(url: str, asynchronous: bool, **options: Any) -> tuple[list[ls.View], BaseStream]:
    options = {"close_timeout": 0.5, "transport": "ws", **options}
    if not asynchronous:
        with Client(url).connect(url, **options) as stream:
            return list(stream), stream

    async def loop() -> tuple[list[ls.View], BaseStream]:
        async with AsyncClient(url) as client, client.connect(url, **options) as stream:
            return [view async for view in stream], stream

    return asyncio.run(loop())


@contextmanager
def answering(container: bytes, heard: list[Event]) -> Iterator[str]:
    """A server that writes down what it hears."""

    def behave(connection: ServerConnection) -> None:
        assert connection.request is not None
        opening = opening_of(connection.request.path)
        assert opening is not None
        header = Opened("ab" * 32, len(container), len(container), 1.0, (1, 2), (len(container) - 1, 1), True)
        slices: list[Event] = [Segments(at, container[at : at + 60_000]) for at in range(0, len(container), 60_000)]
        events: list[Event] = [header, *slices, End("complete")]
        for event in events:
            connection.send(serialize(event))
        for message in connection:
            assert isinstance(message, bytes)
            heard.append(parse(message))
            if isinstance(heard[-1], Bye):
                over.set()
                return

    over = threading.Event()
    server = serve(behave, "127.0.0.1", 0, subprotocols=[Subprotocol(SUBPROTOCOL)])
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.socket.getsockname()[1]}/v1/surfaces/ab"
        assert over.wait(PATIENCE), "a client takes leave"
    finally:
        server.shutdown()
        thread.join()


def test_open_is_said_once(container_file: Path, terrain: Terrain, asynchronous: bool) -> None:
    heard: list[Event] = []
    with answering(container_file.read_bytes(), heard) as url:
        views, stream = follow(url, asynchronous, window=BASE_CREDIT)
    assert stream.ended == "complete"
    assert np.array_equal(views[-1].points, terrain)
    assert not any(isinstance(event, Open) for event in heard)
    assert isinstance(heard[-1], Bye)


def test_the_server_reads_it_in_the_address(
    surface: str, terrain: Terrain, asynchronous: bool, dialled: list[Dialled]
) -> None:
    target = ls.Target(max_bytes=5000)
    views, stream = follow(surface, asynchronous, target=target, window=3000)
    assert stream.ended == "bytes"
    assert views[-1].bytes == stream.planned
    assert dialled == [Dialled(Open(target, 3000, decodes=True), SUBPROTOCOL)]
    views, stream = follow(surface, asynchronous)
    assert np.array_equal(views[-1].points, terrain)


def test_what_is_held_goes_with_it_after_a_break(
    surface: str, terrain: Terrain, asynchronous: bool, dialled: list[Dialled]
) -> None:
    breaks = (4000, 3000, 4000)
    with linked(surface, lambda number: Fault(cut_down=breaks[number]) if number < 3 else Fault()) as link:
        views, stream = follow(link.url, asynchronous, window=1500)
    assert np.array_equal(views[-1].points, terrain)
    assert stream._reception.data_bytes == stream._reception.cached.total, "nothing came twice"
    openings = [handshake.opening for handshake in dialled]
    assert [handshake.subprotocol for handshake in dialled] == [SUBPROTOCOL] * len(openings)
    assert len(openings) >= 4
    held = [sum(length for _, length in opening.held) for opening in openings if opening is not None]
    assert held == sorted(held)
    assert held[0] == 0 < held[-1]


def test_what_is_too_long_for_an_address_goes_as_a_message(
    surface: str, terrain: Terrain, asynchronous: bool, dialled: list[Dialled]
) -> None:
    details = Client(surface).get(surface).details
    stored, known = Client(surface).fetch_range(surface, 0, int(details["bytes"])), str(details["container_sha256"])
    store = MemoryStore()
    for offset in range(0, 12_000, 20):
        store.write(offset, stored[offset : offset + 10])
    views, stream = follow(surface, asynchronous, store=store, container=known, size=len(stored))
    assert dialled == [Dialled(None, SUBPROTOCOL)]
    assert np.array_equal(views[-1].points, terrain)
    assert stream.data_bytes == stream._reception.cached.total - 600 * 10


@pytest.mark.parametrize("seconds", [0.1, 0.4])
def test_a_stop_while_a_connection_is_being_made_is_obeyed(surface: str, asynchronous: bool, seconds: float) -> None:
    def fault(number: int) -> Fault:
        return Fault(cut_down=5000) if number == 0 else Fault(delay=0.4)

    async def loop() -> BaseStream:
        async with (
            Link(surface, fault) as link,
            AsyncClient(link.url) as client,
            client.connect(link.url, window=2000, transport="ws") as stream,
        ):
            views = aiter(stream)
            await anext(views)

            async def stop() -> None:
                while link.connections < 2:
                    await asyncio.sleep(0.01)
                await asyncio.sleep(seconds)
                await stream.stop()

            stopping = asyncio.create_task(stop())
            async for _ in views:
                pass
            await stopping
            return stream

    def plain() -> BaseStream:
        with linked(surface, fault) as link, Client(link.url).connect(link.url, window=2000, transport="ws") as stream:
            next(stream)

            def stop() -> None:
                while link.connections < 2:
                    wait.wait(0.01)
                wait.wait(seconds)
                stream.stop()

            wait = threading.Event()
            stopping = threading.Thread(target=stop)
            stopping.start()
            list(stream)
            stopping.join()
            return stream

    stream = asyncio.run(loop()) if asynchronous else plain()
    assert stream.ended == "stopped"
    assert stream.header is not None, "the second connection was opened, and told to stop"
