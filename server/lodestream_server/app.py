"""The application: its parts, its routes, and its life from start to end."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI
from fastapi.middleware.cors import CORSMiddleware

import lodestream

from . import files, interface, pages, problems, streams, surfaces
from .access import Access
from .containers import Containers
from .gate import Gate
from .jobs import Builder
from .limits import Limits
from .metrics import Metrics
from .observation import Observation
from .routing import State
from .settings import Settings
from .storage import Storage

__all__ = ["create_app"]

_DESCRIPTION = """Structured surfaces, coarsest level first.

Upload a surface, wait until it is ready, stream it: `WS /v1/surfaces/{id}/stream`, subprotocol `lodestream.v1`,
MessagePack messages, described in `docs/protocol.md`. Errors are problem documents (RFC 9457)."""


def create_app(settings: Settings | None = None) -> FastAPI:
    """Make the application of one server.

    Parameters
    ----------
    settings : Settings or None
        None takes them from the environment.

    Returns
    -------
    FastAPI
        An ASGI application. It opens its folder when it starts and leaves it when it ends.

    Raises
    ------
    LodestreamError, OSError
        When there is no token where one is needed, or the token file cannot be used.
    """
    chosen = Settings() if settings is None else settings
    access, metrics = Access(chosen), Metrics()

    @asynccontextmanager
    async def life(app: FastAPI) -> AsyncIterator[None]:
        storage = await asyncio.to_thread(Storage, chosen.data)
        builder = Builder(storage, chosen, metrics.built)
        limits = Limits(chosen, storage.root, lambda: len(storage), lambda: builder.pending)
        metrics.watch(storage.root, lambda: len(storage), lambda: builder.pending)
        app.state.parts = State(chosen, storage, builder, Containers(storage), access, limits, metrics)
        try:
            builder.start()
            yield
        finally:
            await builder.close()
            storage.close()

    app = FastAPI(
        title="Lodestream",
        version=lodestream.__version__,
        description=_DESCRIPTION,
        lifespan=life,
        redoc_url=None,
        # A path with a slash too many is answered 404; a redirect would make a client send an upload twice.
        redirect_slashes=False,
    )
    problems.install(app)
    routers = (pages.router, surfaces.router, files.router, streams.router)
    for router in routers:
        app.include_router(router)
    app.state.routes = [router.routes for router in routers]
    app.state.metrics = metrics
    app.openapi = lambda: interface.describe(app)  # type: ignore[method-assign]
    # The last one is the first that a request meets.
    app.add_middleware(Gate, access=access)
    if chosen.origins:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=chosen.origins,
            allow_methods=["DELETE", "GET", "HEAD", "POST"],
            allow_headers=["authorization", "if-none-match", "if-range", "range"],
            expose_headers=["content-range", "etag", "location", "retry-after", "x-request-id"],
        )
    app.add_middleware(Observation, metrics=metrics)
    return app
