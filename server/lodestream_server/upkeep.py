"""What a server does beside answering: it keeps its index up to date, makes a lost one again, deletes what is due.

Of servers that share a bucket the one with the lease builds and deletes, once it knows what others have done.
"""

from __future__ import annotations

import asyncio
import logging
from contextlib import suppress
from functools import partial

from .builds.builder import Builder
from .builds.level_maker import LevelMaker
from .operation.threads import in_store
from .store.index import IndexLostError, Surface
from .store.partial_uploads import PartialUploads
from .store.surfaces import Surfaces

__all__ = ["Upkeep"]

_log = logging.getLogger(__name__)

# How often it is looked for surfaces that nobody builds, because an error came between.
_LOOK_SECONDS = 300.0

# How often replaced surfaces are looked at, and what failed is tried again.
_EXPIRE_SECONDS = 300.0
_AGAIN_SECONDS = 2.0

# How often strays in a bucket are collected; a folder has few, which `fsck` removes.
_COLLECT_SECONDS = 6 * 3600.0


class Upkeep:
    """Work on the surfaces of a server that nobody waits for.

    Parameters
    ----------
    surfaces : Surfaces
    builder : Builder
    levels : LevelMaker
    partial_uploads : PartialUploads

    Attributes
    ----------
    is_failing : bool
        Whether the index could not be brought up to date the last time.
    """

    def __init__(
        self, surfaces: Surfaces, builder: Builder, levels: LevelMaker, partial_uploads: PartialUploads
    ) -> None:
        self._surfaces = surfaces
        self._builder = builder
        self._levels = levels
        self._partial_uploads = partial_uploads
        self.is_failing = False
        self._lost, self._synced = asyncio.Event(), asyncio.Event()
        self._tasks: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Begin."""
        loop = asyncio.get_running_loop()
        wake = partial(loop.call_soon_threadsafe, self._lost.set)
        self._surfaces.tell_lost = wake
        if self._surfaces.lease is not None:
            self._surfaces.lease.turned = wake
        works = (self._keep_index(), self._expire(), self._expire_uploads(), self._collect())
        self._tasks = [asyncio.create_task(work) for work in works]

    async def close(self) -> None:
        """End."""
        self._surfaces.tell_lost = lambda: None
        if self._surfaces.lease is not None:
            self._surfaces.lease.turned = lambda: None
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _keep_index(self) -> None:
        while True:
            try:
                if self._surfaces.is_lost:
                    _log.error("the index of the surfaces is lost; requests are answered 503 until it is made again")
                    await in_store(self._surfaces.restore)
                    _log.info("the index of the surfaces is made again")
                elif not self._surfaces.is_current:
                    await in_store(self._surfaces.sync)
                self.is_failing = False
                self._synced.set()
                if self._surfaces.writes:
                    await self._builder.resume()
                else:
                    await self._builder.halt()
                with suppress(TimeoutError):
                    async with asyncio.timeout(_LOOK_SECONDS):
                        await self._lost.wait()
                self._lost.clear()
            except Exception as error:  # whatever it is, nobody else would do this work
                self.is_failing = True
                lease = self._surfaces.lease
                holds = lease is not None and lease.held and not self._surfaces.writes
                _log.error(
                    "the index of the surfaces could not be brought up to date, which is tried again: %s%s",
                    error,
                    "; this server has the lease of the bucket, and nobody writes until then" if holds else "",
                )
                await asyncio.sleep(_AGAIN_SECONDS)

    def forget_levels(self, deleted: Surface) -> None:
        """Remove the level files of a deleted surface, unless another one has its container."""
        if deleted.container is None:
            return
        with suppress(IndexLostError):  # they go when others need the room
            if not self._surfaces.index.uses_container(deleted.container):
                self._levels.forget(deleted.container)

    async def _expire(self) -> None:
        await self._synced.wait()
        while True:
            if self._surfaces.is_synced and self._surfaces.writes:
                try:
                    for surface in await in_store(self._surfaces.names.expire):
                        self.forget_levels(surface)
                except IndexLostError:
                    pass  # it is told; what is due stays so
                except Exception:
                    _log.exception("replaced surfaces cannot be deleted now, which is tried again")
            await asyncio.sleep(_EXPIRE_SECONDS)

    async def _expire_uploads(self) -> None:
        while True:
            try:
                await self._partial_uploads.expire()
            except Exception:  # whatever it is, nobody else would do this work
                _log.exception("uploads in parts that are due cannot be removed now, which is tried again")
            await asyncio.sleep(_EXPIRE_SECONDS)

    async def _collect(self) -> None:
        while self._surfaces.lease is not None:
            await asyncio.sleep(_COLLECT_SECONDS)
            if self._surfaces.writes:
                try:
                    removed = await in_store(self._surfaces.collect)
                    _log.info("removed %d objects that nothing refers to", len(removed))
                    if await in_store(self._surfaces.lose_missing):
                        await self._builder.resume()
                except Exception as error:  # whatever it is, nobody else would do this work
                    _log.error("strays could not be removed now, which is tried again: %s", error)
