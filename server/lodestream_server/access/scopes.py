"""The scope that a route needs, as a dependency of FastAPI: it is asked for before any byte of a body is read.

What changes something is refused here too by a server that does not write.
"""

from __future__ import annotations

from typing import Annotated

from fastapi import Request, Security
from fastapi.openapi.models import HTTPBearer
from fastapi.requests import HTTPConnection
from fastapi.responses import Response
from fastapi.security import SecurityScopes
from fastapi.security.base import SecurityBase
from fastapi.websockets import WebSocket

from lodestream.errors import LodestreamError

from .. import problems
from .access import Access, Caller

__all__ = ["ADMIN", "READ", "SCHEME", "WRITE", "Reader", "StreamReader", "Writer", "unrouted"]

#: Name of the tokens in the OpenAPI document.
SCHEME = "token"

_READING = {"GET", "HEAD", "OPTIONS"}


class _Token(SecurityBase):
    """The caller of a request, which must be allowed to do what the scope of the route allows."""

    def __init__(self) -> None:
        self.model = HTTPBearer(description="as `lodestream token create` prints it")
        self.scheme_name = SCHEME

    async def __call__(self, connection: HTTPConnection, scopes: SecurityScopes) -> Caller:
        caller = _access(connection).authorize(connection, scopes.scope_str)
        if connection.scope.get("method", "GET") not in _READING:
            connection.state.is_for_another = True
            connection.app.state.parts.surfaces.check_writer()
            connection.state.is_for_another = False
        return caller


async def _stream_reader(socket: WebSocket) -> Caller | None:
    return _access(socket).reader(socket)


def _access(connection: HTTPConnection) -> Access:
    access: Access = connection.app.state.access
    return access


_token = _Token()

# For routes that need not know who calls; for the others the caller comes first among the parameters, so that nothing
# is done for those who are refused.
READ = Security(_token, scopes=["read"])
WRITE = Security(_token, scopes=["write"])
ADMIN = Security(_token, scopes=["admin"])

Reader = Annotated[Caller, READ]
Writer = Annotated[Caller, WRITE]
#: Who opens a stream; None if the ``open`` message must have a token.
StreamReader = Annotated[Caller | None, Security(_stream_reader, scopes=["read"])]


async def unrouted(request: Request, error: Exception) -> Response:
    """Answer a request that no route takes; what paths there are is told to those who may read or write there."""
    try:
        _access(request).authorize(request, "read" if request.method in _READING else "write")
    except LodestreamError as refusal:
        return problems.answer(request, refusal)
    return await problems.refused(request, error)
