"""The routes of surfaces: upload, list, describe, retry, delete."""

from __future__ import annotations

import asyncio
import time
from contextlib import AsyncExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import JSONResponse, Response

from lodestream.container.series import SERIES, place_of

from ..access.access import Caller, anybody
from ..access.gate import caller_of
from ..access.scopes import needs
from ..builds import options
from ..problems import BusyError, FullError, NotOwnerError, TooManyError, responses
from ..storage import uploads
from ..storage.records import Record
from ..store.durable import discard
from . import examples
from .routing import Parts, State, readable
from .sending import ready

__all__ = ["router"]

router = APIRouter(prefix="/v1/surfaces", tags=["surfaces"])

# Where a page begins: when a surface was made, and which.
_PLACE = r"^[0-9]{1,12}(\.[0-9]{1,12})?_[0-9a-f]{20}$"


@router.post(
    "",
    status_code=202,
    summary="Upload a surface",
    response_description="The surface will be built; Location is its address",
    openapi_extra=examples.UPLOAD,
    responses={
        202: examples.answer("The surface will be built", examples.QUEUED, location=True),
        200: examples.answer("The same surface is there already", examples.READY, location=True),
        **responses(408, 413, 422, 429, 503, 507),
    },
)
@needs("write")
async def upload(request: Request, parts: Parts) -> Response:
    """Upload a file, as a raw body or as parts called ``file`` of a form; the surface is built in the background.

    Parameters in the query other than precision, rms, effort, closed, nodata, name and filename are options of the
    file's format. If the caller has already uploaded the same bytes with the same options and name, the answer is the
    existing surface, even if the server has no room for new ones.

    A container (.lode) is checked and decoded once, and kept unchanged. It takes no options but name and filename.
    """
    chosen = options.SurfaceOptions.parse(request.query_params.multi_items())
    caller = _caller(request)
    async with AsyncExitStack() as held:
        try:
            watched = await held.enter_async_context(parts.limits.upload(request, caller))
        except (BusyError, FullError, TooManyError) as refusal:
            if not _perhaps_known(request, parts):
                raise
            watched = await held.enter_async_context(parts.limits.upload(request, caller, stored=False))
            received = await uploads.receive(watched, None, parts.settings, chosen.filename)
            known = await asyncio.to_thread(_known, received, chosen, caller.owner, parts)
            if known is None:
                raise refusal from None
            record = known
        else:
            received, record = await _keep(watched, chosen, caller, parts)
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
@needs("read")
async def page(
    request: Request,
    parts: Parts,
    limit: Annotated[int, Query(ge=1, le=1000, description="maximum number of surfaces on the page")] = 100,
    after: Annotated[str | None, Query(pattern=_PLACE, description="from `next` of the previous page")] = None,
) -> Response:
    """Return surfaces without their layers and levels; `next` is the address of the next page, or null."""
    start = _position(after)
    following = parts.storage.records_after(start, limit + 1)
    shown = following[:limit]
    address = None
    if len(following) > limit:
        address = f"{_base(request)}?limit={limit}&after={shown[-1].created!r}_{shown[-1].id}"
    content = {"surfaces": [_present(record, parts, request, full=False) for record in shown], "next": address}
    return JSONResponse(content)


@readable(
    router,
    "/{surface}",
    summary="Describe a surface",
    responses={
        200: examples.answer("Its state and, once it is ready, its description", examples.READY),
        **responses(404),
    },
)
@needs("read")
async def look(request: Request, parts: Parts, surface: str) -> Response:
    """Return the state of a surface and, once it is ready, what ``lodestream info --json`` prints.

    The state is queued, building or ready; or, with a reason, failed (the file is not a surface), waiting (it could not
    be built and needs a retry) or missing (its files are not on the server's disk now).

    A surface that was uploaded as a container also has `errors`: `checked` if the server has measured the errors of its
    layers and levels again, which is possible if it is exact; otherwise `told`, by whoever uploaded it.
    """
    return JSONResponse(_present(parts.storage.get(surface), parts, request, full=True))


@router.post(
    "/{surface}/retry",
    status_code=202,
    summary="Retry the build of a surface",
    response_description="The surface will be built",
    responses={
        202: examples.answer("The surface will be built", examples.QUEUED, location=True),
        200: examples.answer("The surface is ready", examples.READY, location=True),
        **responses(403, 404, 424, 429, 503),
    },
)
@needs("write")
async def retry(request: Request, parts: Parts, surface: str) -> Response:
    """Build a surface again that waits, failed or is missing; does nothing if it is ready or queued.

    Only its owner (the name of the token that it was uploaded with) and an admin may do this.
    """
    record, caller = _changeable(request, parts, surface)
    if record.state not in ("queued", "ready"):
        parts.limits.check_builds(caller)
    record = await parts.builder.retry(surface, caller.key)
    if record.state in ("missing", "failed"):
        ready(parts, surface)  # says that there is nothing to build it from
    content = _present(record, parts, request, full=True)
    return JSONResponse(content, 200 if content["state"] == "ready" else 202, {"location": content["url"]})


