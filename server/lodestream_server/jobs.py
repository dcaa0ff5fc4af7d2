"""Builds: a queue of surfaces in front of a pool of processes that may die or be killed without harm."""

from __future__ import annotations

import asyncio
import logging
import multiprocessing
import signal
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pebble import ProcessExpired, ProcessFuture, ProcessPool

from . import worker
from .durable import remove
from .records import Record, State
from .settings import Settings
from .storage import Storage

__all__ = ["Builder"]

_log = logging.getLogger(__name__)

# A process gives memory back when it ends: a large build is not paid for by the small ones after it.
_BUILDS_PER_PROCESS = 32

_ATTEMPTS = 3


@dataclass
class _Running:
    folder: Path
    future: ProcessFuture[Any]


class Builder:
    """Builds surfaces in other processes.

    Attributes
    ----------
    ready : bool
        The kernels are compiled.
    """

    def __init__(self, storage: Storage, settings: Settings) -> None:
        self.ready = False
        self._storage = storage
        self._settings = settings
        # Spawned, not forked: this process has threads.
        self._pool = ProcessPool(
            max_workers=settings.workers,
            max_tasks=_BUILDS_PER_PROCESS,
            context=multiprocessing.get_context("spawn"),
        )
        self._running: dict[str, _Running] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._warming: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Warm the kernels, and take up what was queued when the server went down."""
        self._warming = asyncio.create_task(self._warm())
        for record in self._storage.records():
            if record.state == "queued":
                self.submit(record)

    def submit(self, record: Record) -> None:
        """Build a surface when a process is free."""
        if record.id not in self._tasks:
            task = asyncio.create_task(self._build(record))
            self._tasks[record.id] = task
            task.add_done_callback(lambda _: self._tasks.pop(record.id, None))

    def state(self, record: Record) -> tuple[State, float]:
        """What a surface is doing now, and how much of its build is done."""
        if record.state != "queued":
            return record.state, float(record.state == "ready")
        running = self._running.get(record.id)
        if running is None or not running.future.running():
            return "queued", 0.0
        return "building", worker.read_progress(running.folder)

    async def cancel(self, surface: str) -> None:
        """Stop building a surface; its process is killed."""
        task = self._tasks.get(surface)
        if task is not None:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

    async def close(self) -> None:
        """Kill what is running; it is taken up again after a restart."""
        tasks = [*self._tasks.values(), *([self._warming] if self._warming else [])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await asyncio.to_thread(self._pool.stop)
        await asyncio.to_thread(self._pool.join)

    async def _warm(self) -> None:
        try:
            # Scheduling starts the processes the first time, which takes a moment: not in the event loop.
            await asyncio.wrap_future(await asyncio.to_thread(self._pool.schedule, worker.warm))
        except ProcessExpired as error:
            _log.warning("the process that compiles the kernels ended (exit code %s)", error.exitcode)
        except Exception:
            _log.exception("the kernels could not be compiled")
        else:
            self.ready = True

    async def _build(self, record: Record) -> None:
        for _ in range(_ATTEMPTS):
            if await self._attempt(record):
                return
        await self._keep(record, worker.Refused("the build was told to end too often"))

    async def _attempt(self, record: Record) -> bool:
        folder = await asyncio.to_thread(self._storage.new_work)
        try:
            future = await asyncio.to_thread(self._schedule, self._job(record, folder))
            self._running[record.id] = _Running(folder, future)
            result = await self._result(future)
            if result is not None:
                await self._keep(record, result)
            return result is not None
        finally:
            self._running.pop(record.id, None)
            await _discard(folder)

    def _schedule(self, job: worker.Job) -> ProcessFuture[worker.Built | worker.Refused]:
        return self._pool.schedule(worker.build, args=(job,), timeout=self._settings.build_seconds)

    async def _result(self, future: ProcessFuture[Any]) -> worker.Built | worker.Refused | None:
        # None when the process was told to end: whoever stops a service tells all of its processes, this one a little
        # later, and the build is to be taken up again after a restart rather than fail.
        try:
            result: worker.Built | worker.Refused = await asyncio.wrap_future(future)
        except ProcessExpired as error:
            # The pool's processes answer the signal by exiting with its number.
            if abs(error.exitcode or 0) == signal.SIGTERM:
                return None
            return worker.Refused(f"the build process ended before it was done (exit code {error.exitcode})")
        except TimeoutError:
            return worker.Refused(f"the build took longer than {self._settings.build_seconds:g} s")
        except Exception as error:
            _log.exception("a build failed for a reason that nobody foresaw")
            return worker.Refused(f"the build failed inside: {type(error).__name__}")
        return result

    async def _keep(self, record: Record, result: worker.Built | worker.Refused) -> None:
        if isinstance(result, worker.Built):
            try:
                await asyncio.to_thread(self._storage.ready, record.id, result.path, result.sha256, result.info)
            except OSError as error:
                result = worker.Refused(f"the container could not be stored: {error.strerror}")
        if isinstance(result, worker.Refused):
            _log.info("%s failed: %s", record.id, result.reason)
            await asyncio.to_thread(self._storage.failed, record.id, result.reason)

    def _job(self, record: Record, folder: Path) -> worker.Job:
        options = dict(record.options)
        return worker.Job(
            files=tuple(self._storage.upload_files(record)),
            filename=record.filenames[0] or None,
            name=record.name,
            precision=options.pop("precision", None),
            closed=options.pop("closed", "auto"),
            options=options,
            max_vertices=self._settings.max_vertices,
            folder=folder,
        )


async def _discard(folder: Path) -> None:
    # A process that is just being killed may still write into the folder while it is emptied.
    for _ in range(50):
        await asyncio.to_thread(remove, folder)
        if not folder.exists():
            return
        await asyncio.sleep(0.1)
    _log.warning("%s could not be removed; the next start of the server will", folder)
