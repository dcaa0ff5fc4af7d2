"""The effects of HTTP on an event loop: what is read ahead of whoever asks, and for how long somebody waits."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from functools import partial

import httpx
import pytest

from lodestream_client.stream.effect_io import EffectIO
from lodestream_client.stream.effects import Get, HangUp, Read
from lodestream_client.stream.options import ConnectOptions
from lodestream_client.stream.session import Session

URL = "http://127.0.0.1:9/v1/surfaces/ab"
MANY = 100
#: Turns of the loop in which all that is possible without waiting is done.
TURNS = 20 * MANY


class Clock:
    """What the running loop takes for the time: it goes on when it is told to, however busy the machine is."""

    def __init__(self) -> None:
        loop = asyncio.get_running_loop()
        self.now = loop.time()
        loop.time = lambda: self.now  # type: ignore[method-assign]


async def opened(body: AsyncIterator[bytes], seconds: float = 30.0) -> EffectIO:
    """Return what has the head of an answer with this body."""

    async def answer(request: httpx.Request) -> httpx.Response:
        return httpx.Response(206, content=body)

    return await asked(answer, seconds)


async def asked(answer: Callable[[httpx.Request], Coroutine[None, None, httpx.Response]], seconds: float) -> EffectIO:
    client = httpx.AsyncClient(transport=httpx.MockTransport(answer))
    io = EffectIO(Session(URL, ConnectOptions()), lambda: client)
    await io.perform(Get(URL, {}, seconds))
    return io


async def read(io: EffectIO) -> bytes:
    if not io.arrived:
        await io.perform(Read())
    return io.arrived.popleft()


def test_a_bounded_number_of_chunks_is_read_ahead() -> None:
    given: list[bytes] = []

    async def body() -> AsyncIterator[bytes]:
        for number in range(MANY):
            given.append(b"%d" % number)
            yield given[-1]

    async def run() -> list[bytes]:
        io = await opened(body())
        taken = [await read(io)]
        for _ in range(TURNS):
            await asyncio.sleep(0)
        assert 1 < len(given) <= 10  # some, without being asked for each; and not all, while nobody asks
        while chunk := await read(io):
            taken.append(chunk)
        await io.hang_up(HangUp())
        return taken

    assert asyncio.run(run()) == given
    assert len(given) == MANY


def test_the_time_for_a_chunk_begins_when_it_is_asked_for() -> None:
    async def run() -> None:
        clock, coming, loop = Clock(), asyncio.Event(), asyncio.get_running_loop()

        async def body() -> AsyncIterator[bytes]:
            yield b"first"
            await coming.wait()
            yield b"second"

        def later(seconds: float, *, comes: bool) -> None:
            clock.now += seconds
            if comes:
                coming.set()

        io = await opened(body(), seconds=10.0)
        assert await read(io) == b"first"
        clock.now += 20  # somebody looks at a view
        for _ in range(TURNS):
            await asyncio.sleep(0)
        loop.call_soon(partial(later, 9, comes=True))
        assert await read(io) == b"second"
        assert await read(io) == b""
        await io.hang_up(HangUp())

        coming.clear()
        io = await opened(body(), seconds=10.0)
        assert await read(io) == b"first"
        loop.call_soon(partial(later, 11, comes=False))
        with pytest.raises(httpx.ReadTimeout):
            await read(io)
        await io.hang_up(HangUp())
        assert not io.open

    asyncio.run(run())


def test_an_answer_that_does_not_begin_is_waited_for_as_long_as_was_said() -> None:
    async def run() -> None:
        clock = Clock()

        async def answer(request: httpx.Request) -> httpx.Response:
            clock.now += 9
            for _ in range(TURNS):
                await asyncio.sleep(0)
            waited.append(9)
            clock.now += 2
            await asyncio.Event().wait()
            raise AssertionError("nothing wakes this")

        waited = list[int]()
        with pytest.raises(httpx.ReadTimeout):
            await asked(answer, 10.0)
        assert waited == [9]

    asyncio.run(run())


def test_an_error_comes_after_what_came_before_it() -> None:
    async def run() -> None:
        async def body() -> AsyncIterator[bytes]:
            yield b"first"
            yield b"second"
            raise httpx.ReadError("the cable was pulled")

        io = await opened(body())
        assert [await read(io), await read(io)] == [b"first", b"second"]
        for _ in range(2):  # however often it is asked for
            with pytest.raises(httpx.ReadError, match="cable"):
                await read(io)
        await io.hang_up(HangUp())

    asyncio.run(run())
