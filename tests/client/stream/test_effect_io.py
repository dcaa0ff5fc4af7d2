"""The effects of HTTP on an event loop: what is read ahead of whoever asks, and for how long somebody waits."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine

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
        coming = asyncio.Event()

        async def body() -> AsyncIterator[bytes]:
            yield b"first"
            await coming.wait()
            yield b"second"

        io = await opened(body(), seconds=0.05)
        assert await read(io) == b"first"
        await asyncio.sleep(0.1)  # somebody looks at a view
        asyncio.get_running_loop().call_later(0.01, coming.set)
        assert await read(io) == b"second"
        assert await read(io) == b""
        await io.hang_up(HangUp())

        coming.clear()
        io = await opened(body(), seconds=0.05)
        assert await read(io) == b"first"
        with pytest.raises(httpx.ReadTimeout):
            await read(io)
        await io.hang_up(HangUp())
        assert not io.open

    asyncio.run(run())


def test_an_answer_that_does_not_begin_is_waited_for_as_long_as_was_said() -> None:
    async def run() -> None:
        async def answer(request: httpx.Request) -> httpx.Response:
            await asyncio.Event().wait()
            raise AssertionError("nothing wakes this")

        with pytest.raises(httpx.ReadTimeout):
            await asked(answer, 0.05)

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
