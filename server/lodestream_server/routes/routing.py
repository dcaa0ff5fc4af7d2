"""Code shared by the routes: the server's parts, and HEAD for every GET."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Depends
from fastapi.requests import HTTPConnection
from fastapi.responses import Response

from ..access.access import Access
from ..access.limits import Limits
from ..builds.builder import Builder
from ..builds.level_maker import LevelMaker
from ..builds.tile_maker import TileMaker
from ..operation.metrics import Metrics
from ..operation.pace import Pace
from ..operation.settings import Settings
from ..store.containers import Containers
from ..store.data import Data
from ..store.partial_uploads import PartialUploads
from ..store.surfaces import Surfaces
from ..upkeep import Upkeep

__all__ = ["Parts", "State", "caching", "matches", "readable"]

_Route = TypeVar("_Route", bound=Callable[..., Any])


@dataclass(frozen=True)
class State:
    """The parts of a running server."""

    settings: Settings
    data: Data
    surfaces: Surfaces
    partial_uploads: PartialUploads
    upkeep: Upkeep
    builder: Builder
    containers: Containers
    access: Access
    limits: Limits
    metrics: Metrics
    levels: LevelMaker
    tiles: TileMaker
    pace: Pace


# A coroutine, because FastAPI calls a plain function in a thread.
async def _parts(connection: HTTPConnection) -> State:
    state: State | None = getattr(connection.app.state, "parts", None)
    if state is None:
        raise RuntimeError(
            "the application of surfaces was not started: a program that mounts it enters "
            "app.router.lifespan_context(app) in its own lifespan"
        )
    return state


#: A route's parameter of this type is given the server's parts.
Parts = Annotated[State, Depends(_parts)]


def readable(
    router: APIRouter, path: str, *, dependencies: Sequence[Any] = (), **options: Any
) -> Callable[[_Route], _Route]:
    """Decorator for routes that answer GET, and HEAD in the same way; OpenAPI lists GET only."""

    def register(route: _Route) -> _Route:
        router.head(path, dependencies=dependencies, include_in_schema=False)(route)
        return router.get(path, dependencies=dependencies, **options)(route)

    return register


def caching(parts: State, *, forever: bool = False) -> str:
    """Return the Cache-Control of an answer; what is not for ever is asked for again each time."""
    # What needs a token must not come out of a shared cache for those who have none.
    if forever:
        return f"{'public' if parts.settings.public_reads else 'private'}, max-age=31536000, immutable"
    return "no-cache" if parts.settings.public_reads else "private, no-cache"


def matches(header: str | None, etag: str) -> Response | None:
    """Return a 304 answer if the client's If-None-Match names this entity tag, else None."""
    named = [item.strip().removeprefix("W/") for item in (header or "").split(",")]
    if etag in named or "*" in named:
        return Response(status_code=304, headers={"etag": etag})
    return None
