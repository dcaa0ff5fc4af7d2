"""Builds: a queue of surfaces in front of processes that may die or be killed without harm.

The queue is on disk: it is the records whose state is queued. What happens to a build, and what comes of it:

======================================  ================================================================================
the reader refuses the bytes            the surface has failed, for good
the surface is deleted                  its process is killed
the process dies, or lacks memory       one more attempt in another process, then it waits
the process is told to end (SIGTERM)    another attempt, at most `_ENDINGS` in all: a service is being stopped
it takes longer than it may             it waits
a library is missing, a limit or        it waits
setting of this server is in its way,
or an uploaded container is of another
version than this server reads
the disk is full, or its owner has      it stays in the queue until there is room
more there than one may have
the server dies                         the next one takes it up, after those of its caller that have not been tried so
                                        often; when `_CRASHES` servers have died under it, it waits
======================================  ================================================================================

Callers, who are tokens or without one addresses, take turns: the next build is that of a caller who has the fewest
running and whose builds have had processes for the least time lately. After a restart the caller is the owner.

What waits keeps its upload and its reason until somebody asks for another attempt (`Builder.retry`). What was ready
once never fails: that its bytes are refused now is the server's doing.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import signal
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lodestream.errors import InputError, TooLargeError

from . import results, worker
from .access import key_of
from .durable import discard, make_folder
from .problems import FullError, MissingError
from .processes import Allowed, Call, ForkServer, Pool, ProcessDiedError, UnforeseenError
from .records import Record, State
from .settings import Settings
from .shares import Turns
from .storage import Storage
from .uploads import check_upload

__all__ = ["Builder"]

_log = logging.getLogger(__name__)

_DEATHS = 2
_ENDINGS = 3
_CRASHES = 3

# Of these there may be more in a moment: a build that lacks them stays in the queue.
_ROOM = (errno.ENOSPC, errno.EDQUOT)
_PASSING = (*_ROOM, errno.EAGAIN, errno.EMFILE, errno.ENFILE, errno.ENOMEM)
_FIRST_DELAY = 2.0
_LONGEST_DELAY = 60.0

# So often a build is tried that lacks them, where somebody waits for its end.
_ATTEMPTS = 3

# For so many seconds it counts whose builds have had a process.
_REMEMBERED = 600.0


@dataclass
class _Running:
    folder: Path
    call: Call


class _LaterError(Exception):
    """The system has no room, or nothing else that a build needs, now."""

    def __init__(self, what: str) -> None:
        super().__init__(f"waits for {what}")

    @classmethod
    def of(cls, number: int | None) -> _LaterError:
        """What stands behind an error of the system."""
        return cls(
            "room on the server's disk" if number in _ROOM else f"the server's system ({os.strerror(number or 0)})"
        )


class Builder:
    """Builds surfaces in other processes.

    Parameters
    ----------
    storage : Storage
    settings : Settings
    finished : callable (state, seconds) or None
        Told how each build ended (``ready``, ``failed``, ``waiting``, ``missing``), and how long its last attempt took.
    patient : bool
        Whether builds that find no room on the disk wait until there is some. Otherwise they are given up after a few
        attempts and stay in the queue, for the next server to build.

    Attributes
    ----------
    ready : bool
        The kernels are compiled.
    fork_server : ForkServer
        From which the processes are forked; others may use it until this is closed.
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
        self._memory = settings.memory_of_build
        self.fork_server = ForkServer(worker.preload)
        self._pool = Pool(settings.workers, self.fork_server)
        self._turns = Turns(settings.workers, _REMEMBERED)
        self._callers: dict[str, str] = {}  # of the builds that wait or run
        self._check_owner: Callable[[str | None], Awaitable[None]] | None = None
        self._pending: Counter[str] = Counter()
        self._running: dict[str, _Running] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._preloading: asyncio.Task[None] | None = None
        self._room = asyncio.Event()
        self._closing = False
        self._deleting = set[str]()

    @property
    def pending(self) -> int:
        """Builds that wait or run."""
        return len(self._tasks)

    def pending_of(self, caller: str) -> tuple[int, int]:
        """Builds that wait or run, and how many of them are of the caller with this key."""
        return len(self._tasks), self._pending.get(caller, 0)

    def start(self, check_owner: Callable[[str | None], Awaitable[None]] | None = None) -> None:
        """Start the process that builds come from, and take up what was queued when the server went down.

        Parameters
        ----------
        check_owner : callable or None
            Raises FullError when this owner has more on the disk than one may have: builds of theirs wait meanwhile.
        """
        self._check_owner = check_owner
        self._preloading = asyncio.create_task(self._preload())
        queued = [record for record in self._storage.records() if record.state == "queued"]
        # What may have killed a server comes last: everything else is built before it does so again.
        for record in sorted(queued, key=lambda record: record.attempts):
            self.submit(record)

    async def accept(self, record: Record, upload: Path, caller: str | None = None) -> tuple[Record, bool]:
        """Store an upload and build its surface, as `Storage.add` says; both happen even if the caller is cancelled.

        Parameters
        ----------
        record : Record
        upload : Path
            This function's from now on: it is removed where it is not kept.
        caller : str or None
            Key of whoever the build is for; None for its owner.
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
        """Build a surface when a process is free and it is the turn of the caller, by default of its owner."""
        if record.id not in self._tasks and not self._closing:
            task = asyncio.create_task(self._build(record))
            self._tasks[record.id] = task
            self._callers[record.id] = key = caller or key_of(record.owner)
            self._pending[key] += 1
            task.add_done_callback(lambda _: self._ended(record.id))

    def _ended(self, surface: str) -> None:
        self._tasks.pop(surface, None)
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
        """Build a surface again that failed, waits or is missing, if there is something to build it from; its record.

        Parameters
        ----------
        surface : str
        caller : str or None
            Key of whoever asks for it; None for its owner.

        Raises
        ------
        NotFoundError
            When there is none.
        OSError
            When the disk does not let it be taken up.
        """
        record = await asyncio.to_thread(self._storage.retry, surface)
        self._resume(record, caller)
        return record

    def state(self, record: Record) -> tuple[State, float]:
        """What a surface is doing now, and how much of its build is done."""
        if record.state != "queued":
            return record.state, float(record.state == "ready")
        running = self._running.get(record.id)
        if running is None or not running.call.begun.is_set():
            return "queued", 0.0
        return "building", worker.read_progress(running.folder)

    async def delete(self, surface: str) -> None:
        """Remove a surface; the process that builds it is killed. Builds that wait for room on the disk try again.

        Raises
        ------
        NotFoundError
            When there is none.
        OSError
            When it could not be removed; it is still there, and built as before.
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
        """Wait until nothing is queued any more."""
        while self._tasks:
            await asyncio.wait(self._tasks.values())

    async def close(self) -> None:
        """Kill what is running; it is taken up again after a restart."""
        self._closing = True
        tasks = [*self._tasks.values(), *([self._preloading] if self._preloading else [])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await asyncio.to_thread(self.fork_server.close)
        await asyncio.to_thread(self._pool.close)

    @property
    def confinement(self) -> str | None:
        """What the kernel holds builds to, as ``/readyz`` says it; None before it is known."""
        held = self.fork_server.confinement
        return None if held is None else "+".join(held) or "none"

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
        if held == "landlock+seccomp":
            _log.info("builds are confined by landlock and seccomp")
        else:
            _log.warning(
                "builds are not confined as they should be: the kernel has %s, of landlock and seccomp; whatever takes "
                "a reader over can do what this server can",
                "neither" if held == "none" else f"only {held}",
            )
        if problem is None:
            self.ready = True
        else:
            _log.error("what builds need could not be loaded: %s", problem)

    async def _build(self, record: Record) -> None:
        delay, said, attempts = _FIRST_DELAY, "", 0
        while True:
            attempts += 1
            started = time.monotonic()
            try:
                state = await self._insist(record)
            except _LaterError as error:
                if str(error) != said:
                    said = str(error)
                    _log.error("the build of %s %s", record.id, said)
                    self._storage.note(record.id, said)
                if not self._patient and attempts == _ATTEMPTS:
                    return
                with suppress(TimeoutError):
                    async with asyncio.timeout(delay):
                        await self._room.wait()
                delay = min(2 * delay, _LONGEST_DELAY)
                continue
            except Exception:
                _log.exception("the build of %s failed for a reason that nobody foresaw", record.id)
                state = await self._postpone(record, "the build failed inside")
            if self._finished is not None:
                self._finished(state, time.monotonic() - started)
            return

    async def _insist(self, record: Record) -> State:
        """Try until it is ready or refused."""
        if record.attempts >= _CRASHES:
            return await self._postpone(record, f"the server ended {record.attempts} times while this was being built")
        deaths = endings = 0
        while True:
            try:
                async with self._turns.turn(self._callers[record.id], record.attempts):
                    await self._check_share(record)
                    return await self._check_upload(record) or await self._attempt(record)
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
        """What becomes of a surface whose upload is not there, or not what was acknowledged; None where it is."""
        if not await asyncio.to_thread(self._storage.has_upload, record):
            await asyncio.to_thread(self._storage.lose, record.id)
            return "missing"
        problem = await self._damage(record)
        return None if problem is None else await self._postpone(record, problem)

    async def _check_share(self, record: Record) -> None:
        # What was ready once had its share, and is given it back.
        if self._check_owner is not None and record.container is None:
            try:
                await self._check_owner(record.owner)
            except FullError as error:
                raise _LaterError(f"the room of its owner: {error}") from None

    async def _attempt(self, record: Record) -> State:
        folder = self._storage.work_folder(record.id)
        job = self._job(record, folder)
        allowed = await asyncio.to_thread(_allowed, job, record.upload_bytes, self._memory)
        # The folder is there from the moment a process begins: what is left of it tells the next server of a crash.
        call = Call(worker.build, (job,), self._settings.build_seconds, partial(make_folder, folder), allowed)
        self._running[record.id] = _Running(folder, call)
        try:
            result: worker.Built | worker.Refused | None = await self._run(call)
            if isinstance(result, worker.Built):
                self.ready = True  # as a build shows, whatever was wrong before
                result = await self._keep(record, job, result)
            if result is None:
                return "ready"
            await asyncio.to_thread(discard, folder)  # whoever sees that it has failed sees nothing of it
            return await (self._refuse if result.final else self._postpone)(record, result.reason)
        finally:
            self._running.pop(record.id, None)
            # The process has ended, or has given its result: nobody writes here any more.
            await _removed(folder)

    async def _run(self, call: Call) -> worker.Built | worker.Refused:
        try:
            result: worker.Built | worker.Refused = await self._pool.run(call)
        except TimeoutError as error:
            longer = f"more {error} than" if error.args else "longer than"
            return worker.Refused(f"the build took {longer} {self._settings.build_seconds:g} s", final=False)
        except UnforeseenError as error:
            if error.errno in _PASSING:
                raise _LaterError.of(error.errno) from None
            _log.error("a build failed for a reason that nobody foresaw: %s", error.traceback)
            return worker.Refused(f"the build failed inside: {error.kind}", final=False)
        except OSError as error:
            # No folder could be made, or no process started.
            return _not_now(error)
        if isinstance(result, worker.Refused):
            return worker.Refused(results.reason_of(result.reason), result.final)
        return result

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
            return await self._postpone(record, f"it was ready, and cannot be built again: {reason}")
        _log.info("%s failed: %s", record.id, reason)
        await asyncio.to_thread(self._storage.failed, record.id, reason)
        return "failed"

    async def _damage(self, record: Record) -> str | None:
        """Why the upload is not what was acknowledged; None where it is."""
        try:
            problem = await asyncio.to_thread(check_upload, self._storage.upload_files(record), record)
        except OSError as error:
            problem = error.strerror
        return None if problem is None else f"the upload cannot be read as it came: {problem}"

    async def _postpone(self, record: Record, reason: str) -> State:
        _log.warning("%s waits for somebody to try again: %s", record.id, reason)
        await asyncio.to_thread(self._storage.postpone, record.id, reason)
        return "waiting"

    def _out_of_memory(self) -> str:
        return f"the build needed more memory than one may have, {self._memory >> 20} MiB (LODESTREAM_MEMORY)"

    def _job(self, record: Record, folder: Path) -> worker.Job:
        options = dict(record.options)
        return worker.Job(
            files=tuple(self._storage.upload_files(record)),
            filename=record.filenames[0] or None,
            name=record.name,
            precision=options.pop("precision", None),
            rms=options.pop("rms", None),
            closed=options.pop("closed", "auto"),
            options=options,
            max_vertices=self._settings.max_vertices,
            folder=folder,
            allowed=self._settings.formats,
        )


async def _removed(folder: Path) -> None:
    """Remove what a build has left, also where it is cancelled meanwhile: a thread that has not begun never would."""
    removing = asyncio.ensure_future(asyncio.to_thread(discard, folder))
    try:
        await asyncio.shield(removing)
    except asyncio.CancelledError:
        await removing
        raise


def _allowed(job: worker.Job, size: int, memory: int) -> Allowed:
    """What the process of a build may touch and take."""
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
        processes=process,
        memory=memory,
        # No container is longer than what it was made of takes in memory, and one that was uploaded is copied.
        file_bytes=max(memory, size) + (1 << 20),
    )


def _not_now(error: OSError) -> worker.Refused:
    if error.errno in _PASSING:
        raise _LaterError.of(error.errno) from error
    return worker.Refused(f"the server's disk: {error.strerror or error}", final=False)
