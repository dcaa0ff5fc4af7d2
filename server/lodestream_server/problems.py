"""Errors as answers: one table from classes to statuses, and problem documents (RFC 9457) made from it."""

from __future__ import annotations

import errno
import http
import logging
from dataclasses import dataclass
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, Response
from starlette.exceptions import HTTPException
from starlette.routing import Route

from lodestream.errors import (
    FormatError,
    InputError,
    LodestreamError,
    NotFoundError,
    OptionError,
    StreamError,
    TooLargeError,
)

__all__ = ["PROBLEM_EXAMPLE", "BuildFailedError", "NotReadyError", "SlowUploadError", "install", "problem", "responses"]

_log = logging.getLogger(__name__)
_MEDIA_TYPE = "application/problem+json"
_RETRY_SECONDS = 1


class NotReadyError(LodestreamError):
    """The surface is still being built."""


class BuildFailedError(LodestreamError):
    """The surface could not be built."""


class SlowUploadError(LodestreamError):
    """Nothing came of an upload for too long."""


@dataclass(frozen=True)
class _Answer:
    status: int
    code: str
    title: str


#: The first row whose class fits says what is answered. The codes of streams (`lodestream.messages.CODES`) are the same
#: words where they mean the same.
_ANSWERS: tuple[tuple[type[Exception], _Answer], ...] = (
    (TooLargeError, _Answer(413, "too-large", "More than is allowed")),
    (OptionError, _Answer(422, "bad-option", "An option that does not exist, or a value that it does not take")),
    (FormatError, _Answer(422, "bad-file", "Not a file of a structured surface")),
    (InputError, _Answer(422, "bad-input", "Input that cannot be used")),
    (NotFoundError, _Answer(404, "not-found", "There is no such thing")),
    (SlowUploadError, _Answer(408, "idle", "Nothing was heard for too long")),
    (NotReadyError, _Answer(409, "not-ready", "The surface is still being built")),
    (BuildFailedError, _Answer(424, "failed", "The surface could not be built")),
    (StreamError, _Answer(500, "damaged", "The stored container is damaged")),
)
_FULL = _Answer(507, "disk-full", "The disk is full")
_INTERNAL = _Answer(500, "internal", "The server failed")

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
    app.add_exception_handler(OSError, _raised)
    app.add_exception_handler(Exception, _raised)
    app.add_exception_handler(HTTPException, _refused)
    app.add_exception_handler(RequestValidationError, _invalid)


def problem(error: Exception) -> tuple[int, str, str, str]:
    """Status, code, title and detail for an error; an unforeseen one tells nothing of the server's inside."""
    for kind, answer in _ANSWERS:
        if isinstance(error, kind):
            return answer.status, answer.code, answer.title, str(error)
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return _FULL.status, _FULL.code, _FULL.title, "nothing was stored; remove surfaces or enlarge the disk"
    return _INTERNAL.status, _INTERNAL.code, _INTERNAL.title, "the server's log says more"


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """What OpenAPI says of routes that answer with these problems."""
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


async def _raised(request: Request, error: Exception) -> Response:
    status, code, title, detail = problem(error)
    if status >= 500:
        _log.error("%s %s: %s", request.method, request.url.path, error, exc_info=error)
    headers = {"retry-after": str(_RETRY_SECONDS)} if isinstance(error, NotReadyError) else {}
    return _document(request, status, code, title, detail, headers)


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    phrase = http.HTTPStatus(error.status_code).phrase
    code = {404: "not-found", 405: "bad-method"}.get(error.status_code, phrase.lower().replace(" ", "-"))
    detail = error.detail
    if error.status_code == 404 and detail == phrase:
        detail = "expected a path that /docs lists"
    headers = dict(error.headers or {})
    if error.status_code == 405:
        # The framework names the methods of the first route of this path only.
        headers = {"allow": ", ".join(_methods(request))}
        detail = f"expected one of {headers['allow']}, got {request.method}"
    return _document(request, error.status_code, code, phrase, detail, headers)


def _methods(request: Request) -> list[str]:
    found = set[str]()
    for routes in request.app.state.routes:
        for route in routes:
            if isinstance(route, Route) and route.path_regex.match(request.url.path):
                found |= route.methods or set()
    return sorted(found)


async def _invalid(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    places = [(".".join(map(str, item["loc"])), item["msg"]) for item in error.errors()]
    detail = "; ".join(f"{place}: {message}" for place, message in places)
    return _document(request, 422, "bad-option", "A parameter that cannot be used", detail, {})


def _document(
    request: Request, status: int, code: str, title: str, detail: str, headers: dict[str, str]
) -> JSONResponse:
    content = {
        "type": f"urn:lodestream:{code}",
        "title": title,
        "status": status,
        "code": code,
        "detail": detail,
        "instance": request.url.path,
    }
    return JSONResponse(content, status, headers, media_type=_MEDIA_TYPE)
