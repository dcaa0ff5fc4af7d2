"""What errors are called: from classes to codes; problem documents (RFC 9457)."""

from __future__ import annotations

import errno
import logging
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, NamedTuple

from fastapi import FastAPI, Request
from fastapi.dependencies.models import Dependant
from fastapi.exceptions import RequestValidationError
from fastapi.requests import HTTPConnection
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Route

from lodestream import stores
from lodestream.errors import (
    FormatError,
    InputError,
    LodestreamError,
    NotFoundError,
    OptionError,
    StreamError,
    TooLargeError,
    UnavailableError,
    UnsupportedVersionError,
)
from lodestream.protocol.messages import MessageError

from .codes import MEANINGS, address
from .refusals import faults_of_parameters

__all__ = [
    "MEDIA_TYPE",
    "PASSING",
    "BadTokenError",
    "BuildFailedError",
    "BusyError",
    "DamagedNameError",
    "ForeignOriginError",
    "FullError",
    "LockedError",
    "NoTokenError",
    "NoWebSocketError",
    "NotOwnerError",
    "NotReadyError",
    "PostponedError",
    "ReadOnlyError",
    "RestartingError",
    "SilentError",
    "SlowUploadError",
    "SmallScopeError",
    "StandbyError",
    "TooManyError",
    "WrongOffsetError",
    "WrongTypeError",
    "WrongVersionError",
    "answer",
    "document",
    "install",
    "problem",
    "refused",
    "responses",
]

_log = logging.getLogger(__name__)
#: Of problem documents.
MEDIA_TYPE = "application/problem+json"

#: Errors of the system that lacks something of which there may be more in a moment, such as open files.
PASSING = (errno.EAGAIN, errno.EMFILE, errno.ENFILE, errno.ENOMEM)


class NotReadyError(LodestreamError):
    """The surface is still being built."""

    headers: ClassVar = {"retry-after": "1"}


class BuildFailedError(LodestreamError):
    """The surface could not be built."""


class PostponedError(LodestreamError):
    """The surface could not be built for a reason that may pass; it waits for a retry."""


class NotOwnerError(LodestreamError):
    """The surface, or the name, belongs to another owner."""


class DamagedNameError(LodestreamError):
    """What is stored of a name cannot be read."""


class StandbyError(stores.StoreError):
    """Another server writes to the bucket, or this one is about to."""

    headers: ClassVar = {"retry-after": "5"}


class ReadOnlyError(LodestreamError):
    """This server only reads."""


class SlowUploadError(LodestreamError):
    """An upload was too slow, or stopped."""


class SilentError(LodestreamError):
    """The client of a stream sent nothing, or did not read, for too long."""


class WrongOffsetError(LodestreamError):
    """Bytes of an upload that are not the next ones.

    Attributes
    ----------
    headers : mapping of str to str
        With the offset of the next ones.
    """

    def __init__(self, expected: int, got: int) -> None:
        super().__init__(f"The upload goes on at byte {expected}, and these bytes begin at {got}")
        self.headers = {"upload-offset": str(expected)}


class LockedError(LodestreamError):
    """Another request is at work on the same upload."""

    headers: ClassVar = {"retry-after": "1"}


class WrongVersionError(LodestreamError):
    """A request of another version of the protocol of resumable uploads."""

    headers: ClassVar = {"tus-version": "1.0.0"}


class WrongTypeError(LodestreamError):
    """A body of a type that the route does not take."""


class NoTokenError(LodestreamError):
    """A token is needed, and there is none."""

    headers: ClassVar = {"www-authenticate": 'Bearer realm="lodestream"'}


class BadTokenError(LodestreamError):
    """The token is unknown, expired or revoked."""

    headers: ClassVar = {"www-authenticate": 'Bearer realm="lodestream", error="invalid_token"'}


class SmallScopeError(LodestreamError):
    """The token's scope does not allow this."""

    headers: ClassVar = {"www-authenticate": 'Bearer realm="lodestream", error="insufficient_scope"'}


