"""What is refused in front of every route, whoever asks: paths that others read differently, pages of other sites."""

from __future__ import annotations

import unicodedata

from fastapi.requests import HTTPConnection
from starlette.types import ASGIApp, Receive, Scope, Send

from lodestream.errors import LodestreamError, NotFoundError

from ..problems import answer
from .access import Access

__all__ = ["Gate"]


class Gate:
    """ASGI middleware in front of the routes, which ask for their scopes themselves (`scopes`).

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
            connection = HTTPConnection(scope)
            try:
                _check_path(scope)
                if scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD"):
                    self._access.check_origin(connection)
            except LodestreamError as error:
                await answer(connection, error)(scope, receive, send)
                return
        await self._app(scope, receive, send)


def _check_path(scope: Scope) -> None:
    # A proxy that cuts paths apart in another way than we do would guard another path than the one that is answered.
    raw: bytes = scope.get("raw_path") or b""
    if b"%2f" in raw.partition(b"?")[0].lower():
        raise NotFoundError("No such address on this server: no path here has an encoded slash")
    if any(unicodedata.category(character) == "Cc" for character in scope["path"]):
        raise NotFoundError("No such address on this server: no path here has a control character")
