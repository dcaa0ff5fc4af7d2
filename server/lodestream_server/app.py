"""The application: its parts, its routes, and its lifetime."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

from fastapi import FastAPI
from fastapi.middleware.cors import CORSMiddleware

import lodestream
from lodestream.encoding.cluster import require_dask
from lodestream.library import require

from . import problems
from .access.access import Access
from .access.gate import Gate
from .access.limits import Limits
from .access.scopes import unrouted
from .builds.builder import Builder
from .builds.level_files import LevelFiles
from .builds.level_maker import LevelMaker
from .builds.tile_maker import TileMaker
from .builds.work import Work
from .following import Following
from .operation.disks import disk_of
from .operation.metrics import Metrics
from .operation.observation import Observation
from .operation.pace import Pace, Paced
from .operation.settings import Settings
from .routes import files, interface, levels, maps, names, pages, resumable, streams, surfaces
from .routes.routing import State
from .store.container_cache import ContainerCache
from .store.containers import Containers
from .store.data import Data
from .store.index import Surface
from .store.partial_uploads import PartialUploads
from .upkeep import Upkeep

__all__ = ["create_app", "open_data"]

_log = logging.getLogger(__name__)

_DESCRIPTION = """Structured surfaces, coarsest level first.

Upload a surface, wait until it is ready, stream it: `WS /v1/surfaces/{id}/stream`, subprotocol `lodestream.v1`,
MessagePack messages, see `docs/protocol.md`. Errors are problem documents (RFC 9457)."""


# What levels take of the disk where the settings say nothing, unless the disk is small.
_LEVEL_DISK = 4 << 30
_LEAST_LEVEL_DISK = 2 << 20

# And what containers of a bucket take.
_CACHE = 16 << 30


def create_app(settings: Settings | None = None) -> FastAPI:
    """Create the application of one server.

    Parameters
    ----------
    settings : Settings or None
        None: from the environment.

    Returns
    -------
    FastAPI
        An ASGI application. It opens its data when it starts and releases them when it ends. A program that mounts it
        in its own enters ``app.router.lifespan_context(app)`` in its own lifespan.

    Raises
    ------
    LodestreamError, OSError
        If the compiled kernels are missing, or Dask where it is to build; if there is no token although one is needed,
        or the token file cannot be used.
    """
    require("serving surfaces")
    chosen = Settings() if settings is None else settings
    if chosen.dask:
        require_dask()
    access, metrics, pace = Access(chosen), Metrics(), Pace()

    @asynccontextmanager
    async def life(app: FastAPI) -> AsyncIterator[None]:
        # A server has opened it before, so that it can say in one line why it does not start.
        opened: Data | None = getattr(app.state, "data", None)
        data = await asyncio.to_thread(open_data, chosen) if opened is None else opened
        async with AsyncExitStack() as ending:  # whatever has begun ends, also if the rest cannot begin
            ending.push_async_callback(asyncio.to_thread, data.close)
            surfaces, loop = data.surfaces, asyncio.get_running_loop()

            def queue_again(lost: list[Surface]) -> None:
                for surface in lost:
                    loop.call_soon_threadsafe(builder.submit, surface)

            def count(owner: str | None) -> tuple[int, int]:
                named, named_by_owner = surfaces.index.count_names(owner)
                return len(surfaces.index) + named, surfaces.index.count_of(owner) + named_by_owner

            def kept(owner: str | None) -> int:
                # In this order: an upload that becomes a surface meanwhile counts twice, and never not at all.
                return partial_uploads.kept(owner) + surfaces.index.kept(owner)

            partial_uploads = await asyncio.to_thread(
                PartialUploads, data.partial, chosen.max_partial_uploads, chosen.partial_seconds
            )
            limits = Limits(chosen, data.disks, count, kept, lambda: access.alone, endless=data.is_endless)
            cache = await asyncio.to_thread(_container_cache, chosen, data, limits)
            containers = Containers(surfaces, lost=queue_again, cache=cache)
            ending.push_async_callback(asyncio.to_thread, containers.close)
            builder = Builder(surfaces, Work(data.work), chosen, limits, metrics.built)
            ending.push_async_callback(builder.close)
            metrics.watch(data.disks[0], lambda: len(surfaces.index), lambda: builder.pending)
            files_of_levels = await asyncio.to_thread(_level_files, chosen, data, limits)
            levels = LevelMaker(chosen, containers, files_of_levels, builder.fork_server, limits)
            ending.push_async_callback(levels.close)
            tiles = TileMaker(chosen, containers, builder.fork_server, limits)
            ending.push_async_callback(tiles.close)
            upkeep = Upkeep(surfaces, builder, levels, partial_uploads)
            ending.push_async_callback(upkeep.close)
            following = Following(chosen, surfaces, access)
            ending.push_async_callback(asyncio.to_thread, following.close)
            metrics.watch_bucket(lambda: surfaces.writes, lambda: following.unseen)
            app.state.parts = State(
                settings=chosen,
                data=data,
                surfaces=surfaces,
                following=following,
                partial_uploads=partial_uploads,
                upkeep=upkeep,
                builder=builder,
                containers=containers,
                access=access,
                limits=limits,
                metrics=metrics,
                levels=levels,
                tiles=tiles,
                pace=pace,
            )
            await builder.start()
            upkeep.start()
            data.start()
            following.start()
            # Before all else ends, which may take long while the bucket does not answer.
            ending.push_async_callback(asyncio.to_thread, data.leave)
            yield

    app = FastAPI(
        title="Lodestream",
        version=lodestream.__version__,
        description=_DESCRIPTION,
        lifespan=life,
        # The pages of the framework load scripts from another host; ours are in `pages`.
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
        # A path with a slash too many is answered 404; a redirect would make a client send an upload twice.
        redirect_slashes=False,
        # Names for generated clients: list_surfaces, get_surface.
        generate_unique_id_function=lambda route: route.name,
    )
    problems.install(app)
    for status in (404, 405):  # of the framework; routes raise errors of ours
        app.add_exception_handler(status, unrouted)
    modules = (pages, surfaces, resumable, names, files, levels, maps, streams)
    routers = [module.router for module in modules]
    for router in routers:
        app.include_router(router)
    app.state.routes = [router.routes for router in routers]
    app.state.access, app.state.metrics, app.state.pace = access, metrics, pace
    app.openapi = lambda: interface.describe(app)  # type: ignore[method-assign]
    # The last one is the first that a request meets.
    app.add_middleware(Gate, access=access)
    if chosen.origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=chosen.origins,
            allow_methods=["DELETE", "GET", "HEAD", "PATCH", "POST", "PUT"],
            allow_headers=["authorization", "if-none-match", "if-range", "range", *resumable.REQUEST_HEADERS],
            expose_headers=[
                *("content-location", "content-range", "etag", "location", "retry-after", "x-request-id"),
                *resumable.ANSWER_HEADERS,
            ],
        )
    app.add_middleware(Paced, pace=pace)
    app.add_middleware(Observation, metrics=metrics, log_reads=chosen.log_reads)
    return app


def open_data(settings: Settings) -> Data:
    """Open the data of a server; see `Data` for the errors."""
    return Data(settings.data, settings.scratch, read_only=settings.read_only, lease_seconds=settings.lease_seconds)


def _level_files(settings: Settings, data: Data, limits: Limits) -> LevelFiles:
    most = settings.level_disk
    if most is None:
        most = max(min(_LEVEL_DISK, _disk_of(data.scratch) // 20), _LEAST_LEVEL_DISK)
    return LevelFiles(data.levels, most, limits.room)


def _container_cache(settings: Settings, data: Data, limits: Limits) -> ContainerCache | None:
    """Return the cache of containers that are on another machine; None if they are on this one."""
    if not data.is_endless:
        return None
    surfaces, most = data.surfaces, settings.cache_bytes
    if most is None:
        most = min(_CACHE, _disk_of(data.scratch) // 10)
    cache = ContainerCache(data.containers, most, limits.room_now, surfaces.store)
    cache.start(surfaces.index.uses_container)
    return cache


def _disk_of(folder: Path) -> int:
    """Return the size of the disk of a folder; 0 if it is unknown, since all there can be made again."""
    try:
        return disk_of(folder).total
    except OSError as error:
        _log.warning("the size of the disk is unknown, so that few levels and containers are kept: %s", error)
        return 0
