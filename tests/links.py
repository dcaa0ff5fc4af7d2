"""Links between a client and a server that are slow, far, and break: a TCP proxy of the tests' and benchmarks' own."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from random import Random
from urllib.parse import urlsplit, urlunsplit

__all__ = ["Fault", "Link", "faults_of", "linked"]

_CHUNK = 64 * 1024
_PACKET = 1400

# On a fast link packets go together: each costs this program as much as many bytes.
_PACKET_SECONDS = 0.002

# What a router keeps before it stops taking more, beside what is on its way.
_BUFFER = 64 * 1024
# Seconds of a link without a rate that may be on their way.
_UNLIMITED = 1e9


@dataclass(frozen=True)
class Fault:
    """What is wrong with one connection.

    Attributes
    ----------
    delay : float
        Seconds that each byte takes, either way.
    rate : float or None
        Bytes per second from the server to the client.
    pieces : int or None
        Most bytes that arrive together.
    cut_down, cut_up : int or None
        The connection breaks after so many bytes from the server, or to it.
    reset : bool
        It breaks with a reset, not with an end.
    vanish : bool
        It does not break: nothing more comes, and nobody is told.
    hold_down : int or None
        After so many bytes from the server the rest waits for `Link.release`.
    """

    delay: float = 0.0
    rate: float | None = None
    pieces: int | None = None
    cut_down: int | None = None
    cut_up: int | None = None
    reset: bool = False
    vanish: bool = False
    hold_down: int | None = None


class Link:
    """A proxy in front of one server, with a fault for each connection in turn.

    Attributes
    ----------
    url : str
        The address given, by way of this link.
    connections : int
        How many there were.
    open : int
        How many there are.
    down : int
        Bytes that went to clients.
    """

    def __init__(self, url: str, fault: Callable[[int], Fault]) -> None:
        self._parts = urlsplit(url)
        self._fault = fault
        self._tasks: set[asyncio.Task[None]] = set()
        self._over = False
        self.url = url
        self.connections = 0
        self.down = 0

    @property
    def open(self) -> int:
        return len(self._tasks)

    def cut(self) -> None:
        """Break all connections that there are, from any thread."""
        self._loop.call_soon_threadsafe(self._cut)

    def _cut(self) -> None:
        for task in self._tasks:
            task.cancel()

    def release(self) -> None:
        """Hold nothing any more, from any thread."""
        self._loop.call_soon_threadsafe(self._released.set)

    async def __aenter__(self) -> Link:
        self._loop = asyncio.get_running_loop()
        self._released = asyncio.Event()
        self._server = await asyncio.start_server(self._accept, "127.0.0.1", 0)
        port = self._server.sockets[0].getsockname()[1]
        self.url = urlunsplit(self._parts._replace(netloc=f"127.0.0.1:{port}"))
        return self

    async def __aexit__(self, *raised: object) -> None:
        self._server.close()
        self._over = True
        self._cut()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        fault = self._fault(self.connections)
        self.connections += 1
        try:
            far = await asyncio.open_connection(self._parts.hostname, self._parts.port)
        except (OSError, asyncio.CancelledError):
            writer.transport.abort()
            self._tasks.discard(task)
            return
        try:
            await self._carry(fault, (reader, writer), far)
        except (OSError, asyncio.CancelledError):
            pass
        finally:
            for end in (writer, far[1]):
                if fault.reset or self._over:  # the loop ends before what is left could be sent
                    end.transport.abort()
                else:
                    end.close()
            self._tasks.discard(task)

    async def _carry(
        self,
        fault: Fault,
        near: tuple[asyncio.StreamReader, asyncio.StreamWriter],
        far: tuple[asyncio.StreamReader, asyncio.StreamWriter],
    ) -> None:
        down, up = _read(far[0], fault.hold_down, self._released), _read(near[0], None, self._released)
        both = [
            asyncio.ensure_future(_pipe(down, near[1], fault, fault.rate, fault.cut_down, self._count)),
            asyncio.ensure_future(_pipe(up, far[1], fault, None, fault.cut_up, None)),
        ]
        try:
            done, others = await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
            if any(way.exception() is None and way.result() for way in done):
                if fault.vanish:
                    await asyncio.Event().wait()
                return
            if others:
                await asyncio.wait(others, timeout=5.0)
        finally:
            for way in both:
                way.cancel()
            await asyncio.gather(*both, return_exceptions=True)

    def _count(self, size: int) -> None:
        self.down += size


async def _read(reader: asyncio.StreamReader, hold: int | None, released: asyncio.Event) -> AsyncIterator[bytes]:
    while data := await reader.read(min(_CHUNK, hold or _CHUNK)):
        yield data
        if hold is not None:
            hold -= len(data)
            if hold == 0:
                await released.wait()
                hold = None


async def _pipe(
    source: AsyncIterator[bytes],
    writer: asyncio.StreamWriter,
    fault: Fault,
    rate: float | None,
    cut: int | None,
    count: Callable[[int], None] | None,
) -> bool:
    """Carry one way until its end; whether that was a cut."""
    loop = asyncio.get_running_loop()
    queue: deque[tuple[float, bytes]] = deque()
    queued = 0
    buffer = _BUFFER + round((rate or _UNLIMITED) * fault.delay)
    packet = _CHUNK if rate is None else max(_PACKET, round(rate * _PACKET_SECONDS))
    room, news = asyncio.Event(), asyncio.Event()
    ended = False

    async def take() -> None:
        nonlocal queued, ended
        free = 0.0
        try:
            async for data in source:
                step = fault.pieces or packet
                for start in range(0, len(data), step):
                    piece = data[start : start + step]
                    now = loop.time()
                    if rate is not None:
                        free = max(free, now) + len(piece) / rate
                    queue.append((max(free, now) + fault.delay, piece))
                    queued += len(piece)
                    news.set()
                while queued > buffer:
                    room.clear()
                    await room.wait()
        finally:
            ended = True
            news.set()

    taking = asyncio.ensure_future(take())
    try:
        while True:
            while not queue:
                if ended:
                    # One side has said its last; the other may still have something to say.
                    if writer.can_write_eof():
                        writer.write_eof()
                    return False
                news.clear()
                await news.wait()
            due, piece = queue.popleft()
            if (wait := due - loop.time()) > 0:
                await asyncio.sleep(wait)
            elif fault.pieces is not None:
                await asyncio.sleep(0)
            if cut is not None:
                piece, cut = piece[:cut], cut - len(piece)
            writer.write(piece)
            await writer.drain()
            queued -= len(piece)
            room.set()
            if count is not None:
                count(len(piece))
            if cut is not None and cut <= 0:
                return True
    finally:
        taking.cancel()
        await asyncio.gather(taking, return_exceptions=True)


@contextmanager
def linked(url: str, fault: Callable[[int], Fault] | Fault) -> Iterator[Link]:
    """A link in a thread of its own, for programs without an event loop."""
    link = Link(url, (lambda _: fault) if isinstance(fault, Fault) else fault)
    ready, over = threading.Event(), threading.Event()

    async def serve() -> None:
        async with link:
            ready.set()
            await asyncio.to_thread(over.wait)

    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    ready.wait()
    try:
        yield link
    finally:
        over.set()
        thread.join()


def faults_of(random: Random, size: int) -> Callable[[int], Fault]:
    """Faults of a surface of so many bytes, whose first connections break and whose later ones hold."""
    broken = [_fault(random, size) for _ in range(random.choice((1, 1, 2, 3, 5)))]
    last = _manner(random)
    return lambda number: broken[number] if number < len(broken) else last


def _fault(random: Random, size: int) -> Fault:
    manner = _manner(random)
    # A handshake takes some 200 bytes; a cut may lie in it, in the stream, or behind its end.
    cut = random.randrange(0, 400 + int(size * 1.2))
    up = random.random() < 0.15
    return Fault(
        manner.delay,
        manner.rate,
        manner.pieces,
        None if up else cut,
        random.randrange(0, 600) if up else None,
        random.random() < 0.5,
        random.random() < 0.03,
    )


def _manner(random: Random) -> Fault:
    return Fault(
        delay=random.choice((0.0, 0.0, 0.001, 0.003)),
        rate=random.choice((None, None, None, 200_000.0, 1_000_000.0)),
        pieces=random.choice((None, None, 23, 200, 1000)),
    )
