"""What has changed of late in a bucket, in one small object: readers look at it instead of listing everything.

It is a hint, and never the truth: whoever missed more than it keeps lists the whole store.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from contextlib import suppress

from lodestream.errors import LodestreamError
from lodestream.stores import AbsentError, ConflictError, ExistsError, Store, StoreError, Tag

from . import layout
from .layout import CHANGES, MOST_CHANGES, Changes, DamagedObjectError

__all__ = ["ChangeLog", "ChangeReader"]

_log = logging.getLogger(__name__)

# What could not be written is tried again after so many seconds.
_AGAIN = 1.0
# So often it is tried at once when others write too.
_TRIES = 10
# Seconds that the end of a server waits for the last changes.
_FAREWELL = 0.5


class ChangeLog:
    """Writes what has changed, in a thread of its own: nobody waits for it.

    What comes while one write is under way goes together into the next one.

    Parameters
    ----------
    store : Store
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._lock = threading.Lock()
        self._pending: list[str] = []
        self._begins = False
        self._there: tuple[Changes, Tag] | None = None
        self._wake, self._ending = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None

    def begin(self) -> None:
        """Begin a new series, so that readers list everything: another server may not have told all it did."""
        with self._lock:
            self._begins = True
        self._wake.set()

    def add(self, what: str) -> None:
        """Tell that a surface has changed, by its id, or a name, by its key."""
        with self._lock:
            self._pending.append(what)
        self._wake.set()

    def start(self) -> None:
        """Write from now on."""
        self._thread = threading.Thread(target=self._run, name="lodestream-changes", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Begin to end: write what is left."""
        self._ending.set()
        self._wake.set()

    def close(self) -> None:
        """Write what is left, and end; if the store does not answer, the next server lets readers list everything."""
        self.end()
        if self._thread is not None:
            self._thread.join(_FAREWELL)

    def _run(self) -> None:
        failing = False
        while True:
            self._wake.wait()
            self._wake.clear()
            ending = self._ending.is_set()
            try:
                self.write()
                failing = False
            except Exception as error:  # whatever it is, nobody else would tell readers
                if not failing:
                    _log.error(
                        "what has changed could not be told to readers, which is tried again: %s",
                        error,
                        exc_info=not isinstance(error, LodestreamError),
                    )
                failing = True
                self._wake.set()
                self._ending.wait(_AGAIN)
            if ending:
                return

    def write(self) -> None:
        """Write what has changed since the last time.

        Raises
        ------
        StoreError
            If that fails; it is not forgotten.
        """
        with self._lock:
            pending, self._pending = list(dict.fromkeys(self._pending)), []
            begins, self._begins = self._begins, False
        if not pending and not begins:
            return
        try:
            self._write(pending, begins)
        except BaseException:
            with self._lock:
                self._pending, self._begins = pending + self._pending, begins or self._begins
            raise

    def _write(self, pending: list[str], begins: bool) -> None:
        series = layout.new_write()
        for _ in range(_TRIES):
            there = self._there or self._read()
            self._there = None
            before, tag = there or (None, None)
            number, what = (0, tuple[str, ...]()) if before is None else (before.number, before.what)
            if before is not None and not begins:
                series = before.series
            what = (*what, *pending)[-MOST_CHANGES:]
            new = Changes(series, number + len(pending), what, layout.new_write())
            data = layout.dump(new)
            with suppress(ExistsError, ConflictError):  # another server has written: its changes stay
                written = self._store.create(CHANGES, data) if tag is None else self._store.replace(CHANGES, data, tag)
                self._there = new, written
                return
        raise StoreError(f"{CHANGES} is written by others all the time")

    def _read(self) -> tuple[Changes | None, Tag] | None:
        try:
            data, tag = layout.read(self._store, CHANGES)
        except AbsentError:
            return None
        try:
            return layout.parse(Changes, CHANGES, data), tag
        except DamagedObjectError as error:
            _log.error("%s; it is made anew", error)
            return None, tag


class ChangeReader:
    """Reads what others have changed.

    Parameters
    ----------
    store : Store
    """

    def __init__(self, store: Store) -> None:
        self._store = store
        self._tag: Tag | None = None
        self._known: Changes | None = None

    def look(self, take: Callable[[tuple[str, ...] | None], object]) -> None:
        """Look whether anything has changed, and let it be taken.

        Parameters
        ----------
        take : callable
            Called with what has changed since the last look: ids of surfaces and keys of names; None: it is not known,
            and may be anything. If it raises an error, the next look tells the same and more.

        Raises
        ------
        StoreError
            If the store cannot be read.
        """
        try:
            found = layout.read_if(self._store, CHANGES, self._tag)
        except AbsentError:  # no server has written yet
            return
        if found is None:
            return
        data, tag = found
        try:
            new = layout.parse(Changes, CHANGES, data)
        except DamagedObjectError as error:
            _log.error("%s; everything is listed", error)
            take(None)
            self._tag, self._known = tag, None
            return
        take(self._since(new))
        self._tag, self._known = tag, new

    def _since(self, new: Changes) -> tuple[str, ...] | None:
        known = self._known
        if known is None or known.series != new.series or not 0 <= new.number - known.number <= len(new.what):
            return None
        return new.what[len(new.what) - (new.number - known.number) :]
