"""Builds: a queue of surfaces, and processes that may die or be killed without harm to the server.

The queue consists of the surfaces whose state is queued (`store.states`). What can happen to a build:

======================================  ================================================================================
the reader rejects the file             the surface is failed, for good, once that is stored
the surface is deleted                  its process is killed
the process dies, lacks memory, or      that counts as an attempt; after `_ATTEMPTS` of them the surface waits
gets SIGTERM; the server dies
it takes too long                       the surface waits
a library is missing, a limit or        the surface waits
setting of this server prevents it, or
an uploaded container has a version
that this server does not read
its upload is gone, or damaged          the surface waits, unless its container is there again
the disk is full, or the owner exceeds  it stays in the queue until there is room
its share of the disk
the server ends                         the next server builds it
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
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

from lodestream import stores
from lodestream.confinement import missing
from lodestream.errors import InputError, TooLargeError
from lodestream.stores import AbsentError, StoreError

from ..access.access import key_of
from ..access.limits import Limits
from ..operation.settings import Settings
from ..operation.threads import carried_out, entered, in_store
from ..problems import PASSING, FullError
from ..store.durable import discard
from ..store.index import IndexLostError, Surface
from ..store.layout import Manifest
from ..store.states import State
from ..store.surfaces import Surfaces
from ..store.uploads import check_upload
from . import results, thumbnails, worker
from .answers import ProcessDiedError, UnforeseenError, WrongAnswerError, reason_of
from .choices import told
from .cluster_build import ClusterJob
from .clusters import build_by_cluster
from .fork_server import Allowed
from .processes import Call, ForkServer, Pool
from .runner import Runner
from .work import Work

__all__ = ["Builder"]

_log = logging.getLogger(__name__)
_STARTED_AGAIN = "the build of %s starts again from the beginning; continuing it failed: %s"

# So often a build may begin and come to no end: its process dies, or the server does.
_ATTEMPTS = 3

# Builds that are taken up at once from a queue that may be long: each is a task.
_TAKEN_UP = 1000

# Of these there may be more in a moment: a build that lacks them stays in the queue.
_PASSING = (*worker.NO_ROOM, *PASSING)
_ROOM = "space on the server's disk"
_SCRATCH = "the server's scratch folder, which was removed meanwhile"
_UPLOAD = "its upload, which was removed meanwhile"
_FIRST_DELAY = 2.0
_LONGEST_DELAY = 60.0

# How often a server that does not build looks whether a build has ended.
_LOOK_SECONDS = 1.0

# Of the points of a surface, in the largest type.
_BYTES = 24

# For so many seconds it counts whose builds have had a process.
_REMEMBERED = 600.0


@dataclass
class _Running:
    folder: Path
    call: Call


_T = TypeVar("_T")

#: What became of an attempt.
_Outcome = State | Literal["again"]

_CONFINED = "landlock+seccomp"

# For so long what was made for a build is kept while another process holds it.
_HELD_SECONDS = 600.0


class _LaterError(Exception):
    """A build lacks something now, such as room on a disk.

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
            _ROOM if number in worker.NO_ROOM else f"the server's system ({os.strerror(number or 0)})",
            held=number == errno.EAGAIN,
        )


class _OverError(Exception):
    """A surface was deleted, or it is known by now what became of it."""


