"""The application: its parts, its routes, and its life from start to end."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

import lodestream

from . import examples, files, pages, problems, streams, surfaces
from .containers import Containers
from .jobs import Builder
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
    """
    chosen = Settings() if settings is None else settings

    @asynccontextmanager
    async def life(app: FastAPI) -> AsyncIterator[None]:
        storage = await asyncio.to_thread(Storage, chosen.data)
        builder = Builder(storage, chosen)
        app.state.parts = State(chosen, storage, builder, Containers(storage))
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
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]
    return app


def _openapi(app: FastAPI) -> dict[str, Any]:
    if app.openapi_schema is None:
        schema = get_openapi(title=app.title, version=app.version, description=app.description, routes=app.routes)
        components = schema.setdefault("components", {}).setdefault("schemas", {})
        # What the framework assumes of validation errors is not what is answered.
        for name in ("HTTPValidationError", "ValidationError"):
            components.pop(name, None)
        for operations in schema["paths"].values():
            for operation in operations.values():
                if "422" in operation["responses"]:
                    operation["responses"]["422"] = problems.responses(422)[422]
        components["Problem"] = examples.PROBLEM_SCHEMA
        app.openapi_schema = schema
    return app.openapi_schema
