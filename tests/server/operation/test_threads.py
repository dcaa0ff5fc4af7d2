"""Work in threads, whose tasks may be cancelled at any moment."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress

import pytest

from lodestream_server.operation.threads import entered
from tests.patience import PATIENCE


class Door:
    """A context that is entered when it is opened, and when it was left."""

    def __init__(self) -> None:
        self.open, self.begun, self.left = threading.Event(), threading.Event(), threading.Event()

    @contextmanager
    def context(self) -> Iterator[str]:
        self.begun.set()
        assert self.open.wait(PATIENCE)
        try:
            yield "in"
        finally:
            self.left.set()


def test_what_is_entered_is_left_with_the_stack() -> None:
    door = Door()
    door.open.set()
    with ExitStack() as held:
        assert asyncio.run(entered(door.context(), held)) == "in"
        assert not door.left.is_set()
    assert door.left.is_set()


@pytest.mark.parametrize("times", [1, 2])
def test_whoever_is_cancelled_does_not_wait_and_what_is_entered_then_is_left(times: int) -> None:
    door = Door()

    async def run() -> None:
        with ExitStack() as held:
            entering = asyncio.create_task(entered(door.context(), held))
            await asyncio.to_thread(door.begun.wait, PATIENCE)
            for _ in range(times):
                entering.cancel()
                await asyncio.sleep(0)
            with suppress(asyncio.CancelledError):
                await entering
            assert entering.cancelled()

    asyncio.run(run())
    assert not door.left.is_set()
    door.open.set()
    assert door.left.wait(PATIENCE)
