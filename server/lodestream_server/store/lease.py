"""The lease of a bucket: which of its servers writes. A folder has a lock instead, see `claim`.

Whoever has the lease writes the object ``writer.json`` anew every few seconds. Whoever wants it watches that object,
and takes it over when its tag has been the same for as long as the lease lasts, by the watcher's own clock: the clocks
of two machines are never compared. One that is gone is waited for as long, since its holder may not have noticed. A
holder trusts the lease for a fifth less than it lasts, from before its last write was begun: so it stops before anybody
takes over, even if it was stopped for a while. Every write is made in place of the one that was read, so of several
that take over at once one does.

Should all of this fail, nothing is overwritten: each change of the data is made under a condition too.
"""

from __future__ import annotations

import logging
import math
import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress

from lodestream.errors import LodestreamError
from lodestream.stores import AbsentError, ConflictError, ExistsError, Store, StoreError, Tag

from . import layout
from .layout import WRITER, DamagedObjectError, Writer

__all__ = ["LEASE_SECONDS", "Lease", "uptime"]

_log = logging.getLogger(__name__)

#: How long a lease lasts.
LEASE_SECONDS = 15.0

# Nobody waits longer for another server, whatever its object says.
_LONGEST = 600.0
# Of what it lasts: when it is renewed, how often it is watched, for how long its holder trusts it.
_RENEWED, _WATCHED, _TRUSTED = 1 / 3, 1 / 15, 4 / 5

_LONGEST_NAME = 100
# Characters of the name of another server that are told: `/readyz` and each refusal have it.
_LONGEST_HOLDER = 200

# Seconds that the end of a server waits until it is given up: longer, and whoever ends the server would kill it.
_FAREWELL = 4.0


