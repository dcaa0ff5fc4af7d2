"""The scope that a request needs; it is declared at the route that will answer the request."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from fastapi import FastAPI
from starlette.routing import BaseRoute, Match
from starlette.types import Scope

__all__ = ["needed_scope", "needs", "routes_of", "scope_of"]

_Endpoint = TypeVar("_Endpoint", bound=Callable[..., Any])

_DECLARED = "lodestream_scope"
_READING = {"GET", "HEAD", "OPTIONS"}


def needs(scope: str | None) -> Callable[[_Endpoint], _Endpoint]:
    """Decorator that declares the scope of a route; None: open to everybody.

    Parameters
    ----------
    scope : str or None
        One of `lodestream_server.access.tokens.SCOPES`.
    """

    def declare(endpoint: _Endpoint) -> _Endpoint:
        setattr(endpoint, _DECLARED, scope)
        return endpoint

    return declare


def scope_of(route: BaseRoute) -> str | None:
    """Return the scope declared at a route; without a declaration ``admin``, so that a forgotten one opens nothing."""
    declared: str | None = getattr(getattr(route, "endpoint", None), _DECLARED, "admin")
    return declared


def routes_of(app: FastAPI) -> list[BaseRoute]:
    """Return the routes of an application of `create_app`, in the order in which they are matched."""
    ours = [route for routes in app.state.routes for route in routes]
    # What was added to the application itself; an included router is none that has a path.
    return ours + [route for route in app.routes if hasattr(route, "path_regex")]


def needed_scope(scope: Scope) -> str | None:
    """Return the scope that a request needs; None if it is open to everybody.

    The routes themselves decide which of them answers. If none does, a scope for reading or writing is needed all the
    same, depending on the method, before the answer 404.

    Parameters
    ----------
    scope : dict
        The ASGI scope of the request; ``app`` is an application of `create_app`.
    """
    for route in routes_of(scope["app"]):
        if route.matches(scope)[0] is Match.FULL:
            return scope_of(route)
    return "read" if scope.get("method", "GET") in _READING else "write"