class ForeignOriginError(LodestreamError):
    """A page of another site made the request."""


class NoWebSocketError(LodestreamError):
    """A stream was asked for in an ordinary request."""


class TooManyError(LodestreamError):
    """One client has as much in progress as allowed."""

    headers: ClassVar = {"retry-after": "5"}


class BusyError(LodestreamError):
    """The server has as much in progress as it can handle."""

    headers: ClassVar = {"retry-after": "10"}


class ShortageError(BusyError):
    """The server's system lacks something now (`PASSING`)."""


class RestartingError(LodestreamError):
    """The server is ending and will be back."""

    headers: ClassVar = {"retry-after": "5"}


class FullError(LodestreamError):
    """There is no room for more surfaces."""

    headers: ClassVar = {"retry-after": "60"}


_SEE_LOG = "the server's log says more"


class _Kind(NamedTuple):
    """The code of a class of errors, and the detail, a sentence that needs no title: ``{}`` are the error's own words.

    It has none where they would tell where data are.
    """

    code: str
    detail: str = "{}"


# A class that is not here is what its base is.
_KINDS: Mapping[type[BaseException], _Kind] = {
    TooLargeError: _Kind("too-large"),
    OptionError: _Kind("bad-option"),
    FormatError: _Kind("bad-file"),
    InputError: _Kind("bad-input"),
    UnavailableError: _Kind("unavailable", "This server lacks a library that this needs: {}"),
    NotFoundError: _Kind("not-found"),
    SlowUploadError: _Kind("idle"),
    WrongOffsetError: _Kind("wrong-offset"),
    LockedError: _Kind("locked"),
    WrongVersionError: _Kind("wrong-version"),
    WrongTypeError: _Kind("wrong-type"),
    SilentError: _Kind("idle"),
    NoTokenError: _Kind("no-token"),
    BadTokenError: _Kind("bad-token"),
    SmallScopeError: _Kind("small-scope"),
    NotOwnerError: _Kind("not-owner"),
    ForeignOriginError: _Kind("foreign-origin"),
    NoWebSocketError: _Kind("no-websocket"),
    TooManyError: _Kind("too-many"),
    BusyError: _Kind("busy"),
    ShortageError: _Kind("busy", f"The server's system lacks something now, such as open files; {_SEE_LOG}"),
    RestartingError: _Kind("restarting"),
    FullError: _Kind("full"),
    NotReadyError: _Kind("not-ready"),
    BuildFailedError: _Kind("failed"),
    PostponedError: _Kind("waiting"),
    DamagedNameError: _Kind("damaged-name"),
    StreamError: _Kind("damaged", "The stored container is damaged: {}"),
    UnsupportedVersionError: _Kind("unsupported-version"),
    StandbyError: _Kind("busy"),
    ReadOnlyError: _Kind("read-only"),
    stores.FullError: _Kind("disk-full", "The disk is full, and nothing was stored; delete surfaces or enlarge it"),
    stores.UnacknowledgedError: _Kind("busy", f"It is not known whether that was done; {_SEE_LOG}"),
    stores.StoreError: _Kind("busy", f"The server's store cannot be used now; {_SEE_LOG}"),
    ClientDisconnect: _Kind("gone", "The body ended before it was complete"),
    # An unexpected error reveals nothing about the server.
    Exception: _Kind("internal", f"The server failed; {_SEE_LOG}"),
}

# Headers of answers to errors that have none of their own.
_USUAL: Mapping[int, Mapping[str, str]] = {
    426: {"connection": "upgrade", "upgrade": "websocket"},
    503: BusyError.headers,
    507: FullError.headers,
}

#: Codes of what the framework refuses by itself.
_OF_THE_FRAMEWORK = {404: "not-found", 405: "bad-method", 416: "requested-range-not-satisfiable"}


def install(app: FastAPI) -> None:
    """Answer every error of an application with a problem document."""
    app.add_exception_handler(LodestreamError, _raised)
    app.add_exception_handler(ClientDisconnect, _raised)
    app.add_exception_handler(OSError, _raised)
    app.add_exception_handler(Exception, _raised)
    app.add_exception_handler(HTTPException, refused)
    app.add_exception_handler(RequestValidationError, _invalid)


