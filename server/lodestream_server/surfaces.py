"""The routes of surfaces: upload, list, look, delete."""

from __future__ import annotations

import asyncio
import time
from contextlib import AsyncExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import JSONResponse, Response

from . import examples, options, uploads
from .durable import remove
from .problems import BusyError, FullError, responses
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

    What is neither precision, rms, closed, name nor filename in the query is an option of the file's format. Bytes and
    options that are known already give the surface that is there, even where there is no room for others.
    """
    chosen = options.SurfaceOptions.parse(request.query_params.multi_items())
    async with AsyncExitStack() as held:
        try:
            watched = await held.enter_async_context(parts.limits.upload(request))
        except (BusyError, FullError) as refusal:
            if not _perhaps_known(request, parts):
                raise
            watched = await held.enter_async_context(parts.limits.upload(request, stored=False))
            received = await uploads.receive(watched, None, parts.settings, chosen.filename)
            known = await asyncio.to_thread(_known, received, chosen, parts)
            if known is None:
                raise refusal from None
            record = known
        else:
            received, record = await _keep(watched, chosen, parts)
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


async def _keep(request: Request, chosen: options.SurfaceOptions, parts: State) -> tuple[uploads.Upload, Record]:
    folder = await asyncio.to_thread(parts.storage.new_upload)
    try:
        received = await uploads.receive(request, folder, parts.settings, chosen.filename)
        record = await asyncio.to_thread(_record, received, chosen)
        record, _ = await parts.builder.accept(record, folder)
    finally:
        await asyncio.to_thread(remove, folder)
    return received, record


def _perhaps_known(request: Request, parts: State) -> bool:
    """Whether an upload of this size may be there already: where there is no room, no other body is read."""
    said = request.headers.get("content-length", "")
    size = int(said) if said.isascii() and said.isdecimal() and len(said) < 19 else None
    form = request.headers.get("content-type", "").startswith("multipart/")
    return any(
        size is None or record.upload_bytes == size or (form and record.upload_bytes < size)
        for record in parts.storage.records()
        if record.state != "failed"
    )


def _known(received: uploads.Upload, chosen: options.SurfaceOptions, parts: State) -> Record | None:
    """The surface that this upload, of which only the hash was kept, has made already."""
    digest = received.digest.hexdigest()
    for record in parts.storage.records():
        if record.upload_sha256 == digest and record.state != "failed":
            try:
                # The same bytes, so they say the same of their format.
                surface, _ = _identify(received, parts.storage.upload_files(record), chosen)
            except FileNotFoundError:  # deleted since
                continue
            found = parts.storage.find(surface)
            return found if found is not None and found.state != "failed" else None
    return None


def _identify(
    received: uploads.Upload, files: list[Path], chosen: options.SurfaceOptions
) -> tuple[str, list[str | None]]:
    names = [options.plain_name(name or "") for name in received.names]
    format_ = options.check(files, names, chosen)
    return options.identify(received.digest, format_, names[0], chosen), names


def _record(received: uploads.Upload, chosen: options.SurfaceOptions) -> Record:
    surface, names = _identify(received, received.paths, chosen)
    return Record(
        id=surface,
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
