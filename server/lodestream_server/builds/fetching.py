"""Fetching containers of a bucket before what is made of them has its turn: so nobody else waits for the bucket."""

from __future__ import annotations

import asyncio
import logging
from contextlib import ExitStack, suppress
from functools import partial

from ..access.access import Caller
from ..operation.threads import in_store
from ..problems import BusyError
from ..store.containers import Containers
from .processes import Call
from .runner import Runner

__all__ = ["Fetching"]

# Containers that are fetched at the same time.
_AT_ONCE = 2

# For so many seconds it counts for whom containers were fetched.
_REMEMBERED = 60.0


class Fetching:
    """Fetches containers to this machine.

    Parameters
    ----------
    containers : Containers
    """

    def __init__(self, containers: Containers) -> None:
        self._containers = containers
        self._runner = Runner[str, Call]("container", _AT_ONCE, _REMEMBERED, None, logging.DEBUG)
        #: Those that threads are at work on, also if nobody waits any more: nothing ends a thread before its time.
        self._going: dict[str, asyncio.Task[None]] = {}

    async def fetch(self, container: str, caller: Caller) -> None:
        """Fetch a container unless it is here; where others take its room, it is left to whoever uses it to try again.

        Raises
        ------
        LodestreamError
            See `Containers.local`.
        RestartingError
            If the server ends.
        """
        if self._containers.is_here(container):
            return
        with suppress(BusyError):
            async with self._runner.job(container, caller.key, partial(self._fetch, container)):
                pass

    async def close(self) -> None:
        """Give up what is being fetched."""
        await self._runner.close()
        given_up = list(self._going.values())
        for each in given_up:
            each.cancel()
        await asyncio.gather(*given_up, return_exceptions=True)

    async def _fetch(self, container: str, _: ExitStack) -> None:
        # Clients that come and go, as maps do, would otherwise take all threads.
        while container not in self._going and len(self._going) >= _AT_ONCE:
            await asyncio.wait(self._going.values(), return_when=asyncio.FIRST_COMPLETED)
        going = self._going.get(container)
        if going is None:
            going = self._going[container] = asyncio.create_task(in_store(self._fetch_now, container))
            going.add_done_callback(partial(self._ended, container))
        await asyncio.shield(going)

    def _fetch_now(self, container: str) -> None:
        with self._containers.local(container):
            pass

    def _ended(self, container: str, going: asyncio.Task[None]) -> None:
        del self._going[container]
        if not going.cancelled():
            going.exception()  # nobody may wait for it by then
