"""What the routes share: the server's parts, and answering HEAD wherever GET is answered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Depends
from fastapi.requests import HTTPConnection
from fastapi.responses import Response

from .access import Access
from .containers import Containers
from .jobs import Builder
from .limits import Limits, Turnstile
from .metrics import Metrics
from .settings import Settings
from .storage import Storage

__all__ = ["Parts", "State", "matches", "readable"]

_Route = TypeVar("_Route", bound=Callable[..., Any])


@dataclass(frozen=True)
class State:
    """The parts of a running server.

    ``decoding`` is held while a level is decoded: it takes as much memory as the surface, so there is one at a time.
    """

    settings: Settings
    storage: Storage
    builder: Builder
    containers: Containers
    access: Access
    limits: Limits
    metrics: Metrics
    decoding: Turnstile = field(init=False)

    def __post_init__(self) -> None:
        """Let as many wait for a level as the settings say."""
        object.__setattr__(self, "decoding", Turnstile(self.settings.max_level_requests))


def _parts(connection: HTTPConnection) -> State:
    state: State = connection.app.state.parts
    return state


#: A route's parameter of this type is given the server's parts.
Parts = Annotated[State, Depends(_parts)]


def readable(router: APIRouter, path: str, **options: Any) -> Callable[[_Route], _Route]:
    """Answer GET, and HEAD likewise; OpenAPI lists GET."""

    def register(route: _Route) -> _Route:
        router.head(path, include_in_schema=False)(route)
        return router.get(path, **options)(route)

    return register


def matches(header: str | None, etag: str) -> Response | None:
    """The answer 304 when a client's If-None-Match names what it would get again."""
    named = [item.strip().removeprefix("W/") for item in (header or "").split(",")]
    if etag in named or "*" in named:
        return Response(status_code=304, headers={"etag": etag})
    return None
