"""Errors as HTTP answers: one table from exception classes to statuses, and problem documents (RFC 9457)."""

from __future__ import annotations

import errno
import http
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from fastapi import FastAPI, Request
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
)

__all__ = [
    "PROBLEM_EXAMPLE",
    "BadTokenError",
    "BuildFailedError",
    "BusyError",
    "DamagedNameError",
    "ForeignOriginError",
    "FullError",
    "LargeLevelError",
    "NoTokenError",
    "NotOwnerError",
    "NotReadyError",
    "PostponedError",
    "RestartingError",
    "SlowUploadError",
    "SmallScopeError",
    "TooManyError",
    "UnfitLevelError",
    "answer",
    "install",
    "problem",
    "refused",
    "responses",
]

_log = logging.getLogger(__name__)
_MEDIA_TYPE = "application/problem+json"


class NotReadyError(LodestreamError):
    """The surface is still being built."""

    headers: ClassVar = {"retry-after": "1"}


class LargeLevelError(TooLargeError):
    """A level takes more memory, time or bytes as a file than the server gives it."""


class UnfitLevelError(FormatError):
    """A level cannot be written in the format asked for."""


class BuildFailedError(LodestreamError):
    """The surface could not be built."""


class PostponedError(LodestreamError):
    """The surface could not be built for a reason that may pass; it waits for a retry."""


class NotOwnerError(LodestreamError):
    """The surface, or the name, belongs to another owner."""


class DamagedNameError(LodestreamError):
    """What is stored of a name cannot be read."""


class SlowUploadError(LodestreamError):
    """An upload was too slow, or stopped."""


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


class TooManyError(LodestreamError):
    """One client has as much in progress as allowed."""

    headers: ClassVar = {"retry-after": "5"}


class BusyError(LodestreamError):
    """The server has as much in progress as it can handle."""

    headers: ClassVar = {"retry-after": "10"}


class RestartingError(LodestreamError):
    """The server is ending and will be back."""

    headers: ClassVar = {"retry-after": "5"}


class FullError(LodestreamError):
    """There is no room for more surfaces."""

    headers: ClassVar = {"retry-after": "60"}


@dataclass(frozen=True)
class _Answer:
    status: int
    code: str
    title: str


_FULL = _Answer(507, "disk-full", "The disk is full")

#: The first row whose class fits says what is answered. The codes of streams (`lodestream.protocol.messages.CODES`) are
#: the same words where they mean the same.
_ANSWERS: tuple[tuple[type[Exception], _Answer], ...] = (
    (LargeLevelError, _Answer(413, "too-large", "The level is too large to be made as a file")),
    (TooLargeError, _Answer(413, "too-large", "The request is too large")),
    (OptionError, _Answer(422, "bad-option", "An option does not exist, or its value is not valid")),
    (UnfitLevelError, _Answer(422, "bad-file", "The level cannot be written in this format")),
    (FormatError, _Answer(422, "bad-file", "The file cannot be read as a structured surface")),
    (InputError, _Answer(422, "bad-input", "The input cannot be used")),
    (UnavailableError, _Answer(501, "unavailable", "This server lacks a library that this needs")),
    (NotFoundError, _Answer(404, "not-found", "There is no such thing")),
    (SlowUploadError, _Answer(408, "idle", "The client was too slow")),
    (NoTokenError, _Answer(401, "no-token", "A token is needed")),
    (BadTokenError, _Answer(401, "bad-token", "The token is unknown, expired or revoked")),
    (SmallScopeError, _Answer(403, "small-scope", "The token's scope does not allow this")),
    (NotOwnerError, _Answer(403, "not-owner", "Only its owner and an admin may do this")),
    (ForeignOriginError, _Answer(403, "foreign-origin", "Pages of other sites may not do this")),
    (TooManyError, _Answer(429, "too-many", "The client has too much in progress")),
    (BusyError, _Answer(503, "busy", "The server is busy; try again later")),
    (RestartingError, _Answer(503, "restarting", "The server is restarting; try again")),
    (FullError, _Answer(507, "full", "There is no space for more")),
    (NotReadyError, _Answer(409, "not-ready", "The surface is still being built")),
    (BuildFailedError, _Answer(424, "failed", "The surface could not be built")),
    (PostponedError, _Answer(424, "waiting", "The surface could not be built yet; it waits for a retry")),
    (DamagedNameError, _Answer(503, "damaged-name", "It cannot be read where the name leads")),
    (stores.FullError, _FULL),
    (stores.UnacknowledgedError, _Answer(503, "busy", "It is not known whether that was done; try again")),
    (stores.StoreError, _Answer(503, "busy", "The server's store cannot be used now; try again later")),
    (StreamError, _Answer(500, "damaged", "The stored container is damaged")),
)
_INTERNAL = _Answer(500, "internal", "The server failed")
_NO_ROOM, _SEE_LOG = "nothing was stored; delete surfaces or enlarge the disk", "the server's log says more"

