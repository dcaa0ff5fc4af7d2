"""The routes of surfaces: upload, list, look, delete."""

from __future__ import annotations

import asyncio
import time
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import JSONResponse, Response

from . import examples, options, uploads
from .durable import remove
from .problems import responses
from .records import Record
from .routing import Parts, State, readable

__all__ = ["router"]

router = APIRouter(prefix="/v1/surfaces", tags=["surfaces"])

# Where a page begins: when a surface was made, and which.
_PLACE = r"^[0-9]{1,12}(\.[0-9]{1,12})?_[0-9a-f]{20}$"


@router.post(
    "",
    status_code=202,
    summary="Upload a surface",
    response_description="The surface will be built; Location is where to look",
    openapi_extra=examples.UPLOAD,
    responses={
        202: examples.answer("The surface will be built", examples.QUEUED, location=True),
        200: examples.answer("The same surface is there already", examples.READY, location=True),
        **responses(408, 413, 422, 503, 507),
    },
)
async def upload(request: Request, parts: Parts) -> Response:
    """Take a file, raw or as parts called ``file`` of a form, and build the surface in the background.

    What is neither precision, closed, name nor filename in the query is an option of the file's format. Bytes and
    options that are known already give the surface that is there.
    """
    chosen = options.SurfaceOptions.parse(request.query_params.multi_items())
    async with parts.limits.upload(request) as watched:
        folder = await asyncio.to_thread(parts.storage.new_upload)
        try:
            received = await uploads.receive(watched, folder, parts.settings, chosen.filename)
            record = await asyncio.to_thread(_record, received, chosen, parts)
            record, _ = await parts.builder.accept(record, folder)
        finally:
            await asyncio.to_thread(remove, folder)
    parts.metrics.uploaded(received.size)
    content = _present(record, parts, request, full=True)
    # Whoever finds the surface ready need not come back; otherwise the answer is the same as to a new one.
    status = 200 if content["state"] == "ready" else 202
    return JSONResponse(content, status, {"location": content["url"]})


@readable(
    router,
    "",
    summary="List surfaces",
    responses={200: examples.answer("A page of surfaces, oldest first", examples.PAGE), **responses(422)},
)
async def page(
    request: Request,
    parts: Parts,
    limit: Annotated[int, Query(ge=1, le=1000, description="most surfaces on the page")] = 100,
    after: Annotated[str | None, Query(pattern=_PLACE, description="as `next` of the page before says")] = None,
) -> Response:
    """Surfaces without the figures of their layers and levels; `next` is the address of the following page, or null."""
    start = _position(after)
    following = [record for record in parts.storage.records() if (record.created, record.id) > start]
    shown = following[:limit]
    address = None
    if len(following) > limit:
        address = f"{_base(request)}?limit={limit}&after={shown[-1].created!r}_{shown[-1].id}"
    content = {"surfaces": [_present(record, parts, request, full=False) for record in shown], "next": address}
    return JSONResponse(content)


@readable(
    router,
    "/{surface}",
    summary="Look at a surface",
    responses={200: examples.answer("State, and once ready the figures", examples.READY), **responses(404)},
)
async def look(request: Request, parts: Parts, surface: str) -> Response:
    """State (queued, building, ready, failed with a reason), and once ready what ``lodestream info --json`` prints."""
    return JSONResponse(_present(parts.storage.get(surface), parts, request, full=True))


@router.delete("/{surface}", status_code=204, summary="Delete a surface", responses=responses(404))
async def delete(parts: Parts, surface: str) -> Response:
    """Remove a surface; its build is stopped. Streams of it that are open go on to their end."""
    await parts.builder.delete(surface)
    return Response(status_code=204)


def _record(received: uploads.Upload, chosen: options.SurfaceOptions, parts: State) -> Record:
    names = [options.plain_name(name or "") for name in received.names]
    format_ = options.check(received.paths, names, chosen)
    return Record(
        id=options.identify(received.digest, format_, names[0], chosen),
        name=chosen.name,
        created=time.time(),
        filenames=tuple(name or "" for name in names),
        upload_bytes=received.size,
        options=chosen.chosen,
        upload_sha256=received.digest.hexdigest(),
    )


def _present(record: Record, parts: State, request: Request, *, full: bool) -> dict[str, Any]:
    state, progress = parts.builder.state(record)
    info = dict(record.info or {})
    if not full:
        info = {key: info[key] for key in ("shape", "closed", "bytes") if key in info}
    return {
        "id": record.id,
        "url": f"{_base(request)}/{record.id}",
        "name": record.name or (record.info or {}).get("metadata", {}).get("name"),
        "state": state,
        "progress": progress,
        "reason": record.reason,
        "created": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
        "filenames": list(record.filenames),
        "upload_bytes": record.upload_bytes,
        "options": record.options,
        "container": record.container,
        **info,
    }


def _base(request: Request) -> str:
    # A path, not an address: behind a proxy only the client knows the host's name.
    return f"{request.scope.get('root_path', '')}{router.prefix}"


def _position(after: str | None) -> tuple[float, str]:
    if after is None:
        return (float("-inf"), "")
    created, _, surface = after.partition("_")
    return (float(created), surface)
