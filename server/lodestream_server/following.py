"""What a server of a bucket looks at again and again: what others have changed, the tokens, and at times everything.

Each look has a thread of its own: it waits for the store, and none may wait for another.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable

from lodestream.errors import LodestreamError

from .access.access import Access
from .operation.settings import Settings
from .store.changes import ChangeReader
from .store.surfaces import Surfaces

__all__ = ["Following"]

_log = logging.getLogger(__name__)

# Seconds that the end of a server waits for looks that are under way.
_FAREWELL = 5.0


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
        if not self._surfaces.writes:
            self._changes.look(lambda what: self._surfaces.sync() if what is None else self._surfaces.refresh(what))
