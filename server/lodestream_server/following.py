"""What a server of a bucket looks at: again and again what others have changed, the tokens, and at times everything.

Each look has a thread of its own: it waits for the store, and none may wait for another. What somebody asks for that
this server does not know yet is looked for at once.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from typing import NamedTuple, TypeVar

from lodestream.errors import LodestreamError
from lodestream.stores.threads import Threads

from .access.access import Access
from .operation.settings import Settings
from .problems import BusyError
from .store import layout
from .store.changes import ChangeReader
from .store.surfaces import Surfaces

__all__ = ["Following"]

_log = logging.getLogger(__name__)

# Seconds that the end of a server waits for looks that are under way.
_FAREWELL = 0.5

# A stranger may ask for anything, and each look at the bucket has its price: there are so many in a second, and so many
# seconds between two for the same thing. Whoever asks waits for it for so long.
_MOST_LOOKS = 16
_BETWEEN = 0.5
_PATIENCE = 5.0

_T = TypeVar("_T")


class _Look(NamedTuple):
    """A look for one thing that has begun, and when."""

    begun: float
    answer: Future[None]


class Following:
    """Follows what others change in a bucket.

    Parameters
    ----------
    settings : Settings
    surfaces : Surfaces
    access : Access
    """

    def __init__(self, settings: Settings, surfaces: Surfaces, access: Access) -> None:
        self._surfaces = surfaces
        self._changes = ChangeReader(surfaces.store)
        self._ending = threading.Event()
        self._looks: tuple[tuple[str, float, Callable[[], object]], ...] = (
            ("the tokens", settings.look_seconds, access.look),
            ("what others have changed", settings.look_seconds, self._follow),
            ("the bucket", settings.list_seconds, surfaces.sync),
        )
        self._threads: list[threading.Thread] = []
        self._seen = time.monotonic()
        self._one_at_a_time = threading.Lock()
        self._asked = Threads(2)  # what has changed may be much
        self._coming: dict[str, asyncio.Task[None]] = {}  # looks that have not begun
        self._lately: dict[str, _Look] = {}

    def start(self) -> None:
        """Begin, if several servers share the data."""
        if self._surfaces.lease is None:
            return
        self._threads = [
            threading.Thread(target=self._repeat, args=look, name="lodestream-following", daemon=True)
            for look in self._looks
        ]
        for thread in self._threads:
            thread.start()

    @property
    def unseen(self) -> float:
        """Seconds since what others have changed was last seen; of the writer, since it last renewed its lease.

        0 for data in a folder, which nobody else changes.
        """
        lease = self._surfaces.lease
        if lease is None:
            return 0.0
        return lease.unheard if self._surfaces.writes else time.monotonic() - self._seen

    def close(self) -> None:
        """End, and wait a little for the looks that are under way: what they would find is found by the next server."""
        self._ending.set()
        end = time.monotonic() + _FAREWELL
        for thread in self._threads:
            thread.join(max(end - time.monotonic(), 0.0))

    def _repeat(self, what: str, seconds: float, look: Callable[[], object]) -> None:
        failing = False
        while not self._ending.wait(seconds):
            try:
                look()
                failing = False
            except LodestreamError as error:
                if not failing and not self._ending.is_set():
                    _log.error("%s could not be looked at, which is tried again: %s", what, error)
                failing = True
            except Exception:  # whatever it is, nobody else would do this work
                _log.exception("%s could not be looked at", what)

    def _follow(self) -> None:
        with self._one_at_a_time:
            begun, lease = time.monotonic(), self._surfaces.lease
            if lease is not None and self._surfaces.writes:  # until it renewed its lease, nobody else has changed any
                begun -= lease.unheard
            else:
                self._changes.look(lambda what: self._surfaces.sync() if what is None else self._surfaces.refresh(what))
            self._seen = begun

    async def answer(self, asked: Awaitable[_T]) -> _T:
        """Wait for what a bucket is asked, as long as for a look.

        Raises
        ------
        BusyError
            If that takes long.
        """
        if self._surfaces.lease is None:
            return await asked
        try:
            async with asyncio.timeout(_PATIENCE):
                return await asked
        except TimeoutError:
            raise BusyError("The bucket does not answer; try again soon") from None

    async def look_for(self, what: str) -> None:
        """Look in the bucket for what somebody asks for and is not known here.

        A server that writes knows everything. Whoever asks gets a look that begins after that, so it finds whatever was
        acknowledged before. Where there are too many there is none: then this server sees it when it follows.

        Parameters
        ----------
        what : str
            The id of a surface, the key of a name; or `layout.CHANGES` for anything that the writer has told of.

        Raises
        ------
        StoreError
            If the bucket cannot be read.
        BusyError
            If that takes long.
        """
        if self._surfaces.writes or not _is_key(what):
            return
        coming = self._coming.get(what)
        if coming is None:
            old = time.monotonic() - 1.0
            self._lately = {key: it for key, it in self._lately.items() if it.begun > old or not it.answer.done()}
            if len({what, *self._coming, *self._lately}) > _MOST_LOOKS:
                if any(it.begun <= old for it in self._lately.values()):  # nobody knows then that there is nothing
                    raise BusyError("The bucket does not answer; try again soon")
                return
            coming = self._coming[what] = asyncio.create_task(self._look_for(what))
            # Its error is taken, since nobody may wait for it by then.
            coming.add_done_callback(lambda look: look.cancelled() or look.exception())
        await self.answer(asyncio.shield(coming))

    async def _look_for(self, what: str) -> None:
        last = self._lately.get(what)
        if last is not None:
            await asyncio.gather(asyncio.wrap_future(last.answer), return_exceptions=True)
            await asyncio.sleep(last.begun + _BETWEEN - time.monotonic())
        del self._coming[what]
        look = self._lately[what] = _Look(time.monotonic(), self._asked.submit(self._look, what))
        await asyncio.wrap_future(look.answer)

    def _look(self, what: str) -> None:
        if what == layout.CHANGES:
            self._follow()
        else:
            self._surfaces.refresh((what,))


def _is_key(what: str) -> bool:
    named = layout.id_of(layout.manifest_key(what)) or layout.name_of(what)
    return what == layout.CHANGES or named is not None