class Builder:
    """Builds surfaces in separate processes.

    Parameters
    ----------
    surfaces : Surfaces
    work : Work
    settings : Settings
    limits : Limits
        An owner who uses more disk space than allowed has builds that wait.
    finished : callable (state, seconds)
        Called when a build ends, with the state (``ready``, ``failed``, ``waiting``) and the duration of its last
        attempt.

    Attributes
    ----------
    ready : bool
        Whether the process that builds come from has loaded what they need.
    fork_server : ForkServer
        The fork server of the build processes; others may use it until this is closed.
    """

    def __init__(
        self,
        surfaces: Surfaces,
        work: Work,
        settings: Settings,
        limits: Limits,
        finished: Callable[[State, float], None],
    ) -> None:
        self.ready = False
        self._surfaces = surfaces
        self._work = work
        self._settings = settings
        self._limits = limits
        self._finished = finished
        self._memory, self._threads = settings.memory_of_build, settings.threads_of_build
        self.fork_server = ForkServer(worker.preload)
        pool = Pool(settings.workers, self.fork_server)
        self._runner = Runner[str, Call]("build", settings.workers, _REMEMBERED, pool)
        self._callers: dict[str, str] = {}  # of the builds that wait or run
        self._running: dict[str, _Running] = {}
        #: Since when the folder of a surface's build is held by another process.
        self._held: dict[str, float] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._preloading: asyncio.Task[None] | None = None
        self._has_more = False  # whether surfaces are queued that were not taken up
        self._resuming: asyncio.Task[None] | None = None
        self._room = asyncio.Event()
        self._closing = False
        self._deleting = set[str]()
        self._awaited: dict[str, set[asyncio.Future[None]]] = {}  # by those who wait for the end of a build
        self._leaving = False

    @property
    def pending(self) -> int:
        """Number of builds that wait or run."""
        return len(self._tasks)

    async def start(self) -> None:
        """Start the process that builds come from, and continue builds queued when the server last ended."""
        self._preloading = asyncio.create_task(self._preload())
        try:
            await asyncio.to_thread(lambda: self._work.clean(set(self._surfaces.index.queued())))
            await self.resume()
        except (StoreError, IndexLostError) as error:  # they are found once it is there again
            _log.error("%s", error)

    async def resume(self) -> None:
        """Take up builds of surfaces that are queued: more may have been found in the store.

        Of a long queue some are taken up now, and others when these end. A server that does not write takes up none.
        """
        if not self._surfaces.writes:
            return
        queued = await asyncio.to_thread(self._surfaces.index.queued, _TAKEN_UP)
        self._has_more = len(queued) == _TAKEN_UP
        for surface in queued:
            if len(self._tasks) < _TAKEN_UP:
                self._submit(surface, None)

    async def accept(
        self, manifest: Manifest, files: Sequence[Path], folder: Path, caller: str | None = None
    ) -> Surface:
        """Store an upload and build its surface, see `Surfaces.accept`; both happen even if the task is cancelled.

        Parameters
        ----------
        manifest : Manifest
        files : sequence of Path
        folder : Path
            Folder of the files. This function takes it over, and removes what is not kept.
        caller : str or None
            Key of the caller for whom the build runs; None: its owner.
        """
        return await asyncio.shield(asyncio.create_task(self._accept(manifest, files, folder, caller)))

    async def _accept(self, manifest: Manifest, files: Sequence[Path], folder: Path, caller: str | None) -> Surface:
        try:
            surface, new = await in_store(self._surfaces.accept, manifest, files)
        finally:
            # By nobody else, and not before: it may be on its way to its place.
            await asyncio.to_thread(discard, folder)
        if new:
            self.submit(surface, caller)
        return surface

    def submit(self, surface: Surface, caller: str | None = None) -> None:
        """Queue a build. It runs when a process is free and it is the turn of the caller (by default, of its owner)."""
        self._submit(surface.id, caller or key_of(surface.manifest.owner))

    def _submit(self, surface: str, caller: str | None) -> None:
        if surface not in self._tasks and not self._closing and self._surfaces.writes:
            task = asyncio.create_task(self._build(surface))
            self._tasks[surface] = task
            if caller is not None:
                self._count(surface, caller)
            task.add_done_callback(lambda _: self._ended(surface))

    def _count(self, surface: str, caller: str) -> None:
        self._callers[surface] = caller
        self._limits.builds.add(caller)

    async def settled(self, surface: str, seconds: float) -> None:
        """Wait until a build of a surface ends, the surface is deleted, the server ends, or the seconds are over."""
        heard = asyncio.get_running_loop().create_future()
        waiting = self._awaited.setdefault(surface, set())
        waiting.add(heard)
        try:
            end = time.monotonic() + seconds
            while not heard.done() and not self._leaving and (left := end - time.monotonic()) > 0:
                known = self._find(surface)  # it may have ended before somebody listened
                if known is None or known.state not in ("queued", "building"):
                    break
                # Of a build of another server nothing is heard.
                await asyncio.wait((heard,), timeout=left if self._surfaces.writes else min(left, _LOOK_SECONDS))
        finally:
            waiting.discard(heard)
            if not waiting and self._awaited.get(surface) is waiting:
                del self._awaited[surface]

    def leave(self) -> None:
        """Let nobody wait any more for the end of a build: the server ends."""
        self._leaving = True
        for surface in list(self._awaited):
            self._tell(surface)

    def _tell(self, surface: str) -> None:
        for heard in self._awaited.pop(surface, ()):
            heard.set_result(None)

    def _ended(self, surface: str) -> None:
        if surface not in self._deleting:
            self._tell(surface)
        self._tasks.pop(surface, None)
        self._held.pop(surface, None)
        caller = self._callers.pop(surface, None)
        if caller is not None:
            self._limits.builds.add(caller, -1)
        if self._has_more and len(self._tasks) < _TAKEN_UP // 2 and not self._closing:
            self._has_more = False
            self._resuming = asyncio.create_task(self._resume_later())
        # Whoever saw the build end may have asked for another before its task was over.
        if surface not in self._deleting and (known := self._find(surface)) is not None:
            self._resume(known, caller)

    async def _resume_later(self) -> None:
        with suppress(StoreError, IndexLostError):  # it is done again after a while anyway
            await self.resume()

    def _find(self, surface: str) -> Surface | None:
        try:
            return self._surfaces.index.find(surface)
        except (IndexLostError, StoreError):  # all are found again once the index is
            return None

    def _resume(self, surface: Surface, caller: str | None = None) -> None:
        if surface.state in ("queued", "building"):  # that the last attempt has ended may not have been noted
            self.submit(surface, caller)

    async def retry(self, surface: str, caller: str | None = None) -> Surface:
        """Build a surface again that failed or waits; return it.

        Parameters
        ----------
        surface : str
        caller : str or None
            Key of the caller that asked for it; None: its owner.

        Raises
        ------
        NotFoundError
            If there is no such surface.
        StoreError
            If that cannot be stored.
        """
        again = await in_store(self._surfaces.retry, surface)
        self._resume(again, caller)
        return again

    def progress(self, surface: Surface) -> float:
        """Return the fraction of a surface's build that is done."""
        running = self._running.get(surface.id)
        if surface.state != "building" or running is None:
            return float(surface.state == "ready")
        return worker.read_progress(running.folder)

    async def delete(self, surface: str) -> None:
        """Delete a surface; a running build of it is killed. Builds that wait for disk space try again.

        Raises
        ------
        NotFoundError
            If there is no such surface.
        StoreError
            If it could not be deleted; it still exists, and is built as before.
        """
        self._surfaces.get(surface)
        self._deleting.add(surface)
        try:
            task = self._tasks.get(surface)
            if task is not None:
                if not task.cancelling():  # a second time it would not wait for the end of its process
                    task.cancel()
                await asyncio.wait((task,))  # which does not cancel it either, if whoever deletes is cut short
            await in_store(self._surfaces.delete, surface)
            await asyncio.to_thread(self._work.forget, surface)
        finally:
            self._deleting.discard(surface)
            self._tell(surface)
            kept = self._find(surface)
            if kept is not None:  # it could not be deleted
                self._resume(kept)
        self.room_was_made()

    def room_was_made(self) -> None:
        """Try again what waits for disk space."""
        room, self._room = self._room, asyncio.Event()
        room.set()

    async def halt(self) -> None:
        """Cut all builds short: another server writes now. Until this one does again, none begins."""
        tasks = list(self._tasks.values())
        for task in tasks:
            if not task.cancelling():  # a second time it would not wait for the end of its process
                task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

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
        await self._runner.close()
        await asyncio.to_thread(self.fork_server.close)

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

    async def _build(self, surface: str) -> None:
        delay, reason = _FIRST_DELAY, None
        while True:
            started = time.monotonic()
            try:
                state = await self._insist_or_postpone(surface)
            except (_LaterError, StoreError, IndexLostError) as error:
                if _lacking(error) != reason:
                    reason = _lacking(error)
                    _log.error("the build of %s %s", surface, reason if reason == str(error) else f"{reason}: {error}")
                await self._try(partial(self._surfaces.later, surface, reason))
                with suppress(TimeoutError):
                    async with asyncio.timeout(delay):
                        await self._room.wait()
                delay = min(2 * delay, _LONGEST_DELAY)
                continue
            if state is not None:
                seconds = time.monotonic() - started
                self._finished(state, seconds)
            return

    async def _insist_or_postpone(self, surface: str) -> State | None:
        try:
            return await self._insist(surface)
        except (_LaterError, StoreError, IndexLostError):
            raise
        except Exception:
            _log.exception("the build of %s failed unexpectedly", surface)
            return await self._postpone(surface, "the build failed with an internal error")

    async def _insist(self, surface: str) -> State | None:
        """Build a surface until it is ready or refused, or waits; return its state, None if it was deleted."""
        reason = "the server ended"
        while True:
            # Not in a thread: builds wait for their turns in the order in which they were queued.
            known = self._surfaces.index.find(surface)
            if known is not None and known.state == "building":  # that the last attempt had ended could not be noted
                known = await in_store(self._surfaces.later, surface)
            if known is None or known.state != "queued":
                return None
            if known.attempts >= _ATTEMPTS:
                return await self._postpone(surface, f"{reason}: {known.attempts} builds began and did not end")
            if surface not in self._callers:
                self._count(surface, key_of(known.manifest.owner))
            try:
                work = partial(self._in_turn, known)
                async with self._runner.job(surface, self._callers[surface], work, known.attempts) as state:
                    if state != "again":
                        return state
            except _OverError:
                return None
            except AbsentError:
                return await self._do_without(surface, "its upload is not in the server's store")
            except (MemoryError, ProcessDiedError) as error:
                reason = self._out_of_memory() if isinstance(error, MemoryError) else f"the build failed: {error}"
                _log.warning("%s: %s", surface, reason)
                await self._try(partial(self._surfaces.later, surface, reason, counts=True))

    async def _in_turn(self, surface: Surface, held: ExitStack) -> _Outcome:
        await self._check_share(surface)
        # They are there until the stack is closed; a bucket is asked for them.
        files = await entered(self._surfaces.upload(surface), held)
        problem = await self._damage(surface, files)
        if problem is not None:
            return await self._do_without(surface.id, problem)
        return await self._attempt(surface, files)

    async def _try(self, note: Callable[[], object]) -> None:
        """Note something of a build that is found out again if it is lost."""
        try:
            await in_store(note)
        except (StoreError, IndexLostError) as error:
            _log.warning("what became of a build could not be noted: %s", error)

    async def _do_without(self, surface: str, problem: str) -> State:
        """Return the state of a surface whose upload is of no use: somebody may have restored its container."""
        if await in_store(self._surfaces.found, surface) is not None:
            return "ready"
        return await self._postpone(surface, problem)

    async def _check_share(self, surface: Surface) -> None:
        # What was ready once had its share, and is given it back.
        if surface.container is None:
            try:
                await self._limits.check_owner(surface.manifest.owner)
            except FullError as error:  # which names the owner, and readers see the reason
                _log.info("the build of %s waits: %s", surface.id, error)
                raise _LaterError("disk space of its owner, who has as much as allowed (owner_bytes)") from None

    async def _attempt(self, surface: Surface, files: Sequence[Path]) -> _Outcome:
        """Build a surface once, and return its new state, or that the build must start again from nothing."""
        it = surface.manifest
        folder = self._work.new_attempt(it.id)
        job = self._job(surface, files, folder)
        begun = await asyncio.to_thread(_identities, job.files)
        allowed = await asyncio.to_thread(_allowed, job, it.upload_bytes, self._memory, self._threads)
        continued = held = ended = counted = False

        def begin() -> None:
            nonlocal continued, counted
            confinement = self.confinement
            if confinement is None:  # the process that others are forked from has died, and is started again
                raise BlockingIOError(errno.EAGAIN, "it is not known yet how builds are confined")
            # Who builds by Dask is not confined, and a confined process may have been taken over.
            may_continue = confinement == _CONFINED and not job.shared
            continued = self._make_folders(it.id, folder, may_continue)
            # From the moment a process begins: if the server dies during it, the next one knows.
            if self._surfaces.begin(it.id) is None:
                raise _OverError
            counted = True

        call = Call(worker.build, (job,), self._settings.build_seconds, begin, allowed)
        self._running[it.id] = _Running(folder, call)
        try:
            result: worker.Built | worker.Parsed | worker.Refused | None
            result = await self._run(self._runner.call(call), folder)
            if isinstance(result, worker.Parsed):
                result = await self._run_by_cluster(it.id, job)
            if isinstance(result, worker.Built):
                self.ready = True  # as a build shows, whatever was wrong before
                result = await self._keep(it.id, job, result)
            if result is None:
                return "ready"
            await asyncio.to_thread(_check_there, folder, counted)
            ended = True
            # Whoever sees that it has failed sees nothing of it.
            await asyncio.to_thread(self._work.end, it.id, folder)
            # A build may read the files that were there when it began: not those of the same bytes that somebody has
            # uploaded after the last owner of the first had deleted them.
            if await asyncio.to_thread(_identities, job.files) != begun:
                await self._try(partial(self._surfaces.later, it.id))
                return "again"
            if continued:
                # What it continued from may have been at fault, and is gone now.
                _log.warning(_STARTED_AGAIN, it.id, result.reason)
                await self._try(partial(self._surfaces.later, it.id))
                return "again"
            if result.final:
                return await self._refuse(surface, files, result.reason, told(result.choices))
            return await self._postpone(it.id, result.reason)
        except _LaterError as error:
            held = error.held and self._is_held_shortly(it.id)
            raise
        except (MemoryError, ProcessDiedError) as error:
            await asyncio.to_thread(_check_there, folder, counted)
            if not continued or self._closing:
                raise
            _log.warning(_STARTED_AGAIN, it.id, error)
            await self._try(partial(self._surfaces.later, it.id, str(error), counts=True))
            return "again"
        except asyncio.CancelledError:
            if counted:  # the server ends, or the surface is deleted: that is no fault of the build
                await carried_out(partial(self._end_early, it.id))
            raise
        finally:
            self._running.pop(it.id, None)
            # The process has ended, or has given its result: nobody writes here any more.
            keeps = held or (self._closing and not ended)
            await carried_out(partial(self._work.end, it.id, folder, keeps))

    def _make_folders(self, surface: str, folder: Path, may_continue: bool) -> bool:
        try:
            return self._work.begin(surface, folder, may_continue)
        except FileNotFoundError as error:  # one was removed before the next was made
            raise _LaterError(_SCRATCH) from error

    def _end_early(self, surface: str) -> None:
        with suppress(StoreError, IndexLostError):
            self._surfaces.later(surface)

    def _is_held_shortly(self, surface: str) -> bool:
        """Return whether the folder of a build is locked by a process that is about to end."""
        return time.monotonic() - self._held.setdefault(surface, time.monotonic()) < _HELD_SECONDS

    async def _run(self, work: Awaitable[_T], folder: Path) -> _T | worker.Refused:
        try:
            result = await work
        except TimeoutError as error:
            return self._too_slow(error)
        except UnforeseenError as error:
            if error.errno in _PASSING:
                raise _LaterError.of(error.errno) from None
            await asyncio.to_thread(_check_there, folder, True)
            _log.error("a build failed unexpectedly: %s", error.traceback)
            return worker.Refused(f"the build failed with an internal error: {error.kind}", final=False)
        except OSError as error:
            # No folder could be made, or no process started.
            return _not_now(error)
        if isinstance(result, worker.Refused):
            return worker.Refused(reason_of(result.reason), result.final, result.choices)
        return result

    async def _run_by_cluster(self, surface: str, job: worker.Job) -> worker.Built | worker.Refused:
        if not job.shared:
            raise WrongAnswerError("expected a container, got a surface that is only parsed")
        address, started = self._settings.dask, time.monotonic()
        _log.info("the build of %s goes to the workers of the Dask scheduler %s", surface, address)
        how = "cut short"
        try:
            task = ClusterJob(job, address, self._memory // 2)
            result = await self._run(build_by_cluster(task, self._settings.build_seconds, self._threads), job.folder)
            how = f"refused: {result.reason}" if isinstance(result, worker.Refused) else "built"
            return result
        finally:
            seconds = time.monotonic() - started
            _log.info("the build of %s came back from Dask after %.1f s: %s", surface, seconds, how)

    def _too_slow(self, error: TimeoutError) -> worker.Refused:
        longer = f"more {error} than" if error.args else "longer than"
        return worker.Refused(f"the build took {longer} {self._settings.build_seconds:g} s", final=False)

    async def _keep(self, surface: str, job: worker.Job, built: worker.Built) -> worker.Refused | None:
        try:
            info = await asyncio.to_thread(results.check, job.container, built, job.files)
            picture = thumbnails.png_of(built.thumbnail)
            await in_store(self._surfaces.built, surface, job.container, built.sha256, info, picture)
        except OSError as error:
            return _not_now(error)
        except TooLargeError as error:
            return worker.Refused(str(error), final=False)
        return None

    async def _refuse(
        self, surface: Surface, files: Sequence[Path], reason: str, choices: list[dict[str, Any]]
    ) -> State:
        # Only the bytes that were acknowledged can be refused for good: not what a bad disk makes of them.
        problem = await self._damage(surface, files)
        if problem is not None:
            return await self._postpone(surface.id, problem)
        if surface.container is not None:
            return await self._postpone(surface.id, f"it was ready before, and cannot be built again: {reason}")
        try:
            await in_store(self._surfaces.refused, surface.id, reason, choices)
        except stores.FullError:
            raise
        except StoreError as error:
            _log.error("the failure of %s could not be stored: %s", surface.id, error)
            return await self._postpone(surface.id, f"{reason}; that could not be stored")
        _log.info("%s failed: %s", surface.id, reason)
        return "failed"

    async def _damage(self, surface: Surface, files: Sequence[Path]) -> str | None:
        """Return how the upload differs from the acknowledged one; None if it does not."""
        try:
            problem = await asyncio.to_thread(check_upload, files, surface.manifest)
        except OSError as error:
            if error.errno in _PASSING:
                raise _LaterError.of(error.errno) from error
            problem = error.strerror
        # Of a bucket they are in the scratch folder, and are fetched again; else the store says that they are gone.
        if problem is not None and await asyncio.to_thread(_identities, files) is None:
            raise _LaterError(_UPLOAD)
        return None if problem is None else f"the upload is damaged or cannot be read: {problem}"

    async def _postpone(self, surface: str, reason: str) -> State:
        _log.warning("%s waits for a retry: %s", surface, reason)
        await in_store(self._surfaces.stuck, surface, reason)
        await asyncio.to_thread(self._work.forget, surface)  # a retry begins with the upload
        return "waiting"

    def _out_of_memory(self) -> str:
        return f"the build needed more memory than its share, {self._memory >> 20} MiB (LODESTREAM_MEMORY)"

    def _job(self, surface: Surface, files: Sequence[Path], folder: Path) -> worker.Job:
        it = surface.manifest
        options = dict(it.options)
        return worker.Job(
            files=tuple(files),
            filename=it.filenames[0] or None,
            name=it.name,
            closed=options.pop("closed", "auto"),
            options=options,
            max_vertices=self._settings.max_vertices,
            folder=folder,
            bands=None if self._settings.dask else self._work.bands(it.id),
            allowed=self._settings.formats,
            shared=bool(self._settings.dask),
            memory=self._memory,
        )


def _lacking(error: Exception) -> str:
    """Return what a build waits for, in words for users: errors of a store say where the data of the server are."""
    if isinstance(error, _LaterError):
        return str(error)
    return f"waits for {_ROOM if isinstance(error, stores.FullError) else 'the data of the server'}"


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
    # Not when they were changed: a file that came in parts has another name for a moment, see `partial_uploads`.
    return [(status.st_dev, status.st_ino, status.st_mtime_ns) for status in statuses]


def _check_there(folder: Path, begun: bool) -> None:
    """Check that the folder of an attempt that has begun was not removed, which a build may fail of in any way."""
    if begun and not folder.is_dir():
        raise _LaterError(_SCRATCH)


def _not_now(error: OSError) -> worker.Refused:
    if error.errno in _PASSING:
        raise _LaterError.of(error.errno) from error
    return worker.Refused(f"the server's disk: {error.strerror or error}", final=False)