def uptime() -> float:
    """Return seconds that go on while the machine sleeps: then others take over."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class Lease:
    """The lease of a bucket, as one server has it, waits for it, or leaves it to others.

    Parameters
    ----------
    store : Store
    seconds : float
        How long it lasts.
    wanted : bool
        Whether this server is to write when nobody else does.
    clock : callable
        Returns seconds.

    Attributes
    ----------
    wanted : bool
    number : int
        How often it has been taken, when this server took it last: another number, and others may have written.
    turned : callable
        Called, in a thread of the lease, when it was taken, is lost, or is held again.
    """

    def __init__(
        self,
        store: Store,
        seconds: float = LEASE_SECONDS,
        *,
        wanted: bool = True,
        clock: Callable[[], float] = uptime,
    ) -> None:
        self.wanted = wanted
        self.number = 0
        self.turned: Callable[[], object] = lambda: None
        self._store = store
        self._seconds = seconds
        self._clock = clock
        self._own = layout.new_write()
        self._name = f"{socket.gethostname()[:_LONGEST_NAME]} (process {os.getpid()})"
        self._ours = False  # whether the object that was read or written last is of this server
        self._until = -math.inf  # by the clock; so long it is trusted
        self._tag: Tag | None = None
        self._heard = clock()  # since when it is not known whether the store answers
        self._there: Writer | None = None
        self._silent: str | None = None  # whoever had it before and stopped renewing it, if it was taken from somebody
        self._since: float | None = None  # since when the object is known to be the same, or gone; None: never seen
        self._lasts = seconds  # how long whoever had it last may trust it, and a little longer
        self._one_at_a_time = threading.Lock()
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._watch: threading.Thread | None = None
        self._telling = threading.Lock()
        self._told: tuple[bool, int, str | None, bool] = False, 0, None, False
        self._failing = False

    @property
    def held(self) -> bool:
        """Whether this server has it, and nobody else can have taken it over."""
        return self.left > 0

    @property
    def left(self) -> float:
        """Seconds for which it is still held if nobody renews it; 0 if it is not."""
        return max(0.0, self._until - self._clock())

    @property
    def holder(self) -> str | None:
        """Name of the machine and process that has it; None: nobody is known to.

        Whoever has not renewed it for as long as it is trusted has it no more, whatever the object says.
        """
        there, since = self._there, self._since
        if there is None or there.holder is None:
            return None
        if there.holder == self._own:
            known = self.held
        else:
            known = since is not None and self._clock() < since + _TRUSTED * self._lasts
        return there.name[:_LONGEST_HOLDER] if known else None

    @property
    def unheard(self) -> float:
        """Seconds since the last request for it was begun that the store answered, or since this object was made."""
        return max(0.0, self._clock() - self._heard)

    @property
    def standing(self) -> str:
        """Who writes, and what whoever wants to write had better do: what follows a colon."""
        if self.held:
            return "this one is about to; try again soon"
        holder = self.holder
        if holder is not None:
            return f"{holder} does; send it to that server"
        if self._is_deaf:
            return f"it has not answered for {self.unheard:.0f} s, and nobody is known to write; try again later"
        return "nobody is known to; try again soon"

    @property
    def _is_deaf(self) -> bool:
        return self._clock() >= self._heard + _TRUSTED * self._seconds

    def tend(self) -> None:
        """Renew it, or look who has it and take it if nobody does.

        Raises
        ------
        StoreError
            If the store does not answer. A lease that is not renewed ends.
        """
        with self._one_at_a_time:
            begun = self._clock()
            if self._ours:
                self._renew(begun)
            elif self._look(begun) and self.wanted:
                before = self._there
                number = max(before.number if before else 0, self.number) + 1
                with suppress(ExistsError, ConflictError):  # somebody else was first, as the next look tells
                    self._write(begun, number)
                    self._silent = None if before is None or before.holder is None else before.name[:_LONGEST_HOLDER]
            elif self._there is not None and self._there.holder == self._own:
                self._write(begun, self._there.number)  # it was taken, and no answer came
            self._heard = begun

    def _renew(self, begun: float) -> None:
        try:
            self._write(begun, self.number)
            return
        except ConflictError:
            self._ours, self._tag, self._since = False, None, self._clock()
        free = self._look(begun)
        if self._there is not None and self._there.holder == self._own:
            self._ours = True  # a renewal of which no answer came
            self._write(begun, self.number)
        elif not free:
            self._until = -math.inf

    def _look(self, begun: float) -> bool:
        """Look what is there; return whether it may be taken."""
        try:
            found = layout.read_if(self._store, WRITER, self._tag)
        except AbsentError:
            if self._tag is not None:  # somebody has deleted it, whom its holder need not have noticed
                self._since = self._clock()
            self._tag, self._there, self._until = None, None, -math.inf
            return self._since is None or begun - self._since >= self._lasts
        if found is None:
            return self._since is None or begun - self._since >= self._lasts
        data, self._tag = found
        self._since = self._clock()
        try:
            self._there = layout.parse(Writer, WRITER, data)
        except DamagedObjectError as error:
            _log.error("%s; it is replaced unless somebody renews it", error)
            self._there = None
            return False
        self._lasts = max(self._seconds, min(self._there.seconds, _LONGEST))
        return self._there.holder is None

    def _write(self, begun: float, number: int, *, released: bool = False) -> None:
        there = Writer(None if released else self._own, self._name, number, self._seconds, layout.new_write())
        data = layout.dump(there)
        if self._tag is None:
            self._tag = self._store.create(WRITER, data)
        else:
            self._tag = self._store.replace(WRITER, data, self._tag)
        self._there, self._ours, self.number = there, not released, number
        self._until = -math.inf if released else begun + _TRUSTED * self._seconds

    def start(self) -> None:
        """Tend it from now on, in a thread of its own: it must not wait for what requests do.

        Another one tells when it ends, for which nobody must wait until the store answers.
        """
        if self.wanted:
            self._thread = threading.Thread(target=self._run, name="lodestream-lease", daemon=True)
            self._watch = threading.Thread(target=self._keep_telling, name="lodestream-lease-watch", daemon=True)
            self._thread.start()
            self._watch.start()

    def close(self) -> None:
        """Give it up, so that others need not wait."""
        self._ending.set()
        if self._thread is not None:
            self._thread.join(_FAREWELL)  # if the store does not answer, others take over when the lease is over
        else:
            self._give_up()
        self._until = -math.inf

    def _give_up(self) -> None:
        if self._ours:
            with suppress(LodestreamError), self._one_at_a_time:
                self._write(self._clock(), self.number, released=True)

    def _run(self) -> None:
        pause = 0.0
        while not self._ending.wait(pause):
            try:
                self.tend()
                self._failing = False
            except Exception as error:  # whatever it is, without this thread the server would never write again
                if not self._failing:
                    _log.error(
                        "the lease of the bucket could not be looked at: %s",
                        error,
                        exc_info=not isinstance(error, StoreError),
                    )
                self._failing = True
            self._tell()
            pause = self._seconds * (_RENEWED if self._ours and not self._failing else _WATCHED)
        self._give_up()

    def _keep_telling(self) -> None:
        pause = self._seconds * _WATCHED
        while not self._ending.wait(min(self.left or pause, pause)):
            self._tell()

    def _tell(self) -> None:
        with self._telling:
            held = self.held
            now = held, self.number if held else 0, self.holder, not held and self._is_deaf
            before, self._told = self._told, now
            if now == before or self._ending.is_set():
                return
            self._log(before)
        self.turned()

    def _log(self, before: tuple[bool, int, str | None, bool]) -> None:
        held, number, holder, deaf = self._told
        if held:
            silent, self._silent = self._silent, None
            if silent is None:
                _log.info("this server has the lease of the bucket (number %d) from now on, and writes", number)
            else:
                _log.warning(
                    "%s has stopped renewing the lease of the bucket; this server has it (number %d) from now on, "
                    "and writes",
                    silent,
                    number,
                )
        elif before[0] and holder is not None:
            _log.error("this server has lost the lease of the bucket, and writes nothing; %s has it", holder)
        elif before[0]:
            _log.error(
                "this server has lost the lease of the bucket, which has not answered for %.0f s; it writes nothing, "
                "and nobody is known to",
                self.unheard,
            )
        elif holder is not None:
            _log.info("%s has the lease of the bucket; this server waits for it, and answers reads", holder)
        elif deaf:
            _log.warning("the bucket has not answered for %.0f s, and nobody is known to write", self.unheard)
