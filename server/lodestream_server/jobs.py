"""Builds: a queue of surfaces in front of processes that may die or be killed without harm.

The queue is on disk: it is the records whose state is queued. What happens to a build, and what comes of it:

======================================  ================================================================================
the surface is deleted                  its process is killed
the process dies, or lacks memory       one more attempt in another process, then failed
the process is told to end (SIGTERM)    another attempt, at most `_ENDINGS` in all: a service is being stopped
it takes longer than it may             failed
the disk is full                        it waits in the queue until there is room; nothing that was acknowledged is lost
the server dies                         the next one takes it up, after those that have not been tried so often; failed
                                        when `_CRASHES` servers have died under it
======================================  ================================================================================
"""

from __future__ import annotations

import asyncio
import errno
import logging
import signal
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from . import worker
from .durable import make_folder, remove
from .processes import Call, Pool, ProcessDiedError, UnforeseenError
from .records import Record, State
from .settings import Settings
from .storage import Storage

__all__ = ["Builder"]

_log = logging.getLogger(__name__)

_DEATHS = 2
_ENDINGS = 3
_CRASHES = 3

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT)
_FIRST_DELAY = 2.0
_LONGEST_DELAY = 60.0


@dataclass
class _Running:
    folder: Path
    call: Call


class _FullError(Exception):
    """The disk cannot take what is to be written, now."""


class Builder:
    """Builds surfaces in other processes.

    Parameters
    ----------
    storage : Storage
    settings : Settings
    finished : callable (state, seconds) or None
        Told how each build ended, ``ready`` or ``failed``, and how long its last attempt took.

    Attributes
    ----------
    ready : bool
        The kernels are compiled.
    """

    def __init__(
        self, storage: Storage, settings: Settings, finished: Callable[[State, float], None] | None = None
    ) -> None:
        self.ready = False
        self._storage = storage
        self._settings = settings
        self._finished = finished
        self._memory: int | None = getattr(settings, "build_memory", None)
        self._pool = Pool(settings.workers, partial(worker.limit_memory, self._memory))
        self._running: dict[str, _Running] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._warming: asyncio.Task[None] | None = None
        self._room = asyncio.Event()
        self._closing = False

    @property
    def pending(self) -> int:
        """Builds that wait or run."""
        return len(self._tasks)

    def start(self) -> None:
        """Warm the kernels, and take up what was queued when the server went down."""
        self._warming = asyncio.create_task(self._warm())
        queued = [record for record in self._storage.records() if record.state == "queued"]
        # What may have killed a server comes last: everything else is built before it does so again.
        for record in sorted(queued, key=lambda record: record.attempts):
            self.submit(record)

    async def accept(self, record: Record, upload: Path) -> tuple[Record, bool]:
        """Store an upload and build its surface, as `Storage.add` says; both happen even if the caller is cancelled."""
        return await asyncio.shield(asyncio.create_task(self._accept(record, upload)))

    async def _accept(self, record: Record, upload: Path) -> tuple[Record, bool]:
        record, new = await asyncio.to_thread(self._storage.add, record, upload)
        if new:
            self.submit(record)
        return record, new

    def submit(self, record: Record) -> None:
        """Build a surface when a process is free."""
        if record.id not in self._tasks and not self._closing:
            task = asyncio.create_task(self._build(record))
            self._tasks[record.id] = task
            task.add_done_callback(lambda _: self._tasks.pop(record.id, None))

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
        """
        self._storage.get(surface)
        task = self._tasks.get(surface)
        if task is not None:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
        await asyncio.to_thread(self._storage.delete, surface)
        room, self._room = self._room, asyncio.Event()
        room.set()

    async def wait(self) -> None:
        """Wait until nothing is queued any more."""
        while self._tasks:
            await asyncio.wait(self._tasks.values())

    async def close(self) -> None:
        """Kill what is running; it is taken up again after a restart."""
        self._closing = True
        tasks = [*self._tasks.values(), *([self._warming] if self._warming else [])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await asyncio.to_thread(self._pool.close)

    async def _warm(self) -> None:
        try:
            await self._pool.run(Call(worker.warm, (), None))
        except ProcessDiedError as error:
            _log.warning("the process that compiles the kernels: %s", error)
        except UnforeseenError as error:
            _log.error("the kernels could not be compiled: %s", error.traceback)
        except (MemoryError, OSError) as error:
            _log.error("the kernels could not be compiled: %s", error)
        else:
            self.ready = True

    async def _build(self, record: Record) -> None:
        delay = _FIRST_DELAY
        while True:
            started = time.monotonic()
            try:
                state = await self._insist(record)
            except _FullError as error:
                _log.error("the build of %s waits for room on the disk: %s", record.id, error)
                self._storage.waiting(record.id, "waits for room on the server's disk")
                with suppress(TimeoutError):
                    async with asyncio.timeout(delay):
                        await self._room.wait()
                delay = min(2 * delay, _LONGEST_DELAY)
                continue
            except Exception:
                _log.exception("the build of %s failed for a reason that nobody foresaw", record.id)
                state = await self._refuse(record, "the build failed inside")
            if self._finished is not None:
                self._finished(state, time.monotonic() - started)
            return

    async def _insist(self, record: Record) -> State:
        """Try until it is ready or refused."""
        if record.attempts >= _CRASHES:
            return await self._refuse(record, f"the server ended {record.attempts} times while this was being built")
        deaths = endings = 0
        while True:
            try:
                return await self._attempt(record)
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
                return await self._refuse(record, f"{reason}, {deaths + endings} times")

    async def _attempt(self, record: Record) -> State:
        folder = self._storage.work_folder(record.id)
        job = self._job(record, folder)
        # The folder is there from the moment a process begins: what is left of it tells the next server of a crash.
        call = Call(worker.build, (job,), self._settings.build_seconds, partial(make_folder, folder))
        self._running[record.id] = _Running(folder, call)
        try:
            result = await self._run(call)
            if isinstance(result, worker.Built):
                self.ready = True  # as a build shows, whatever became of the process that was to warm them
                await _on_disk(self._storage.ready, record.id, result.path, result.sha256, result.info)
                return "ready"
            return await self._refuse(record, result.reason)
        finally:
            self._running.pop(record.id, None)
            # The process has ended, or has given its result: nobody writes here any more.
            await asyncio.to_thread(remove, folder)

    async def _run(self, call: Call) -> worker.Built | worker.Refused:
        try:
            result: worker.Built | worker.Refused = await self._pool.run(call)
        except TimeoutError:
            return worker.Refused(f"the build took longer than {self._settings.build_seconds:g} s")
        except UnforeseenError as error:
            if error.errno in _NO_ROOM:
                raise _FullError(error) from None
            _log.error("a build failed for a reason that nobody foresaw: %s", error.traceback)
            return worker.Refused(f"the build failed inside: {error.kind}")
        except OSError as error:
            # No folder could be made, or no process started: not the upload's fault.
            raise _FullError(error) from error
        return result

    async def _refuse(self, record: Record, reason: str) -> State:
        _log.info("%s failed: %s", record.id, reason)
        await asyncio.to_thread(self._storage.failed, record.id, reason)
        return "failed"

    def _out_of_memory(self) -> str:
        if self._memory is None:
            return "the build needed more memory than there is"
        return f"the build needed more memory than one may have, {self._memory >> 20} MiB"

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
        )


async def _on_disk(function: Callable[..., None], *args: Any) -> None:
    try:
        await asyncio.to_thread(function, *args)
    except OSError as error:
        raise _FullError(error) from error
