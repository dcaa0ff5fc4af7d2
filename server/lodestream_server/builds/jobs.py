"""Builds: a queue of surfaces, and processes that may die or be killed without harm to the server.

The queue is on disk: it consists of the records whose state is queued. What can happen to a build:

======================================  ================================================================================
the reader rejects the file             the surface is failed, for good, once that is recorded
the surface is deleted                  its process is killed
the process dies, or lacks memory       one more attempt in another process, then the surface waits
the process gets SIGTERM                another attempt, at most `_ENDINGS` in all: a service is being stopped
it takes too long                       the surface waits
a library is missing, a limit or        the surface waits
setting of this server prevents it, or
an uploaded container has a version
that this server does not read
the disk is full, or the owner exceeds  it stays in the queue until there is room
its share of the disk
the server dies                         the next server builds it, after the caller's builds with fewer attempts; when
                                        `_CRASHES` servers have died during it, the surface waits
======================================  ================================================================================

Callers (tokens, or addresses without a token) take turns: the next build is that of the caller with the fewest running
builds and the least process time recently. After a restart the caller is the owner.

A surface that waits keeps its upload and the reason until somebody retries it (`Builder.retry`). A surface that was
ready before never becomes failed: if its file is rejected now, the server must be the cause.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import signal
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeVar

from lodestream.confinement import missing
from lodestream.errors import InputError, TooLargeError

from ..access.access import key_of
from ..operation.settings import Settings
from ..problems import FullError, MissingError
from ..storage.records import Record, State
from ..storage.storage import Storage
from ..storage.uploads import check_upload
from ..store.durable import discard
from . import results, worker
from .answers import ProcessDiedError, UnforeseenError, WrongAnswerError, reason_of
from .cluster_build import ClusterJob
from .clusters import build_by_cluster
from .fork_server import Allowed
from .processes import Call, ForkServer, Pool
from .shares import Turns

__all__ = ["Builder"]

_log = logging.getLogger(__name__)
_STARTED_AGAIN = "the build of %s starts again from the beginning; continuing it failed: %s"

_DEATHS = 2
_ENDINGS = 3
_CRASHES = 3

# Of these there may be more in a moment: a build that lacks them stays in the queue.
_PASSING = (*worker.NO_ROOM, errno.EAGAIN, errno.EMFILE, errno.ENFILE, errno.ENOMEM)
_FIRST_DELAY = 2.0
_LONGEST_DELAY = 60.0

# Of the points of a surface, in the largest type.
_BYTES = 24

# So often a build is tried that lacks them, where somebody waits for its end.
_ATTEMPTS = 3

# For so many seconds it counts whose builds have had a process.
_REMEMBERED = 600.0


@dataclass
class _Running:
    folder: Path
    call: Call


_T = TypeVar("_T")

_CONFINED = "landlock+seccomp"

# For so long what was made for a build is kept while another process holds it.
_HELD_SECONDS = 600.0


class _LaterError(Exception):
    """The system has no room, or nothing else that a build needs, now.

    Attributes
    ----------
    held : bool
        Something is held by another process, as the folder of a build by one of the server before.
    """

    def __init__(self, what: str, held: bool = False) -> None:
        super().__init__(f"waits for {what}")
        self.held = held

    @classmethod
    def of(cls, number: int | None) -> _LaterError:
        """Return the error for a system error with this number."""
        return cls(
            "space on the server's disk"
            if number in worker.NO_ROOM
            else f"the server's system ({os.strerror(number or 0)})",
            held=number == errno.EAGAIN,
        )


class Builder:
    """Builds surfaces in separate processes.

    Parameters
    ----------
    storage : Storage settings : Settings
    finished : callable (state, seconds) or None
        Called when a build ends, with the state (``ready``, ``failed``, ``waiting``, ``missing``) and the duration of
        its last attempt.
    patient : bool
        Whether builds that find the disk full wait until there is space. Otherwise they are given up after a few
        attempts and stay in the queue, for the next server.

    Attributes
    ----------
    ready : bool
        Whether the process that builds come from has loaded what they need.
    fork_server : ForkServer
        The fork server of the build processes; others may use it until this is closed.
    """

    def __init__(
        self,
        storage: Storage,
        settings: Settings,
        finished: Callable[[State, float], None] | None = None,
        *,
        patient: bool = True,
    ) -> None:
        self.ready = False
        self._patient = patient
        self._storage = storage
        self._settings = settings
        self._finished = finished
        self._memory, self._threads = settings.memory_of_build, settings.threads_of_build
        self.fork_server = ForkServer(worker.preload)
        self._pool = Pool(settings.workers, self.fork_server)
        self._turns = Turns(settings.workers, _REMEMBERED)
        self._callers: dict[str, str] = {}  # of the builds that wait or run
        self._check_owner: Callable[[str | None], Awaitable[None]] | None = None
        self._pending: Counter[str] = Counter()
        self._running: dict[str, _Running] = {}
        #: Since when the folder of a surface's build is held by another process.
        self._held: dict[str, float] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._preloading: asyncio.Task[None] | None = None
        self._room = asyncio.Event()
        self._closing = False
        self._deleting = set[str]()

    @property
    def pending(self) -> int:
        """Number of builds that wait or run."""
        return len(self._tasks)

    def pending_of(self, caller: str) -> tuple[int, int]:
        """Return the number of builds that wait or run: all of them, and those of the caller with this key."""
        return len(self._tasks), self._pending.get(caller, 0)

    def start(self, check_owner: Callable[[str | None], Awaitable[None]] | None = None) -> None:
        """Start the process that builds come from, and continue builds queued when the server last ended.

        Parameters
        ----------
        check_owner : callable or None
            Raises FullError if an owner uses more disk space than allowed; that owner's builds then wait.
        """
        self._check_owner = check_owner
        self._preloading = asyncio.create_task(self._preload())
        queued = [record for record in self._storage.records() if record.state == "queued"]
        # What may have killed a server comes last: everything else is built before it does so again.
        for record in sorted(queued, key=lambda record: record.attempts):
            self.submit(record)

    async def accept(self, record: Record, upload: Path, caller: str | None = None) -> tuple[Record, bool]:
        """Store an upload and build its surface, see `Storage.add`; both happen even if the calling task is cancelled.

        Parameters
        ----------
        record : Record
        upload : Path
            Folder of the files. This function takes it over, and removes it if it is not kept.
        caller : str or None
            Key of the caller for whom the build runs; None: its owner.
        """
        return await asyncio.shield(asyncio.create_task(self._accept(record, upload, caller)))

    async def _accept(self, record: Record, upload: Path, caller: str | None) -> tuple[Record, bool]:
        try:
            record, new = await asyncio.to_thread(self._storage.add, record, upload)
        finally:
            # By nobody else, and not before: it may be on its way to its place.
            await asyncio.to_thread(discard, upload)
        if new:
            self.submit(record, caller)
        return record, new

    def submit(self, record: Record, caller: str | None = None) -> None:
        """Queue a build. It runs when a process is free and it is the turn of the caller (by default, of its owner)."""
        if record.id not in self._tasks and not self._closing:
            task = asyncio.create_task(self._build(record))
            self._tasks[record.id] = task
            self._callers[record.id] = key = caller or key_of(record.owner)
            self._pending[key] += 1
            task.add_done_callback(lambda _: self._ended(record.id))

    def _ended(self, surface: str) -> None:
        self._tasks.pop(surface, None)
        self._held.pop(surface, None)
        caller = self._callers.pop(surface)
        self._pending[caller] -= 1
        if not self._pending[caller]:
            del self._pending[caller]
        # Whoever saw the build end may have asked for another before its task was over.
        record = self._storage.find(surface)
        if self._patient and record is not None and surface not in self._deleting:
            self._resume(record, caller)

    def _resume(self, record: Record, caller: str | None = None) -> None:
        if record.state == "queued":
            self.submit(record, caller)

    async def retry(self, surface: str, caller: str | None = None) -> Record:
        """Build a surface again that failed, waits or is missing, if there is something to build it from.

        Return its record.

        Parameters
        ----------
        surface : str
        caller : str or None
            Key of the caller that asked for it; None: its owner.

        Raises
        ------
        NotFoundError
            If there is no such surface.
        OSError
            If its record cannot be written.
        """
        record = await asyncio.to_thread(self._storage.retry, surface)
        self._resume(record, caller)
        return record

    def state(self, record: Record) -> tuple[State, float]:
        """Return the current state of a surface, and the fraction of its build that is done."""
        if record.state != "queued":
            return record.state, float(record.state == "ready")
        running = self._running.get(record.id)
        if running is None or not running.call.begun.is_set():
            return "queued", 0.0
        return "building", worker.read_progress(running.folder)

    async def delete(self, surface: str) -> None:
        """Delete a surface; a running build of it is killed. Builds that wait for disk space try again.

        Raises
        ------
        NotFoundError
            If there is no such surface.
        OSError
            If it could not be deleted; it still exists, and is built as before.
        """
        self._storage.get(surface)
        self._deleting.add(surface)
        try:
            task = self._tasks.get(surface)
            if task is not None:
                task.cancel()
                with suppress(asyncio.CancelledError):
                    await task
            await asyncio.to_thread(self._storage.delete, surface)
        finally:
            self._deleting.discard(surface)
            kept = self._storage.find(surface)
            if kept is not None:  # it could not be deleted
                self._resume(kept)
        room, self._room = self._room, asyncio.Event()
        room.set()

    async def wait(self) -> None:
        """Wait until the queue is empty."""
        while self._tasks:
            await asyncio.wait(self._tasks.values())

    async def close(self) -> None:
        """Kill running builds; they start again after a restart."""
        self._closing = True
        tasks = [*self._tasks.values(), *([self._preloading] if self._preloading else [])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await asyncio.to_thread(self.fork_server.close)
        await asyncio.to_thread(self._pool.close)

    @property
    def confinement(self) -> str | None:
        """Confinement of builds, as ``/readyz`` reports it; None before it is known."""
        held = self.fork_server.confinement
        return None if held is None else "+".join(held) or "none"

    @property
    def missing(self) -> tuple[str, ...]:
        """What builds may do for lack of a mechanism of the kernel, a sentence for each; empty before it is known."""
        held = self.fork_server.confinement
        return () if held is None else missing(held)

    async def _preload(self) -> None:
        try:
            problem = await asyncio.to_thread(self.fork_server.wait)
        except ProcessDiedError as error:
            _log.warning("the process that builds are forked from: %s", error)
            return
        except OSError as error:
            _log.error("the process that builds are forked from could not be started: %s", error)
            return
        held = self.confinement
        if held == _CONFINED:
            _log.info("builds are confined by landlock and seccomp")
        else:
            _log.warning(
                "builds are not fully confined: of landlock and seccomp the kernel has %s. This is missing: %s",
                "neither" if held == "none" else f"only {held}",
                "; ".join(self.missing),
            )
        if problem is None:
            self.ready = True
        else:
            _log.error("the libraries of builds could not be loaded: %s", problem)

    async def _build(self, record: Record) -> None:
        delay, reason, attempts = _FIRST_DELAY, "", 0
        while True:
            attempts += 1
            started = time.monotonic()
            try:
                state = await self._insist(record)
            except _LaterError as error:
                if str(error) != reason:
                    reason = str(error)
                    _log.error("the build of %s %s", record.id, reason)
                    self._storage.note(record.id, reason)
                if not self._patient and attempts == _ATTEMPTS:
                    return
                with suppress(TimeoutError):
                    async with asyncio.timeout(delay):
                        await self._room.wait()
                delay = min(2 * delay, _LONGEST_DELAY)
                continue
            except Exception:
                _log.exception("the build of %s failed unexpectedly", record.id)
                state = await self._postpone(record, "the build failed with an internal error")
            if self._finished is not None:
                self._finished(state, time.monotonic() - started)
            return

    async def _insist(self, record: Record) -> State:
        """Retry a build until the surface is ready or refused."""
        if record.attempts >= _CRASHES:
            return await self._postpone(record, f"the server ended {record.attempts} times while this was being built")
        deaths = endings = 0
        while True:
            try:
                async with self._turns.turn(self._callers[record.id], record.attempts):
                    await self._check_share(record)
                    state = await self._check_upload(record) or await self._attempt(record)
                    if state is not None:
                        return state
                    continue
            except MemoryError:
                deaths, reason = deaths + 1, self._out_of_memory()
            except ProcessDiedError as error:
                if abs(error.exitcode or 0) == signal.SIGTERM:
                    endings += 1
                else:
                    deaths += 1
                reason = f"the build failed: {error}"
            _log.warning("%s: %s", record.id, reason)
            if deaths == _DEATHS or endings == _ENDINGS:
                return await self._postpone(record, f"{reason}, {deaths + endings} times")

    async def _check_upload(self, record: Record) -> State | None:
        """Return the new state of a surface whose upload is gone or differs from the acknowledged one.

        None if it is intact.
        """
        if not await asyncio.to_thread(self._storage.has_upload, record):
            await asyncio.to_thread(self._storage.lose, record.id)
            await asyncio.to_thread(self._storage.forget_work, record.id)
            return "missing"
        problem = await self._damage(record)
        return None if problem is None else await self._postpone(record, problem)

    async def _check_share(self, record: Record) -> None:
        # What was ready once had its share, and is given it back.
        if self._check_owner is not None and record.container is None:
            try:
                await self._check_owner(record.owner)
            except FullError as error:
                raise _LaterError(f"disk space of its owner: {error}") from None

    async def _attempt(self, record: Record) -> State | None:
        """Build a surface once, and return its new state; None if the build must start again from nothing."""
        folder = self._storage.work_folder(record.id)
        job = self._job(record, folder)
        begun = await asyncio.to_thread(_identities, job.files)
        allowed = await asyncio.to_thread(_allowed, job, record.upload_bytes, self._memory, self._threads)
        continued = held = ended = False

        def begin() -> None:
            # The folder is there from the moment a process begins: what is left of it tells the next server of a crash.
            nonlocal continued
            confinement = self.confinement
            if confinement is None:  # the process that others are forked from has died, and is started again
                raise BlockingIOError(errno.EAGAIN, "it is not known yet how builds are confined")
            # Who builds by Dask is not confined, and a confined process may have been taken over.
            may_continue = confinement == _CONFINED and not job.shared
            continued = self._storage.begin_work(record.id, folder, may_continue)

        call = Call(worker.build, (job,), self._settings.build_seconds, begin, allowed)
        self._running[record.id] = _Running(folder, call)
        try:
            result: worker.Built | worker.Parsed | worker.Refused | None = await self._run(self._pool.run(call))
            if isinstance(result, worker.Parsed):
                result = await self._run_by_cluster(record, job)
            if isinstance(result, worker.Built):
                self.ready = True  # as a build shows, whatever was wrong before
                result = await self._keep(record, job, result)
            if result is None:
                return "ready"
            ended = True
            await asyncio.to_thread(
                self._storage.end_work, record.id, folder
            )  # whoever sees that it has failed sees nothing of it
            # A build may read the files that were there when it began: not those of the same bytes that somebody has
            # uploaded after the last owner of the first had deleted them.
            if await asyncio.to_thread(_identities, job.files) != begun:
                return None
            if continued:
                # What it continued from may have been at fault, and is gone now.
                _log.warning(_STARTED_AGAIN, record.id, result.reason)
                return None
            return await (self._refuse if result.final else self._postpone)(record, result.reason)
        except _LaterError as error:
            held = error.held and self._is_held_shortly(record.id)
            raise
        except (MemoryError, ProcessDiedError) as error:
            if not continued or self._closing:
                raise
            _log.warning(_STARTED_AGAIN, record.id, error)
            return None
        finally:
            self._running.pop(record.id, None)
            # The process has ended, or has given its result: nobody writes here any more.
            keeps = held or (self._closing and not ended)
            await _carried_out(partial(self._storage.end_work, record.id, folder, keeps))

    def _is_held_shortly(self, surface: str) -> bool:
        """Return whether the folder of a build is locked by a process that is about to end."""
        return time.monotonic() - self._held.setdefault(surface, time.monotonic()) < _HELD_SECONDS

    async def _run(self, work: Awaitable[_T]) -> _T | worker.Refused:
        try:
            result = await work
        except TimeoutError as error:
            return self._too_slow(error)
        except UnforeseenError as error:
            if error.errno in _PASSING:
                raise _LaterError.of(error.errno) from None
            _log.error("a build failed unexpectedly: %s", error.traceback)
            return worker.Refused(f"the build failed with an internal error: {error.kind}", final=False)
        except OSError as error:
            # No folder could be made, or no process started.
            return _not_now(error)
        if isinstance(result, worker.Refused):
            return worker.Refused(reason_of(result.reason), result.final)
        return result

    async def _run_by_cluster(self, record: Record, job: worker.Job) -> worker.Built | worker.Refused:
        if not job.shared:
            raise WrongAnswerError("expected a container, got a surface that is only parsed")
        address, started = self._settings.dask, time.monotonic()
        _log.info("the build of %s goes to the workers of the Dask scheduler %s", record.id, address)
        how = "cut short"
        try:
            task = ClusterJob(job, address, self._memory // 2)
            result = await self._run(build_by_cluster(task, self._settings.build_seconds, self._threads))
            how = f"refused: {result.reason}" if isinstance(result, worker.Refused) else "built"
            return result
        finally:
            seconds = time.monotonic() - started
            _log.info("the build of %s came back from Dask after %.1f s: %s", record.id, seconds, how)

    def _too_slow(self, error: TimeoutError) -> worker.Refused:
        longer = f"more {error} than" if error.args else "longer than"
        return worker.Refused(f"the build took {longer} {self._settings.build_seconds:g} s", final=False)

    async def _keep(self, record: Record, job: worker.Job, built: worker.Built) -> worker.Refused | None:
        try:
            info = await asyncio.to_thread(results.check, job.container, built, job.files)
            await asyncio.to_thread(self._storage.ready, record.id, job.container, built.sha256, info)
        except OSError as error:
            return _not_now(error)
        except (MissingError, TooLargeError) as error:
            return worker.Refused(str(error), final=False)
        return None

    async def _refuse(self, record: Record, reason: str) -> State:
        # Only the bytes that were acknowledged can be refused for good: not what a bad disk makes of them.
        problem = await self._damage(record)
        if problem is not None:
            return await self._postpone(record, problem)
        if record.info is not None:
            return await self._postpone(record, f"it was ready before, and cannot be built again: {reason}")
        try:
            await asyncio.to_thread(self._storage.failed, record.id, reason)
        except OSError as error:
            return await self._postpone(record, f"{reason}; that could not be recorded: {_not_now(error).reason}")
        _log.info("%s failed: %s", record.id, reason)
        return "failed"

    async def _damage(self, record: Record) -> str | None:
        """Return how the upload differs from the acknowledged one; None if it does not."""
        try:
            problem = await asyncio.to_thread(check_upload, self._storage.upload_files(record), record)
        except OSError as error:
            problem = error.strerror
        return None if problem is None else f"the upload is damaged or cannot be read: {problem}"

    async def _postpone(self, record: Record, reason: str) -> State:
        _log.warning("%s waits for a retry: %s", record.id, reason)
        await asyncio.to_thread(self._storage.postpone, record.id, reason)
        await asyncio.to_thread(self._storage.forget_work, record.id)  # a retry begins with the upload
        return "waiting"

    def _out_of_memory(self) -> str:
        return f"the build needed more memory than its share, {self._memory >> 20} MiB (LODESTREAM_MEMORY)"

    def _job(self, record: Record, folder: Path) -> worker.Job:
        options = dict(record.options)
        return worker.Job(
            files=tuple(self._storage.upload_files(record)),
            filename=record.filenames[0] or None,
            name=record.name,
            closed=options.pop("closed", "auto"),
            options=options,
            max_vertices=self._settings.max_vertices,
            folder=folder,
            bands=None if self._settings.dask else self._storage.bands_folder(record.id),
            allowed=self._settings.formats,
            shared=bool(self._settings.dask),
            memory=self._memory,
        )


async def _carried_out(remove: Callable[[], None]) -> None:
    """Remove the files of a build, even if the task is cancelled: a thread that has not begun would never run."""
    removing = asyncio.ensure_future(asyncio.to_thread(remove))
    try:
        await asyncio.shield(removing)
    except asyncio.CancelledError:
        await removing
        raise


def _allowed(job: worker.Job, size: int, memory: int, threads: int) -> Allowed:
    """Return the rights and limits of the process of a build."""
    from lodestream.formats import sniff

    try:
        process = sniff(job.files[0], filename=job.filename).process
    except (InputError, OSError):  # as the build will say
        process = False
    if process:
        memory //= 2  # each of the two has so much
    return Allowed(
        read=job.files,
        write=job.folder,
        kept=job.bands,
        processes=process,
        threads=threads,
        memory=memory,
        # No container is longer than what it was made of takes in memory, and one that was uploaded is copied. Scratch
        # holds an array of the largest surface.
        file_bytes=max(memory, size, _BYTES * job.max_vertices) + (1 << 20),
    )


def _identities(files: Sequence[Path]) -> list[tuple[int, int, int]] | None:
    """Return the identities of files, which tell them from others under the same names; None where one is missing."""
    try:
        statuses = [os.stat(path) for path in files]
    except OSError:
        return None
    return [(status.st_dev, status.st_ino, status.st_ctime_ns) for status in statuses]


def _not_now(error: OSError) -> worker.Refused:
    if error.errno in _PASSING:
        raise _LaterError.of(error.errno) from error
    return worker.Refused(f"the server's disk: {error.strerror or error}", final=False)
