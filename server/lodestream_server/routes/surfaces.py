"""The routes of surfaces: upload, list, describe, retry, delete."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import AsyncExitStack, nullcontext
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response

from lodestream.stores import AbsentError

from ..access.access import Caller
from ..access.scopes import Reader, Writer
from ..builds import options
from ..operation.threads import in_store
from ..problems import BusyError, FullError, NotOwnerError, TooManyError, responses
from ..store import layout, uploads
from ..store.durable import discard
from ..store.index import Position, Surface
from ..store.layout import Manifest
from . import descriptions, models
from .routing import AnyQuery, Parts, State, described, readable
from .sending import look_for, while_there

__all__ = ["Wait", "base", "description", "keep", "name_of", "owned", "router", "settled"]

router = APIRouter(prefix="/v1/surfaces", tags=["surfaces"])

Thumbnails = Annotated[
    bool, Query(description="add `thumbnail`: a data URL of a PNG of 96 x 72 pixels and less than 4 kB, or null")
]

_JSON = "application/json"

# Bytes after which a page ends.
_MOST_PAGE = 1 << 20

# Where a page begins: when a surface was made, and which.
_PLACE = r"^[0-9]{1,12}(\.[0-9]{1,12})?_[0-9a-f]{20}$"


#: For how long somebody is ready to wait for a build.
Wait = Annotated[
    float, Query(ge=0, le=60, allow_inf_nan=False, description="seconds to wait until the build has ended")
]


@router.post(
    "",
    status_code=202,
    summary="Upload a surface",
    response_description="The surface will be built; Location is its address",
    openapi_extra=descriptions.UPLOAD,
    responses={
        202: descriptions.answer("The surface will be built", models.Surface, location=True),
        200: descriptions.answer("The same surface is there already", models.Surface, location=True),
        **responses(408, 413, 422, 429, 503, 507),
    },
)
async def upload_surface(caller: Writer, request: Request, parts: AnyQuery) -> Response:
    """Upload a file, as a raw body or as parts called ``file`` of a form; the surface is built in the background.

    Options are parameters of the query, or fields of the form. Those other than precision, rms, effort, closed, nodata,
    name and filename are options of the file's format. If the caller has already uploaded the same bytes with the same
    options and name, the answer is the existing surface, even if the server has no room for new ones.

    A container (.lode) is checked and decoded once, and kept unchanged. It takes no options but name and filename.
    """
    query = request.query_params.multi_items()
    filename = options.SurfaceOptions.parse(query).filename  # what is wrong there is told before the body is read
    async with AsyncExitStack() as held:
        try:
            watched = await held.enter_async_context(parts.limits.upload(request, caller))
        except (BusyError, FullError, TooManyError) as refusal:
            if not _perhaps_known(request, parts):
                raise
            watched = await held.enter_async_context(parts.limits.upload(request, caller, stored=False))
            received = await uploads.receive(watched, None, parts.settings, filename)
            known = await in_store(_known, received, _chosen(query, received), caller.owner, parts)
            if known is None:
                raise refusal from None
            surface = known
        else:
            received, surface = await keep(
                lambda folder: uploads.receive(watched, folder, parts.settings, filename), query, caller, parts
            )
    parts.metrics.uploaded(received.size)
    # Whoever finds the surface ready need not come back; otherwise the answer is the same as to a new one.
    return await _located(surface, caller, parts, request)


@readable(
    router,
    "",
    summary="List surfaces",
    responses={
        200: descriptions.answer("A page of surfaces, oldest first", models.SurfacePage),
        304: {"description": "The client has it"},
        **responses(422),
    },
)
async def list_surfaces(
    caller: Reader,
    request: Request,
    parts: Parts,
    limit: Annotated[int, Query(ge=1, le=1000, description="maximum number of surfaces on the page")] = 100,
    after: Annotated[str | None, Query(pattern=_PLACE, description="taken from `next` of the previous page")] = None,
    thumbnails: Thumbnails = False,
) -> Response:
    """Return surfaces without their files, options, layers and levels; `next` is the address of the next page, or null.

    A page may have fewer surfaces than its limit although more follow.
    """
    content = await asyncio.to_thread(_page, _position(after), limit, thumbnails, caller, parts, request)
    return described(request, parts, content)


@readable(
    router,
    "/{surface}",
    summary="Describe a surface",
    responses={
        200: descriptions.answer("Its state and, once it is ready, its description", models.Surface),
        304: {"description": "The client has it"},
        **responses(404, 429, 503),
    },
)
async def get_surface(
    caller: Reader, request: Request, parts: Parts, surface: str, thumbnails: Thumbnails = False, wait: Wait = 0.0
) -> Response:
    """Return the state of a surface and, once it is ready, what ``lodestream info --json`` prints.

    The state is queued, building or ready; or, with a reason, failed (the file is not a surface) or waiting (it could
    not be built and needs a retry). A surface that is queued with a reason is tried again by itself.

    If it failed because its file has several surfaces, `choices` has the options that choose one, which an upload of
    the file then has in its query: `{"options": {"variable": "Te0"}, "shape": [68, 64]}`. `shape` is empty where it is
    not known. There may be more; the reason names them.

    A surface that was uploaded as a container also has `errors`: `checked` if the server has measured the errors of its
    layers and levels again, which is possible if it is exact; otherwise `told`, by whoever uploaded it.

    A surface that a name has replaced has `replaced_until`: then the server deletes it, unless a name leads to it again
    or it is uploaded again.

    With `wait` the answer comes when the surface is neither queued nor building any more, or after so many seconds.
    """
    await settled(request, parts, caller, surface, wait)
    found = parts.surfaces.get(surface)
    return described(request, parts, await description(found, caller, parts, request, thumbnails=thumbnails))


@router.post(
    "/{surface}/retry",
    status_code=202,
    summary="Retry the build of a surface",
    response_description="The surface will be built",
    responses={
        202: descriptions.answer("The surface will be built", models.Surface, location=True),
        200: descriptions.answer("The surface is ready", models.Surface, location=True),
        **responses(403, 404, 429, 503, 507),
    },
)
async def retry_surface(caller: Writer, request: Request, parts: Parts, surface: str) -> Response:
    """Build a surface again that waits or failed; does nothing if it is ready or queued.

    Only its owner (the name of the token that it was uploaded with) and an admin may do this.
    """
    known = _changeable(caller, parts, surface)
    # Until the build counts by itself: others that are asked for meanwhile find it counted.
    with parts.limits.builds.take(caller) if known.state in ("failed", "waiting") else nullcontext():
        retried = await parts.builder.retry(surface, caller.key)
    return await _located(retried, caller, parts, request)


@router.delete("/{surface}", status_code=204, summary="Delete a surface", responses=responses(403, 404))
async def delete_surface(caller: Writer, parts: Parts, surface: str) -> Response:
    """Delete a surface and stop its build. Open streams of it continue to their end.

    Only its owner (the name of the token that it was uploaded with) and an admin may do this.
    """
    known = _changeable(caller, parts, surface)
    await parts.builder.delete(surface)
    parts.upkeep.forget_levels(known)
    return Response(status_code=204)


def _changeable(caller: Caller, parts: State, surface: str) -> Surface:
    """Return a surface that the caller may change.

    Raises
    ------
    NotFoundError
        If there is no such surface.
    NotOwnerError
        If the caller is neither its owner nor an admin.
    """
    found = parts.surfaces.get(surface)
    owner = found.manifest.owner
    if not caller.may_change(owner):
        whose = "nobody" if owner is None else "another owner"
        raise NotOwnerError(
            f"Only its owner and an admin may change {surface}: it belongs to {whose}, and you are {caller.name}"
        )
    return found


def _chosen(query: Sequence[tuple[str, str]], received: uploads.Upload) -> options.SurfaceOptions:
    """Return the options of an upload: those of the query and those of the form."""
    return options.SurfaceOptions.parse([*query, *received.options])


async def keep(
    receive: Callable[[Path], Awaitable[uploads.Upload]], query: Sequence[tuple[str, str]], caller: Caller, parts: State
) -> tuple[uploads.Upload, Surface]:
    """Make a surface of what `receive` puts into the folder that it is given; return both.

    Raises
    ------
    InputError
        If no surface can be made of it.
    BusyError, StoreError
        If it cannot be kept now.
    """
    try:
        folder = await asyncio.to_thread(parts.data.new_upload)
        try:
            received = await receive(folder)
            manifest = await asyncio.to_thread(_manifest, received, _chosen(query, received), caller.owner, parts)
        except BaseException:
            await asyncio.to_thread(discard, folder)
            raise
        return received, await parts.builder.accept(manifest, received.paths, folder, caller.key)
    except FileNotFoundError as error:
        raise BusyError("The server's scratch folder was removed meanwhile; send the upload again") from error


def _perhaps_known(request: Request, parts: State) -> bool:
    """Return whether an upload of this size may be stored already: without room, no other body is read."""
    length = request.headers.get("content-length", "")
    size = int(length) if length.isascii() and length.isdecimal() and len(length) < 19 else None
    form = request.headers.get("content-type", "").startswith("multipart/")
    return parts.surfaces.index.has_size(None if form else size)


def _known(received: uploads.Upload, chosen: options.SurfaceOptions, owner: str | None, parts: State) -> Surface | None:
    """Return the existing surface of this upload, of which only the hash was kept; else None."""
    other = parts.surfaces.index.one_of_upload(received.digest.hexdigest())
    if other is None:
        return None
    try:
        with parts.surfaces.upload(other) as files:
            # The same bytes, so they say the same of their format.
            id_, _ = _identify(received, files, chosen, owner, parts)
    except AbsentError:  # deleted since, or lost
        return None
    parts.surfaces.names.keep(id_)
    found = parts.surfaces.index.find(id_)
    return found if found is not None and found.state in ("queued", "building", "ready") else None


def _identify(
    received: uploads.Upload, files: list[Path], chosen: options.SurfaceOptions, owner: str | None, parts: State
) -> tuple[str, list[str | None]]:
    names = [options.plain_name(name or "") for name in received.names]
    format_ = options.check(files, names, chosen, parts.settings.formats)
    return options.identify(received.digest, format_, names[0], chosen, owner), names


def _manifest(received: uploads.Upload, chosen: options.SurfaceOptions, owner: str | None, parts: State) -> Manifest:
    surface, names = _identify(received, received.paths, chosen, owner, parts)
    return Manifest(
        id=surface,
        name=chosen.name,
        owner=owner,
        created=time.time(),
        filenames=tuple(name or "" for name in names),
        options=chosen.chosen,
        upload=received.digest.hexdigest(),
        upload_bytes=received.size,
        write=layout.new_write(),
    )


async def settled(request: Request, parts: State, caller: Caller, surface: str, seconds: float) -> None:
    """Wait until the build of a surface has ended, the client is gone, or so many seconds are over.

    Of a server that does not write, the surface is looked for in the bucket before that.

    Raises
    ------
    NotFoundError
        If there is no such surface.
    TooManyError, BusyError
        If the caller, or all together, have as many requests that wait as allowed.
    StoreError, BusyError
        See `look_for`.
    """
    await look_for(parts, surface)
    if seconds and parts.surfaces.get(surface).state in ("queued", "building"):
        with parts.limits.waits.take(caller):
            await while_there(request, parts.builder.settled(surface, seconds), lambda _: None)


async def _located(surface: Surface, caller: Caller, parts: State, request: Request) -> Response:
    """Return the answer to somebody who asked for the build of a surface: 202 unless it is ready, with its address."""
    content = await description(surface, caller, parts, request)
    place = {"location": f"{base(request)}/{surface.id}"}
    return Response(content, 200 if surface.state == "ready" else 202, place, media_type=_JSON)


async def description(
    surface: Surface, caller: Caller, parts: State, request: Request, *, thumbnails: bool = False
) -> bytes:
    """Return all that is told of a surface, as JSON."""
    head = _told(surface, caller, parts, request, thumbnails=thumbnails)
    head["filenames"] = list(surface.manifest.filenames)
    head["options"] = surface.manifest.options
    until = parts.surfaces.index.replaced_until(surface.id)
    if until is not None:
        head["replaced_until"] = datetime.fromtimestamp(until, UTC).isoformat(timespec="milliseconds")
    # What was built is described by bytes of the store, which may be many.
    return await parts.following.answer(in_store(_joined, parts, surface, head))


def _joined(parts: State, surface: Surface, head: dict[str, Any]) -> bytes:
    """Return a JSON object with what is told of a surface, and the description of its container as it was stored."""
    start = _json({key: value for key, value in head.items() if key not in surface.summary.shown})
    info = parts.surfaces.info(surface) if surface.state in ("ready", "failed") else b"{}"
    return start if info == b"{}" else start[:-1] + b", " + info[1:]


def _page(start: Position, limit: int, thumbnails: bool, caller: Caller, parts: State, request: Request) -> bytes:
    """Return a page of surfaces that come after a position, as JSON of at most about `_MOST_PAGE` bytes."""
    following = parts.surfaces.index.page(start, limit + 1)
    shown, size = list[bytes](), 0
    for surface in following[:limit]:
        shown.append(_json(_told(surface, caller, parts, request, thumbnails=thumbnails)))
        size += len(shown[-1])
        if size > _MOST_PAGE:
            break
    address = None
    if len(shown) < len(following):
        created, id_ = following[len(shown) - 1].position
        address = f"{base(request)}?limit={limit}&after={created!r}_{id_}{'&thumbnails=true' * thumbnails}"
    return b'{"surfaces": [' + b", ".join(shown) + b'], "next": ' + _json(address) + b"}"


def _told(
    surface: Surface, caller: Caller, parts: State, request: Request, *, thumbnails: bool = False
) -> dict[str, Any]:
    """Return what a list tells of a surface."""
    it, ready = surface.manifest, surface.state == "ready"
    return {
        "id": surface.id,
        "url": f"{base(request)}/{surface.id}",
        "name": name_of(surface),
        **owned(it.owner, caller),
        "state": surface.state,
        "progress": parts.builder.progress(surface),
        "reason": surface.reason,
        "created": datetime.fromtimestamp(it.created, UTC).isoformat(timespec="milliseconds"),
        "upload_bytes": it.upload_bytes,
        "container_sha256": surface.container if ready else None,
        # What is built again has the figures of the container that was lost.
        **(surface.summary.shown if ready else {}),
        **({"thumbnail": _address(surface.summary.thumbnail if ready else None)} if thumbnails else {}),
    }


def name_of(surface: Surface) -> str | None:
    """Return what people call a surface: as its upload says, else its file's contents, else the file's name."""
    it = surface.manifest
    return it.name or options.printable(surface.summary.name or "") or next(filter(None, it.filenames), None)


def _address(thumbnail: str | None) -> str | None:
    return None if thumbnail is None else f"data:image/png;base64,{thumbnail}"


def _json(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False, allow_nan=False).encode()


def owned(owner: str | None, caller: Caller) -> dict[str, Any]:
    """Return what is told of an owner: the names of tokens are told to those who have one."""
    return {"owner": owner} if caller.admin or caller.owner is not None else {}


def base(request: Request) -> str:
    """Return the path of the collection of surfaces."""
    # A path, not an address: behind a proxy only the client knows the host's name.
    return f"{request.scope.get('root_path', '')}{router.prefix}"


def _position(after: str | None) -> Position:
    if after is None:
        return (float("-inf"), "")
    created, _, surface = after.partition("_")
    return (float(created), surface)
