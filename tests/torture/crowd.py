"""Clients that do not behave, many of each at once beside honest ones, and what they leave in the server."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import random
import socket
import struct
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any

from lodestream.protocol.messages import BASE_CREDIT, Open
from lodestream.protocol.wire import serialize
from tests.server.connections.sockets import (
    CHUNKS,
    CONTINUATION,
    PING,
    Place,
    Reader,
    chunked,
    frame,
    handshake,
    read_stream,
)
from tests.server.programs import Server, Within, resident

from .health import Health, watched

__all__ = ["BARE", "WHOLE", "Outcome", "settings", "visit"]

#: How long the server waits for anybody: a crowd is gone soon after.
IDLE_SECONDS = 3.0

_PATIENCE = 120.0
_SAMPLE_SECONDS = 0.05

# How many come in a second, of each kind: a system forgets connections that come faster than they are accepted, and
# whoever was forgotten tries again seconds later, the honest ones too.
_ARRIVALS = 100

# Fewer than the documented proxy allows one address.
_OF_AN_ADDRESS = 25


def settings(count: int) -> dict[str, Any]:
    """Settings of a server that is to stand a crowd with so many of each kind, bare or behind a proxy."""
    return {
        "idle_seconds": IDLE_SECONDS,
        "head_seconds": IDLE_SECONDS,
        "bye_seconds": IDLE_SECONDS,
        "max_uploads": 4 * count + 64,
        "upload_bytes": 1 << 20,
        "max_connections": 20 * count + 500,
        "max_streams": 20 * count + 500,
    }


@dataclass(frozen=True)
class Outcome:
    """What a crowd did.

    Attributes
    ----------
    honest, hostile : int
        Connections.
    wrong : tuple of str
        What honest clients complain of.
    grown : int
        Bytes by which the server's memory grew at the most, for each connection.
    before, after : Within
        What the server held before the crowd came, and when it was gone.
    seconds : float
        Until the last honest client had finished.
    health : Health
        How ``/healthz`` was answered meanwhile.
    """

    honest: int
    hostile: int
    wrong: tuple[str, ...]
    grown: int
    before: Within
    after: Within
    seconds: float
    health: Health

    @property
    def remains(self) -> tuple[str, ...]:
        """What the crowd left in the server."""
        left = [f"open file {name}" for name in self.after.files if name not in self.before.files]
        for name in ("tasks", "sockets"):
            was, now = getattr(self.before, name), getattr(self.after, name)
            if now > was:
                left.append(f"{now - was} {name}")
        return tuple(left)


class _Client:
    """A connection that is closed when the ``with`` block ends, whatever happens in it."""

    def __init__(self, place: Place, source: str, random_: random.Random) -> None:
        self.place = place
        self.source = source
        self.random = random_
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        self.socket.setblocking(False)

    @property
    def host(self) -> str:
        """What a request says of where it goes."""
        return f"{self.place.host}:{self.place.port}"

    async def connect(self, *, small: bool = False) -> None:
        if small:
            # Before connecting, so that the window that is offered is small too.
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        self.socket.bind((self.source, 0))
        await asyncio.get_running_loop().sock_connect(self.socket, (self.place.host, self.place.port))

    async def send(self, data: bytes) -> None:
        await asyncio.get_running_loop().sock_sendall(self.socket, data)

    async def receive(self, most: int) -> bytes:
        return await asyncio.get_running_loop().sock_recv(self.socket, most)

    async def open(self, *, small: bool = False) -> None:
        """Open a stream, of which nothing but the answer to the handshake is read."""
        await self.connect(small=small)
        await self.send(handshake(self.place))
        head = b""
        while not head.endswith(b"\r\n\r\n"):
            head += await self.receive(1)
        await self.send(frame(serialize(Open(credit=BASE_CREDIT))))

    async def __aenter__(self) -> _Client:
        return self

    async def __aexit__(self, *_: object) -> None:
        self.socket.close()


async def never_reads(client: _Client) -> None:
    """Open a stream, and take nothing of it."""
    await client.open(small=client.random.random() < 0.5)
    await asyncio.sleep(_PATIENCE)


async def one_byte_a_second(client: _Client) -> None:
    """Open a stream, and read a byte each second."""
    await client.open(small=True)
    while await client.receive(1):
        await asyncio.sleep(1)


async def vanishes(client: _Client) -> None:
    """Open a stream, read some of it, or do not even await the answer, and be gone without a word."""
    if client.random.random() < 0.5:
        await client.open()
        await client.receive(client.random.randrange(1, 65536))
    else:
        await client.connect()
        await client.send(handshake(client.place))
    client.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # reset, not closed


async def garbage(client: _Client) -> None:
    """Send what is no HTTP, no frame, no message, or no message of this protocol."""
    await client.connect()
    kind, noise = client.random.randrange(4), client.random.randbytes(client.random.randrange(1, 5000))
    if kind:
        await client.send(handshake(client.place))
        await client.receive(4096)
    opened = frame(serialize(Open(credit=BASE_CREDIT)))
    await client.send((noise, noise, frame(noise), opened + frame(noise))[kind])
    while await client.receive(65536):
        pass
    await asyncio.sleep(_PATIENCE)


async def never_speaks(client: _Client) -> None:
    """Connect, or connect and agree on a WebSocket, and say nothing."""
    await client.connect()
    if client.random.random() < 0.5:
        await client.send(handshake(client.place))
    await asyncio.sleep(_PATIENCE)


async def slow_upload(client: _Client) -> None:
    """Promise a file, and send a byte of it each second."""
    await client.connect()
    await client.send(f"POST /v1/surfaces HTTP/1.1\r\nHost: {client.host}\r\nContent-Length: 1000000\r\n\r\n".encode())
    while True:
        await client.send(client.random.randbytes(1))
        await asyncio.sleep(1)


async def pings_unread(client: _Client) -> None:
    """Open a stream, and send pings without end, of whose pongs none is read."""
    await client.open(small=True)
    await _on_and_on(client, frame(bytes(125), PING) * 2000)


async def empty_fragments(client: _Client) -> None:
    """Open a stream, and begin a message that goes on in empty fragments."""
    await client.open(small=True)
    await client.send(frame(b"", last=False))
    await _on_and_on(client, frame(b"", CONTINUATION, last=False) * 20_000)


async def endless_message(client: _Client) -> None:
    """Open a stream, and begin a message that goes on in fragments of a byte, no faster than frames may come."""
    await client.open(small=True)
    await client.send(frame(b"a", last=False))
    await _on_and_on(client, frame(b"a", CONTINUATION, last=False), 0.025)


async def one_byte_chunks(client: _Client) -> None:
    """Upload in chunks of a byte."""
    await client.connect()
    await client.send(chunked())
    await _on_and_on(client, CHUNKS)


async def refused_upload(client: _Client) -> None:
    """Upload what is refused at once, and go on."""
    await client.connect()
    path, size = ("/v1/surfaces", 1 << 50) if client.random.random() < 0.5 else ("/v1/nothing", 1 << 30)
    await client.send(f"POST {path} HTTP/1.1\r\nHost: {client.host}\r\nContent-Length: {size}\r\n\r\n".encode())
    await _on_and_on(client, bytes(1 << 16))


async def _on_and_on(client: _Client, data: bytes, pause: float = 0.0) -> None:
    while True:
        await client.send(data)
        await asyncio.sleep(pause)


#: What a bare server withstands.
BARE: tuple[Callable[[_Client], Awaitable[None]], ...] = (
    never_reads,
    one_byte_a_second,
    vanishes,
    garbage,
    never_speaks,
    slow_upload,
    pings_unread,
    empty_fragments,
    endless_message,
    refused_upload,
)

#: What a server behind the documented proxy withstands.
WHOLE = (*BARE, one_byte_chunks)


async def visit(
    server: Server,
    url: str,
    sha256: str,
    count: int,
    honest: int,
    kinds: Sequence[Callable[[_Client], Awaitable[None]]] = BARE,
    seed: int = 1,
) -> Outcome:
    """Send ``count`` clients of each kind to a server, and honest ones that read a surface to its end.

    They come from many addresses of this machine, as Linux has them.

    Parameters
    ----------
    server : Server
        Made with `settings`.
    url : str
        A surface on it, there or at a proxy in front.
    sha256 : str
        What the honest ones are to read: the hash of the container's parts in the order in which they are sent.
    count, honest : int
        How many of each kind, and how many honest ones in all.
    kinds : sequence
        Of `WHOLE`.
    """
    place, random_ = Place.of(url), random.Random(seed)
    await _honest(place, sha256, honest)  # what the server needs once for all
    before = await _settled(server)
    most = [before.resident]
    watching = asyncio.create_task(_sample(server.pid, most))
    async with watched(server.url) as watching_health:
        hostile = [
            asyncio.create_task(
                _behave(behave, _Client(place, _source(1, rank), random.Random(random_.random())), number / _ARRIVALS)
            )
            for rank, (number, behave) in enumerate(itertools.product(range(count), kinds))
        ]
        await asyncio.sleep(count / _ARRIVALS / 2)
        started = asyncio.get_running_loop().time()
        wrong = await _honest(place, sha256, honest)
        seconds = asyncio.get_running_loop().time() - started
        # The server has had enough of each of them by itself, before they are gone.
        await asyncio.sleep(IDLE_SECONDS)
    after = await _settled(server, before)
    watching.cancel()
    for task in hostile:
        task.cancel()
    await asyncio.gather(*hostile, return_exceptions=True)
    grown = (most[0] - before.resident) // (honest + len(hostile))
    return Outcome(honest, len(hostile), wrong, grown, before, after, seconds, watching_health.health)


async def _behave(behave: Callable[[_Client], Awaitable[None]], client: _Client, seconds: float) -> None:
    async with client:
        await asyncio.sleep(seconds)
        # What the server does with it is seen in the server.
        with contextlib.suppress(OSError):
            await behave(client)


def _source(network: int, rank: int) -> str:
    """Return an address of this machine, the same for a few clients."""
    high, low = divmod(rank // _OF_AN_ADDRESS, 250)
    return f"127.{network}.{high}.{low + 1}"


async def _honest(place: Place, sha256: str, count: int) -> tuple[str, ...]:
    async def read(number: int) -> str | None:
        window = (4096, 30_000, BASE_CREDIT)[number % 3]
        try:
            async with asyncio.timeout(_PATIENCE):
                reader = await read_stream(place, Reader(window=window), _source(2, number))
        except (OSError, TimeoutError) as error:
            return f"{type(error).__name__}: {error}"
        if (reader.ended, reader.closed, reader.sha256) != ("complete", 1000, sha256):
            return f"expected the whole surface, got {reader.size} bytes, end {reader.ended}, close {reader.closed}"
        return None

    return tuple(wrong for wrong in await asyncio.gather(*map(read, range(count))) if wrong)


async def _sample(process: int, most: list[int]) -> None:
    while True:
        most[0] = max(most[0], resident(process))
        await asyncio.sleep(_SAMPLE_SECONDS)


async def _settled(server: Server, like: Within | None = None) -> Within:
    """What the server holds when that does not change any more, or is no more than it was."""
    loop = asyncio.get_running_loop()
    until, last = loop.time() + _PATIENCE, None
    while True:
        now = await asyncio.to_thread(server.look)
        held = (now.tasks, now.sockets, now.files)
        if like is None and held == last:
            return now
        if like is not None and now.tasks <= like.tasks and now.sockets <= like.sockets and now.files == like.files:
            return now
        if loop.time() > until:
            return now
        last = held
        await asyncio.sleep(0.2)