@router.delete("/{surface}", status_code=204, summary="Delete a surface", responses=responses(403, 404))
@needs("write")
async def delete(request: Request, parts: Parts, surface: str) -> Response:
    """Delete a surface and stop its build. Open streams of it continue to their end.

    Only its owner (the name of the token that it was uploaded with) and an admin may do this.
    """
    record, _ = _changeable(request, parts, surface)
    await parts.builder.delete(surface)
    if record.container is not None and not parts.storage.has_container(record.container):
        parts.levels.forget(record.container)
    return Response(status_code=204)


def _changeable(request: Request, parts: State, surface: str) -> tuple[Record, Caller]:
    """Return the record of a surface and the caller, who must be allowed to change it.

    Raises
    ------
    NotFoundError
        If there is no such surface.
    NotOwnerError
        If the caller is neither its owner nor an admin.
    """
    record, caller = parts.storage.get(surface), _caller(request)
    if not caller.may_change(record.owner):
        whose = "nobody" if record.owner is None else "another owner"
        raise NotOwnerError(f"expected the owner of {surface} or an admin, got {caller.name}: it belongs to {whose}")
    return record, caller


def _caller(request: Request) -> Caller:
    return caller_of(request) or anybody(request)


async def _keep(
    request: Request, chosen: options.SurfaceOptions, caller: Caller, parts: State
) -> tuple[uploads.Upload, Record]:
    folder = await asyncio.to_thread(parts.storage.new_upload)
    try:
        received = await uploads.receive(request, folder, parts.settings, chosen.filename)
        record = await asyncio.to_thread(_record, received, chosen, caller.owner, parts)
    except BaseException:
        await asyncio.to_thread(discard, folder)
        raise
    record, _ = await parts.builder.accept(record, folder, caller.key)
    return received, record


def _perhaps_known(request: Request, parts: State) -> bool:
    """Return whether an upload of this size may be stored already: without room, no other body is read."""
    length = request.headers.get("content-length", "")
    size = int(length) if length.isascii() and length.isdecimal() and len(length) < 19 else None
    form = request.headers.get("content-type", "").startswith("multipart/")
    return parts.storage.may_have_upload(size, form=form)


def _known(received: uploads.Upload, chosen: options.SurfaceOptions, owner: str | None, parts: State) -> Record | None:
    """Return the existing surface of this upload, of which only the hash was kept; else None."""
    for record in parts.storage.records_of(received.digest.hexdigest()):
        try:
            # The same bytes, so they say the same of their format.
            surface, _ = _identify(received, parts.storage.upload_files(record), chosen, owner, parts)
        except FileNotFoundError:  # deleted since, or not there now
            continue
        surface_record = parts.storage.find(surface)
        return surface_record if surface_record is not None and surface_record.state in ("queued", "ready") else None
    return None


def _identify(
    received: uploads.Upload, files: list[Path], chosen: options.SurfaceOptions, owner: str | None, parts: State
) -> tuple[str, list[str | None]]:
    names = [options.plain_name(name or "") for name in received.names]
    format_ = options.check(files, names, chosen, parts.settings.formats)
    return options.identify(received.digest, format_, names[0], chosen, owner), names


def _record(received: uploads.Upload, chosen: options.SurfaceOptions, owner: str | None, parts: State) -> Record:
    surface, names = _identify(received, received.paths, chosen, owner, parts)
    return Record(
        id=surface,
        name=chosen.name,
        created=time.time(),
        filenames=tuple(name or "" for name in names),
        upload_bytes=received.size,
        options=chosen.chosen,
        upload_sha256=received.digest.hexdigest(),
        owner=owner,
    )


def _present(record: Record, parts: State, request: Request, *, full: bool) -> dict[str, Any]:
    state, progress = parts.builder.state(record)
    # What is built again has the figures of the container that was lost.
    info = dict(record.info or {}) if state == "ready" else {}
    place = place_of(info.get("metadata") or {})
    if not full:
        info = {key: info[key] for key in ("shape", "closed", "bytes") if key in info}
    if place is not None:
        info[SERIES] = place.told()
    return {
        "id": record.id,
        "url": f"{_base(request)}/{record.id}",
        "name": record.name or options.printable((record.info or {}).get("metadata", {}).get("name") or ""),
        **_owned(record, request),
        "state": state,
        "progress": progress,
        "reason": record.reason,
        "created": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
        "filenames": list(record.filenames),
        "upload_bytes": record.upload_bytes,
        "options": record.options,
        "container": record.container if state == "ready" else None,
        **info,
    }


def _owned(record: Record, request: Request) -> dict[str, Any]:
    # The names of tokens are told to those who have one.
    caller = caller_of(request)
    return {"owner": record.owner} if caller is not None and (caller.admin or caller.owner is not None) else {}


def _base(request: Request) -> str:
    # A path, not an address: behind a proxy only the client knows the host's name.
    return f"{request.scope.get('root_path', '')}{router.prefix}"


def _position(after: str | None) -> tuple[float, str]:
    if after is None:
        return (float("-inf"), "")
    created, _, surface = after.partition("_")
    return (float(created), surface)
