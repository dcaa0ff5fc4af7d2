"""The routes of resumable uploads: tus 1.0.0 with creation, expiration and termination.

A resumable upload is one file. It ends as any other upload does: its surface is built, and has the same id.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import re
from collections.abc import Callable, Coroutine
from email.utils import formatdate
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request
from fastapi.responses import Response
from fastapi.routing import APIRoute
from starlette.requests import ClientDisconnect

from lodestream.errors import InputError, LodestreamError, NotFoundError, OptionError, TooLargeError

from .. import problems
from ..access.access import Caller
from ..access.scopes import WRITE, Writer
from ..builds import options
from ..problems import WrongTypeError, WrongVersionError, responses
from ..store import layout, uploads
from ..store.partial_uploads import Declared, PartialUpload
from . import descriptions, surfaces
from .routing import AnyQuery, Parts, State

__all__ = ["ANSWER_HEADERS", "REQUEST_HEADERS", "router"]

_VERSION = "1.0.0"
_EXTENSIONS = "creation,expiration,termination"
_TYPE = "application/offset+octet-stream"

#: Headers of requests and answers, which pages of other sites must be allowed to send and see.
REQUEST_HEADERS = (
    *("content-type", "tus-resumable", "upload-length", "upload-metadata", "upload-offset", "x-http-method-override"),
)
ANSWER_HEADERS = (
    *("tus-extension", "tus-max-size", "tus-resumable", "tus-version"),
    *("upload-expires", "upload-length", "upload-metadata", "upload-offset"),
)

_MOST_METADATA = 4096
_SHA256 = re.compile(r"[0-9a-f]{64}")


class _TusRoute(APIRoute):
    """A route whose answers all name the version, refusals among them."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()

        async def answer(request: Request) -> Response:
            try:
                response = await handle(request)
            except (LodestreamError, OSError, ClientDisconnect) as error:
                response = problems.answer(request, error)
            response.headers["tus-resumable"] = _VERSION
            return response

        return answer


router = APIRouter(prefix="/v1/uploads", tags=["resumable uploads"], route_class=_TusRoute)


async def _check_version(request: Request) -> None:
    version = request.headers.get("tus-resumable")
    if version != _VERSION:
        said = "is missing" if version is None else f"says {version[:80]!a}"
        raise WrongVersionError(f"The header Tus-Resumable {said}, and must say {_VERSION}")


#: Behind the scope among the parameters of a route, so that nobody else learns more.
_Tus = Annotated[None, Depends(_check_version)]


@router.options(
    "", status_code=204, dependencies=[WRITE], summary="What resumable uploads can do", response_class=Response
)
async def offer_uploads(parts: Parts) -> Response:
    """Return the version and extensions of the protocol tus that are spoken here, and the size of the largest file."""
    headers = {
        "tus-version": _VERSION,
        "tus-extension": _EXTENSIONS,
        "tus-max-size": str(parts.settings.upload_bytes),
    }
    return Response(status_code=204, headers=headers)


@router.post(
    "",
    status_code=201,
    summary="Begin a resumable upload",
    response_class=Response,
    openapi_extra=descriptions.RESUMABLE,
    responses={
        201: descriptions.headed(
            "It has begun", **{"Location": "the upload", "Upload-Expires": "until when it is kept"}
        ),
        **responses(412, 413, 422, 429, 503, 507),
    },
)
async def begin_upload(caller: Writer, request: Request, parts: AnyQuery, _: _Tus) -> Response:
    """Begin an upload of one file that may be sent in parts, by tus 1.0.0; Location is its address.

    The options of the surface go into the query, as for an upload in one. `Upload-Metadata` may have `filename`,
    `filetype`, which is ignored, and `sha256` of the file in hexadecimal digits: then no other bytes become a surface.
    """
    length = _number(request, "upload-length")
    if not length:
        raise OptionError("The file has 0 bytes")
    if length > parts.settings.upload_bytes:
        raise TooLargeError(f"The upload has {length} bytes, and may have {parts.settings.upload_bytes}")
    declared = _declared(request, caller, length)
    async with parts.limits.upload(request, caller, size=length):
        parts.limits.check_partial(caller, *parts.partial_uploads.count(caller.owner))
        upload = await parts.partial_uploads.create(declared)
    return _told(upload, parts, request, 201, location=f"{_base(request)}/{upload.id}")


