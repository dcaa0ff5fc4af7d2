"""Access control in front of every route; a request is refused before its body is read."""

from __future__ import annotations

import unicodedata

from fastapi import Request
from fastapi.requests import HTTPConnection
from starlette.types import ASGIApp, Receive, Scope, Send

from lodestream.errors import LodestreamError, NotFoundError

from ..problems import answer
from .access import Access, Caller
from .scopes import needed_scope

__all__ = ["Gate", "caller_of"]

_CALLER = "lodestream.caller"


class Gate:
    """ASGI middleware that asks `Access` for the scope that the route declares (`scopes`).

    Parameters
    ----------
    app : ASGI application
    access : Access
    """

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] in ("http", "websocket"):
            try:
                scope[_CALLER] = self._admit(scope)
            except LodestreamError as error:
                await answer(HTTPConnection(scope), error)(scope, receive, send)
                return
        await self._app(scope, receive, send)

    def _admit(self, scope: Scope) -> Caller | None:
        _check_path(scope)
        connection = HTTPConnection(scope)
        needed = needed_scope(scope)
        if scope["type"] == "websocket":
            self._access.check_origin(connection)
            return self._access.reader(connection) if needed == "read" else self._authorize(connection, needed)
        request = Request(scope)
        if request.method not in ("GET", "HEAD"):
            self._access.check_origin(connection)
        return self._authorize(connection, needed)

    def _authorize(self, connection: HTTPConnection, needed: str | None) -> Caller | None:
        return None if needed is None else self._access.authorize(connection, needed)


def caller_of(connection: HTTPConnection) -> Caller | None:
    """Return the caller of a request.

    None on an open route, and for a stream whose ``open`` message must have a token.
    """
    caller: Caller | None = connection.scope[_CALLER]
    return caller


def _check_path(scope: Scope) -> None:
    # A proxy that cuts paths apart in another way than we do would guard another path than the one that is answered.
    raw: bytes = scope.get("raw_path") or b""
    if b"%2f" in raw.partition(b"?")[0].lower():
        raise NotFoundError("expected a path that /docs lists, got one with an encoded slash")
    if any(unicodedata.category(character) == "Cc" for character in scope["path"]):
        raise NotFoundError("expected a path that /docs lists, got one with a control character")
