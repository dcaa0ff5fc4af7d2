"""Containers that are fetched for whoever waits, and for nobody any more."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

from lodestream_server.access.access import Caller
from lodestream_server.builds.fetching import Fetching
from lodestream_server.store.containers import Containers
from tests.patience import PATIENCE

ANNA = Caller("token anna", "anna", "anna")


class Slow:
    """Containers that are fetched once the door is open."""

    def __init__(self) -> None:
        self.door = threading.Event()
        self.asked: list[str] = []
        self.here: set[str] = set()

    def is_here(self, container: str) -> bool:
        return container in self.here

    @contextmanager
    def _fetched(self, container: str) -> Iterator[Path]:
        assert self.door.wait(PATIENCE)
        self.here.add(container)
        yield Path(container)

    def local(self, container: str) -> Any:
        self.asked.append(container)
        return self._fetched(container)


async def turned() -> None:
    """Let tasks go on until they wait for a thread."""
    for _ in range(20):
        await asyncio.sleep(0)


async def given_up(fetching: Fetching, slow: Slow, container: str) -> None:
    """Ask for a container, and leave when a thread fetches it."""
    task = asyncio.create_task(fetching.fetch(container, ANNA))
    while container not in slow.asked:
        await asyncio.sleep(0)
    task.cancel()
    with suppress(asyncio.CancelledError):
        await task


def test_clients_that_come_and_go_take_no_more_threads() -> None:
    slow = Slow()

    async def run() -> None:
        fetching = Fetching(cast(Containers, slow))
        await given_up(fetching, slow, "a")
        await given_up(fetching, slow, "b")
        # Of the same container one thread is enough, and another one waits for the end of a thread.
        waiting = [asyncio.create_task(fetching.fetch(each, ANNA)) for each in ("a", "c")]
        await turned()
        assert slow.asked == ["a", "b"]
        slow.door.set()
        await asyncio.gather(*waiting)
        assert slow.asked == ["a", "b", "c"]
        await fetching.close()

    asyncio.run(run())


def test_the_end_does_not_wait_for_what_nobody_waits_for() -> None:
    slow = Slow()

    async def run() -> None:
        fetching = Fetching(cast(Containers, slow))
        await given_up(fetching, slow, "a")
        await fetching.close()

    asyncio.run(run())
    assert slow.here == set()
    slow.door.set()