@router.head(
    "/{upload}",
    status_code=200,
    summary="How far a resumable upload is",
    response_class=Response,
    openapi_extra=descriptions.VERSIONED,
    responses={
        200: descriptions.headed(
            "So many bytes are on disk",
            **{
                "Upload-Offset": "bytes that are there",
                "Upload-Length": "bytes of the file",
                "Upload-Expires": "until when it is kept",
                "Location": "the surface, once the upload is complete",
            },
        ),
        **responses(404, 412, 503),
    },
)
async def show_upload(caller: Writer, request: Request, parts: Parts, upload: str, _: _Tus) -> Response:
    """Return how many bytes of an upload are there; a request that is still sending it is ended.

    An upload whose last byte came just before the server ended becomes a surface now.
    """
    try:
        it = parts.partial_uploads.get(upload, caller.owner)
    except NotFoundError:
        parts.surfaces.check_writer()  # whoever is told that there is none begins again
        raise
    async with it.settled():
        if it.is_complete and it.declared.surface is None:
            async with parts.limits.upload(request, caller):
                await _finish(it, caller, parts)
        extra = {"upload-metadata": it.declared.metadata} if it.declared.metadata else {}
        return _told(it, parts, request, 200, **{"upload-length": str(it.declared.length), **extra})


@router.patch(
    "/{upload}",
    status_code=204,
    summary="Continue a resumable upload",
    response_class=Response,
    openapi_extra=descriptions.CONTINUED,
    responses={
        204: descriptions.headed(
            "The bytes are on disk",
            **{
                "Upload-Offset": "bytes that are there",
                "Upload-Expires": "until when it is kept",
                "Location": "the surface, once the upload is complete",
            },
        ),
        **responses(404, 408, 409, 412, 413, 415, 422, 423, 429, 503, 507),
    },
)
async def continue_upload(caller: Writer, request: Request, parts: Parts, upload: str, _: _Tus) -> Response:
    """Send the next bytes of an upload. With the last one the surface is made, and Location is its address.

    Bytes that came before the connection broke are kept: ask for the offset (HEAD), and go on there. If the file
    cannot become a surface, the answer says why, and the upload is gone.
    """
    it = parts.partial_uploads.get(upload, caller.owner)
    kind = request.headers.get("content-type", "")
    if kind != _TYPE:
        raise WrongTypeError(f"The body has the type {kind[:80]!a}, and must have {_TYPE}")
    async with it.continued(_number(request, "upload-offset")):
        if it.declared.surface is None:
            missing = it.declared.length - it.offset
            uploads.check_promised(request, missing)
            async with parts.limits.upload(request, caller, is_part=True) as watched:
                await it.append(uploads.blocks(watched, parts.settings, missing))
                if it.is_complete:
                    await _finish(it, caller, parts)
        return _told(it, parts, request, 204)


@router.delete(
    "/{upload}",
    status_code=204,
    summary="Give up a resumable upload",
    response_class=Response,
    openapi_extra=descriptions.VERSIONED,
    responses=responses(404, 412),
)
async def give_up_upload(caller: Writer, parts: Parts, upload: str, _: _Tus) -> Response:
    """End an upload and remove its bytes. The surface of one that is complete stays."""
    it = parts.partial_uploads.get(upload, caller.owner)
    async with it.settled():
        await parts.partial_uploads.remove(it)
    return Response(status_code=204)