def problem(error: Exception) -> tuple[str, str]:
    """Return the code of an error, a key of `MEANINGS`, and its detail."""
    if isinstance(error, MessageError):
        return error.code, str(error)
    code, detail = next(_KINDS[kind] for kind in _class(error).__mro__ if kind in _KINDS)
    return code, detail.format(error)


def _class(error: Exception) -> type[Exception]:
    """Return the class of an error; of one of the system, what it is here."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return stores.FullError
    if isinstance(error, OSError) and error.errno in PASSING:
        return ShortageError
    return type(error)


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return OpenAPI responses of routes that answer with these problems."""
    return {
        status: {
            "description": " or ".join(f"`{code}`" for code, it in sorted(MEANINGS.items()) if it.status == status),
            "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
        }
        for status in statuses
    }


async def _raised(request: HTTPConnection, error: Exception) -> Response:
    return answer(request, error)


def answer(request: HTTPConnection, error: Exception) -> Response:
    """Return the problem document for an error."""
    code, detail = problem(error)
    status = MEANINGS[code].status
    # Whoever found a damage has told of it; and a server says once that it waits for another one.
    if status >= 500 and code != "damaged" and not isinstance(error, StandbyError):
        _log.error("%s: %s", request.url.path, error, exc_info=error if status == 500 else None)
    return _document(request, code, detail, getattr(error, "headers", _USUAL.get(status, {})))


async def refused(request: Request, error: Exception) -> Response:
    """Return the problem document for an error of the framework."""
    assert isinstance(error, HTTPException)
    detail, headers = error.detail, dict(error.headers or {})
    if error.status_code == 404:
        path = request.url.path
        docs = f"{request.scope.get('root_path', '')}/docs lists what there is"
        hint = "without the slash at its end there may be one" if path.endswith("/") else docs
        detail = f"No such address on this server: {path[:100]!r}; {hint}"
    if error.status_code == 405:
        # The framework names the methods of the first route of this path only.
        headers = {"allow": ", ".join(_methods(request))}
        detail = f"Nothing takes {request.method} here, only {headers['allow']}"
    return _document(request, _OF_THE_FRAMEWORK[error.status_code], detail, headers)


def _methods(request: Request) -> list[str]:
    methods = set[str]()
    path = request.url.path.removeprefix(request.scope.get("root_path", ""))
    for routes in request.app.state.routes:
        for route in routes:
            if isinstance(route, Route) and route.path_regex.match(path):
                methods |= route.methods or set()
    return sorted(methods)


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    told = dict(_descriptions(request.scope["route"].dependant))
    return _document(request, "bad-option", faults_of_parameters(error.errors(), told), {})


def _descriptions(dependant: Dependant) -> Iterator[tuple[str, str]]:
    """Iterate over names and descriptions of what is read from path and query, by a route or what it depends on."""
    for parameter in [*dependant.path_params, *dependant.query_params]:
        if parameter.field_info.description:
            yield parameter.alias, parameter.field_info.description
    for other in dependant.dependencies:
        yield from _descriptions(other)


def _document(request: HTTPConnection, code: str, detail: str, headers: Mapping[str, str]) -> JSONResponse:
    request.app.state.metrics.failed(code)
    content = document(code, detail, request.scope.get("root_path", ""), request.url.path)
    return JSONResponse(content, content["status"], headers, media_type=MEDIA_TYPE)


def document(code: str, detail: str, root: str, path: str | None) -> dict[str, Any]:
    """Return the problem document of a code.

    Parameters
    ----------
    code : str
        Key of `MEANINGS`.
    detail : str
    root : str
        Path at which the application is.
    path : str or None
        Of the request, if it was read so far.
    """
    meaning = MEANINGS[code]
    return {
        "type": address(code, root),
        "title": meaning.title,
        "status": meaning.status,
        "code": code,
        "detail": detail,
        "instance": path,
    }
