"""Small messages go out together, in order and soon; large ones and the first ones at once."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream_server.connections.joined import Joined

ALONE, ENOUGH, TURNS = 4, 8192, 4


class Recorder:
    """A transport that keeps what is written to it."""

    def __init__(self) -> None:
        self.written: list[bytes] = []
        self.closed = self.aborted = False
        self.unsent = 1000

    def write(self, data: bytes) -> None:
        assert not self.closed
        self.written.append(data)

    def close(self) -> None:
        self.closed = True

    def abort(self) -> None:
        self.closed = self.aborted = True

    def is_closing(self) -> bool:
        return self.closed

    def get_write_buffer_size(self) -> int:
        return self.unsent

    def get_extra_info(self, name: str) -> str:
        return name


async def turns(number: int) -> None:
    for _ in range(number):
        await asyncio.sleep(0)


def joined(seconds: float = 600.0, when_slow: Callable[[], object] = bool) -> tuple[Joined, Recorder]:
    """One that has sent its first writes, and what it writes to."""
    recorder = Recorder()
    transport = Joined(cast(Any, recorder), seconds, when_slow)
    for number in range(ALONE):
        transport.write(b"%d" % number)
    assert recorder.written == [b"0", b"1", b"2", b"3"], "the first ones go out at once"
    recorder.written.clear()
    return transport, recorder


@given(st.lists(st.tuples(st.binary(min_size=1, max_size=3 * ENOUGH), st.integers(0, 2 * TURNS)), max_size=20))
def test_everything_comes_in_order_and_nothing_stays(writes: list[tuple[bytes, int]]) -> None:
    async def run() -> None:
        transport, recorder = joined()
        for data, wait in writes:
            transport.write(data)
            assert transport.get_write_buffer_size() - 1000 < ENOUGH, "what is large is not held"
            await turns(wait)
            if wait > TURNS:
                assert transport.get_write_buffer_size() == 1000, "what is small is sent soon"
        await turns(TURNS + 1)
        assert b"".join(recorder.written) == b"".join(data for data, _ in writes)
        assert transport.get_write_buffer_size() == 1000

    asyncio.run(run())


def test_what_is_written_within_some_turns_goes_out_together() -> None:
    async def run() -> None:
        transport, recorder = joined()
        for _ in range(10):
            transport.write(b"ab")
            await turns(TURNS - 1)
        assert recorder.written == []
        await turns(TURNS)
        assert recorder.written == [b"ab" * 10]

    asyncio.run(run())


def test_closing_sends_what_is_held_and_aborting_does_not() -> None:
    async def run() -> None:
        transport, recorder = joined()
        transport.write(b"last")
        transport.close()
        assert (recorder.written, recorder.closed) == ([b"last"], True)
        transport.write(b"late")
        await turns(2 * TURNS)
        assert recorder.written == [b"last"], "nothing is written to a transport that is closed"

        transport, recorder = joined()
        transport.write(b"lost")
        transport.abort()
        await turns(2 * TURNS)
        assert (recorder.written, recorder.aborted) == ([], True)
        assert transport.get_extra_info("peername") == "peername"

    asyncio.run(run())


@pytest.mark.parametrize("reads", [False, True])
def test_closing_waits_for_whoever_does_not_read_for_some_time_only(reads: bool) -> None:
    async def run() -> None:
        slow: list[bool] = []
        transport, recorder = joined(0.01, lambda: slow.append(recorder.aborted))
        transport.close()
        assert (recorder.closed, recorder.aborted) == (True, False)
        if reads:
            recorder.unsent = 0
        await asyncio.sleep(0.05)
        assert recorder.aborted is not reads
        assert slow == ([] if reads else [False])

    asyncio.run(run())
