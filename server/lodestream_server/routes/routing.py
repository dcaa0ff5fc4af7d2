"""Code shared by the routes: the server's parts, and HEAD for every GET."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Depends, Request
from fastapi.dependencies.models import Dependant
from fastapi.requests import HTTPConnection
from fastapi.responses import Response
from fastapi.routing import APIRoute

from lodestream.errors import OptionError

from ..access.access import Access
from ..access.limits import Limits
from ..builds.builder import Builder
from ..builds.level_maker import LevelMaker
from ..builds.tile_maker import TileMaker
from ..following import Following
from ..operation.metrics import Metrics
from ..operation.pace import Pace
from ..operation.settings import Settings
from ..store.containers import Containers
from ..store.data import Data
from ..store.partial_uploads import PartialUploads
from ..store.surfaces import Surfaces
from ..upkeep import Upkeep

__all__ = ["AnyQuery", "Parts", "State", "caching", "described", "matches", "readable"]

_Route = TypeVar("_Route", bound=Callable[..., Any])


@dataclass(frozen=True)
class State:
    """The parts of a running server."""

    settings: Settings
    data: Data
    surfaces: Surfaces
    following: Following
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


#: The server's parts, for routes that look at the query themselves.
AnyQuery = Annotated[State, Depends(_parts)]


async def _checked(request: Request, parts: AnyQuery) -> State:
    if request.scope["query_string"]:
        _check_query(request)
    return parts


#: A route's parameter of this type is given the server's parts, once nothing unknown is in the query.
Parts = Annotated[State, Depends(_checked)]


def _check_query(request: Request) -> None:
    """Refuse a key of the query that the route does not know: what a caller meant by it would not be done."""
    route = request.scope["route"]
    assert isinstance(route, APIRoute)
    known = _parameters(route.dependant)
    for key in request.query_params:
        if key not in known:
            what = f"only {', '.join(known)}" if known else "and no other"
            raise OptionError(f"There is no parameter {key[:80]!a} here, {what}")


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


def _parameters(dependant: Dependant) -> list[str]:
    """Return the names of what is read from the query, by a route or by what it depends on."""
    known = [parameter.alias for parameter in dependant.query_params]
    return known + [name for other in dependant.dependencies for name in _parameters(other)]


def described(request: Request, parts: State, content: bytes) -> Response:
    """Return an answer with JSON, or 304 if the client has it; its strong ETag is made from what it says."""
    etag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
    answer = matches(request.headers.get("if-none-match"), etag) or Response(content, media_type="application/json")
    answer.headers.update({"etag": etag, "cache-control": caching(parts)})
    return answer


def matches(header: str | None, etag: str) -> Response | None:
    """Return a 304 answer if the client's If-None-Match names this entity tag, else None."""
    named = [item.strip().removeprefix("W/") for item in (header or "").split(",")]
    if etag in named or "*" in named:
        return Response(status_code=304, headers={"etag": etag})
    return None