PROBLEM_EXAMPLE = {
    "type": "urn:lodestream:not-found",
    "title": "There is no such thing",
    "status": 404,
    "code": "not-found",
    "detail": "expected the id of a surface on this server, got '0123'",
    "instance": "/v1/surfaces/0123",
}


def install(app: FastAPI) -> None:
    """Answer every error of an application with a problem document."""
    app.add_exception_handler(LodestreamError, _raised)
    app.add_exception_handler(ClientDisconnect, _gone)
    app.add_exception_handler(OSError, _raised)
    app.add_exception_handler(Exception, _raised)
    app.add_exception_handler(HTTPException, refused)
    app.add_exception_handler(RequestValidationError, _invalid)


def problem(error: Exception) -> tuple[int, str, str, str]:
    """Return status, code, title and detail for an exception; an unexpected one reveals nothing about the server."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        error = stores.FullError()
    for kind, answer in _ANSWERS:
        if isinstance(error, kind):
            detail = str(error)
            if isinstance(error, stores.StoreError):  # it says where the data of the server are
                detail = _NO_ROOM if answer is _FULL else _SEE_LOG
            return answer.status, answer.code, answer.title, detail
    return _INTERNAL.status, _INTERNAL.code, _INTERNAL.title, _SEE_LOG


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return OpenAPI responses of routes that answer with these problems."""
    return {
        status: {
            "description": http.HTTPStatus(status).phrase,
            "content": {
                _MEDIA_TYPE: {
                    "schema": {"$ref": "#/components/schemas/Problem"},
                    **({"example": PROBLEM_EXAMPLE} if status == 404 else {}),
                }
            },
        }
        for status in statuses
    }


async def _raised(request: HTTPConnection, error: Exception) -> Response:
    return answer(request, error)


def answer(request: HTTPConnection, error: Exception) -> Response:
    """Return the problem document for an error."""
    status, code, title, detail = problem(error)
    if status >= 500 and not isinstance(error, StreamError):  # whoever found the damage has told of it
        _log.error("%s: %s", request.url.path, error, exc_info=error if status == 500 else None)
    usual = {503: BusyError.headers, 507: FullError.headers}
    headers = getattr(error, "headers", usual.get(status, {}))
    return _document(request, status, code, title, detail, headers)


async def _gone(request: HTTPConnection, error: Exception) -> Response:
    # Nobody is there to read it.
    return _document(request, 400, "gone", "The client disconnected", "the body ended before it was complete", {})


async def refused(request: Request, error: Exception) -> Response:
    """Return the problem document for an error of the framework."""
    assert isinstance(error, HTTPException)
    phrase = http.HTTPStatus(error.status_code).phrase
    code = {404: "not-found", 405: "bad-method"}.get(error.status_code, phrase.lower().replace(" ", "-"))
    detail = error.detail
    if error.status_code == 404 and detail == phrase:
        detail = f"expected a path that /docs lists, got {request.url.path[:100]!r}"
    headers = dict(error.headers or {})
    if error.status_code == 405:
        # The framework names the methods of the first route of this path only.
        headers = {"allow": ", ".join(_methods(request))}
        detail = f"expected one of {headers['allow']}, got {request.method}"
    return _document(request, error.status_code, code, phrase, detail, headers)


def _methods(request: Request) -> list[str]:
    methods = set[str]()
    for routes in request.app.state.routes:
        for route in routes:
            if isinstance(route, Route) and route.path_regex.match(request.url.path):
                methods |= route.methods or set()
    return sorted(methods)


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    places = [(".".join(map(str, item["loc"])), item["msg"]) for item in error.errors()]
    detail = "; ".join(f"{place}: {message}" for place, message in places)
    return _document(request, 422, "bad-option", "A parameter is not valid", detail, {})


def _document(
    request: HTTPConnection, status: int, code: str, title: str, detail: str, headers: Mapping[str, str]
) -> JSONResponse:
    request.app.state.metrics.failed(code)
    content = {
        "type": f"urn:lodestream:{code}",
        "title": title,
        "status": status,
        "code": code,
        "detail": detail,
        "instance": request.url.path,
    }
    return JSONResponse(content, status, headers, media_type=_MEDIA_TYPE)
