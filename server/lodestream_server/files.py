"""The routes of containers and levels: what is fetched as a file."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator
from typing import Annotated, BinaryIO

from fastapi import APIRouter, Query, Request
from fastapi.responses import FileResponse, RedirectResponse, Response, StreamingResponse

from lodestream.errors import NotFoundError, OptionError

from . import examples
from .levels import MEDIA_TYPES, write_level
from .problems import BuildFailedError, NotReadyError, responses
from .ranges import sort_out
from .records import Record
from .routing import Parts, State, matches, readable

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["files"])

_CHUNK = 64 * 1024


@readable(
    router,
    "/surfaces/{surface}/container",
    status_code=307,
    summary="Find a surface's container",
    response_class=Response,
    responses={307: {"description": "Location is the immutable container"}, **responses(404, 409, 424)},
)
async def find(request: Request, parts: Parts, surface: str) -> Response:
    """Redirect to the container; while it is being built, 409 with Retry-After."""
    record = ready(parts, surface)
    address = f"{request.scope.get('root_path', '')}{router.prefix}/containers/{record.container}.lode"
    return RedirectResponse(address, headers={"cache-control": "no-cache"})


@readable(
    router,
    "/containers/{sha256}.lode",
    summary="Fetch a container, or ranges of it",
    response_class=FileResponse,
    responses={
        200: {"description": "The whole container", "content": {examples.CONTAINER_TYPE: {}}},
        206: {"description": "The range asked for"},
        304: {"description": "The client has it"},
        **responses(404, 416),
    },
)
async def fetch(request: Request, parts: Parts, sha256: str) -> Response:
    """A container never changes: its name is the hash of its content, which is its strong ETag."""
    path = parts.storage.container(sha256)
    etag = f'"{sha256}"'
    # What needs a token must not come out of a shared cache for those who have none.
    shared = "public" if parts.settings.public_reads else "private"
    headers = {"etag": etag, "cache-control": f"{shared}, max-age=31536000, immutable"}
    unchanged = matches(request.headers.get("if-none-match"), etag)
    if unchanged is not None:
        unchanged.headers.update(headers)
        return unchanged
    try:
        status = path.stat()
    except FileNotFoundError:  # deleted since it was looked for
        raise NotFoundError(f"expected the SHA-256 of a container on this server, got {sha256[:80]!a}") from None
    sort_out(request, status.st_size, etag)
    return FileResponse(path, headers=headers, media_type=examples.CONTAINER_TYPE, stat_result=status)


@readable(
    router,
    "/surfaces/{surface}/levels/{level}",
    summary="Fetch one level as a file",
    response_class=Response,
    responses={200: examples.LEVEL, 304: {"description": "The client has it"}, **responses(404, 409, 422, 424, 503)},
)
async def level(
    request: Request,
    parts: Parts,
    surface: str,
    level: int,
    format_name: Annotated[str, Query(alias="format", description=", ".join(MEDIA_TYPES))] = "npy",
) -> Response:
    """The grid of one level, 0 being the coarsest: what ``lodestream decode --level`` writes."""
    record = ready(parts, surface)
    _check(record, level, format_name)
    etag = f'"{record.container}-{level}-{format_name}"'
    headers = {"etag": etag, "cache-control": "no-cache"}
    unchanged = matches(request.headers.get("if-none-match"), etag)
    if unchanged is not None:
        return unchanged
    async with parts.decoding:
        file = await asyncio.to_thread(_cut, parts, record, level, format_name)
    headers["content-length"] = str(os.fstat(file.fileno()).st_size)
    headers["content-disposition"] = f'attachment; filename="{record.id}-{level}.{format_name}"'
    return StreamingResponse(_pieces(file), headers=headers, media_type=MEDIA_TYPES[format_name])


def ready(parts: State, surface: str) -> Record:
    """The record of a surface that has a container.

    Raises
    ------
    NotFoundError
        When there is no such surface.
    NotReadyError, BuildFailedError
        When it has none yet, or never will.
    """
    record = parts.storage.get(surface)
    if record.state == "failed":
        raise BuildFailedError(f"{surface} could not be built: {record.reason}")
    if record.state != "ready":
        state, progress = parts.builder.state(record)
        raise NotReadyError(f"{surface} is {state} ({progress:.0%} done); come back soon")
    return record


def _check(record: Record, level: int, format_name: str) -> None:
    finest = len((record.info or {})["levels"]) - 1
    if not 0 <= level <= finest:
        raise OptionError(f"expected a level of 0 to {finest}, got {level}")
    if format_name not in MEDIA_TYPES:
        raise OptionError(f"expected format to be one of {', '.join(MEDIA_TYPES)}, got {format_name[:80]!a}")


def _cut(parts: State, record: Record, level: int, format_name: str) -> BinaryIO:
    container = parts.containers.open(record.container or "")
    try:
        return write_level(container, level, format_name, parts.storage.temporary)
    finally:
        container.close()


async def _pieces(file: BinaryIO) -> AsyncIterator[bytes]:
    try:
        while piece := await asyncio.to_thread(file.read, _CHUNK):
            yield piece
    finally:
        file.close()
