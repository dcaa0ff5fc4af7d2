"""Fetching containers of a bucket before what is made of them has its turn: so nobody else waits for the bucket."""

from __future__ import annotations

import logging
from contextlib import ExitStack, suppress
from functools import partial

from ..access.access import Caller
from ..operation.threads import entered
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

    async def _fetch(self, container: str, _: ExitStack) -> None:
        with ExitStack() as stack:
            await entered(self._containers.local(container), stack)
