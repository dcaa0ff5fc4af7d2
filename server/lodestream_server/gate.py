"""What stands before every route: whoever may not pass learns why, and nothing else; no body is read before."""

from __future__ import annotations

from fastapi import Request
from fastapi.requests import HTTPConnection
from starlette.types import ASGIApp, Receive, Scope, Send

from lodestream.errors import LodestreamError

from .access import Access, Caller, needed_scope
from .problems import answer

__all__ = ["Gate", "caller_of"]

_CALLER = "lodestream.caller"


class Gate:
    """ASGI middleware that asks `Access`.

    A route that nobody has thought of needs a token, so that forgetting one opens nothing.

    Parameters
    ----------
    app : ASGI application
    access : Access
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request through, or answer it."""
        if scope["type"] in ("http", "websocket"):
            try:
                scope[_CALLER] = self._admit(scope)
            except LodestreamError as error:
                await answer(HTTPConnection(scope), error)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _admit(self, scope: Scope) -> Caller | None:
        connection = HTTPConnection(scope)
        if scope["type"] == "websocket":
            self._access.check_origin(connection)
            return self._access.reader(connection)
        request = Request(scope)
        needed = needed_scope(request.method, _path(scope))
        if request.method not in ("GET", "HEAD"):
            self._access.check_origin(connection)
        return None if needed is None else self._access.authorize(connection, needed)


def caller_of(connection: HTTPConnection) -> Caller | None:
    """Who asks; None on a route that is open to everybody, and for a stream that has to show a ticket."""
    found: Caller | None = connection.scope[_CALLER]
    return found


def _path(scope: Scope) -> str:
    path: str = scope["path"]
    root: str = scope.get("root_path", "")
    # As the router does it: the prefix counts only where a segment of the path ends.
    return path[len(root) :] if root and path.startswith(f"{root}/") else path