@router.post(
    "/{upload}",
    status_code=204,
    summary="Continue a resumable upload, for clients that can send no PATCH",
    response_class=Response,
    openapi_extra=descriptions.OVERRIDDEN,
    responses=responses(404, 408, 409, 412, 413, 415, 422, 423, 429, 503, 507),
)
async def override_method(caller: Writer, request: Request, parts: Parts, upload: str, _: _Tus) -> Response:
    """Answer as for the method in X-HTTP-Method-Override, for clients that can send no other than POST."""
    method = request.headers.get("x-http-method-override", "")
    if method == "PATCH":
        return await continue_upload(caller, request, parts, upload, None)
    if method == "HEAD":
        return await show_upload(caller, request, parts, upload, None)
    if method == "DELETE":
        return await give_up_upload(caller, parts, upload, None)
    raise OptionError(f"X-HTTP-Method-Override may be PATCH, HEAD or DELETE, and is {method[:80]!a}")


async def _finish(upload: PartialUpload, caller: Caller, parts: State) -> None:
    """Make a surface of a complete upload, which is held; one that cannot become a surface is removed."""
    try:
        received, surface = await surfaces.keep(
            lambda folder: asyncio.to_thread(upload.whole, folder), upload.declared.query, caller, parts
        )
    except InputError:
        await parts.partial_uploads.remove(upload)
        raise
    parts.metrics.uploaded(received.size)
    await upload.finish(surface.id)


def _declared(request: Request, caller: Caller, length: int) -> Declared:
    query = tuple(request.query_params.multi_items())
    chosen = options.SurfaceOptions.parse(query)
    metadata = request.headers.get("upload-metadata", "")
    said = _metadata(metadata)
    sha256 = said.get("sha256")
    if sha256 is not None and not _SHA256.fullmatch(sha256):
        raise OptionError(f"The sha256 in Upload-Metadata is no 64 digits of 0-9 and a-f: {sha256[:80]!a}")
    filename = chosen.filename or options.plain_name(said.get("filename", ""))
    layout.check_text(chosen.name, [filename or ""], chosen.chosen)
    return Declared(caller.owner, length, query, filename, sha256, metadata)


def _metadata(header: str) -> dict[str, str]:
    """Return the keys and values of the header Upload-Metadata.

    Raises
    ------
    OptionError
        If it cannot be read, or has other keys than a file's.
    """
    if len(header) > _MOST_METADATA:
        raise OptionError(f"Upload-Metadata has {len(header)} bytes, and may have {_MOST_METADATA}")
    found = dict[str, str]()
    for pair in filter(None, (part.strip() for part in header.split(","))):
        key, _, value = pair.partition(" ")
        if key not in ("filename", "filetype", "sha256") or key in found:
            raise OptionError(
                "Upload-Metadata may have filename, filetype and sha256, each once (options go into the query), and "
                f"has {key[:80]!a}"
            )
        try:
            found[key] = base64.b64decode(value.strip(), validate=True).decode()
        except (binascii.Error, UnicodeDecodeError):
            raise OptionError(f"The {key} in Upload-Metadata is no Base64 of UTF-8: {value[:80]!a}") from None
    return found


def _number(request: Request, header: str) -> int:
    text = request.headers.get(header, "")
    if not text:
        raise OptionError(f"The header {header.title()} is missing: it is a number of bytes")
    if not (text.isascii() and text.isdecimal() and len(text) < 19):
        raise OptionError(f"The header {header.title()} is no number of bytes: {text[:80]!a}")
    return int(text)


def _told(upload: PartialUpload, parts: State, request: Request, status: int, **headers: str) -> Response:
    """Return an answer that says how far an upload is."""
    told = {"upload-offset": str(upload.offset), "cache-control": "no-store", **headers}
    if upload.declared.surface is not None:
        told["location"] = f"{surfaces.base(request)}/{upload.declared.surface}"
    else:
        told["upload-expires"] = formatdate(parts.partial_uploads.expires(upload), usegmt=True)
    return Response(status_code=status, headers=told)


def _base(request: Request) -> str:
    return f"{request.scope.get('root_path', '')}{router.prefix}"
