"""The routes of names that stay: each leads to one surface now, and perhaps to another one later."""

from __future__ import annotations

import asyncio
import json
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request
from fastapi.responses import FileResponse, Response
from pydantic import ValidationError

from lodestream.errors import InputError, NotFoundError, TooLargeError

from ..access.access import Caller
from ..access.scopes import READ, Reader, Writer
from ..operation.threads import in_store
from ..problems import SlowUploadError, responses
from ..refusals import fault_of_body
from ..store.index import Named, Surface
from ..store.layout import NAME, name_key
from . import descriptions, files, models
from .routing import Parts, State, described, readable
from .sending import look_for, ready
from .surfaces import Wait, base, description, owned, settled

__all__ = ["leads_to", "router"]

router = APIRouter(prefix="/v1/names", tags=["names"])

_Name = Annotated[
    str, Path(pattern=f"^{NAME}$", description="a letter or a digit, and at most 99 more letters, digits and ._-")
]
# What the body is that makes a name lead to a surface.
_POINTING = '{"surface": ID}, with the id or url of a surface, or null'
_JSON = "application/json"
_LONGEST_BODY = 1024
_DAY = 86400.0


@router.put(
    "/{name}",
    summary="Make a name lead to a surface",
    openapi_extra=descriptions.POINTING,
    responses={
        200: descriptions.answer("It leads to this surface", models.Surface),
        201: descriptions.answer("There was no such name", models.Surface),
        204: {"description": "`surface` is null, and the caller may change the name"},
        **responses(403, 404, 408, 409, 413, 422, 503, 507),
    },
)
async def point_name(caller: Writer, request: Request, parts: Parts, name: _Name) -> Response:
    """Make a name lead to a surface that is ready; the name is made if there is none.

    `surface` is its id, or its `url`. With null nothing is changed, and the answer says whether the caller may.

    A name belongs to whoever made it. Only its owner and an admin may change it, and only to a surface that they may
    delete. What the name led to before is deleted a set time later, if it belongs to the owner of the name and no name
    leads to it then.
    """
    surface, names = await _asked(request, parts), parts.surfaces.names
    new = parts.surfaces.index.find_name(name) is None
    found = None if surface is None else await ready(parts, surface)
    if new:
        await parts.limits.check_owner(caller.owner)
    fits = parts.limits.names(caller)
    if found is None:
        await in_store(names.check, name, caller.may_change, fits)
        return Response(status_code=204)
    keep = _DAY * parts.settings.keep_replaced_days
    await in_store(names.point, name, found.id, caller.owner, caller.may_change, keep, fits)
    content = await description(found, caller, parts, request)
    return Response(content, 201 if new else 200, media_type=_JSON)


@readable(
    router,
    "",
    summary="List names",
    responses={
        200: descriptions.answer("A page of names", models.NamePage),
        304: {"description": "The client has it"},
        **responses(422),
    },
)
async def list_names(
    caller: Reader,
    request: Request,
    parts: Parts,
    limit: Annotated[int, Query(ge=1, le=1000, description="maximum number of names on the page")] = 100,
    after: Annotated[str, Query(pattern=f"^({NAME})?$", description="taken from `next` of the previous page")] = "",
) -> Response:
    """Return names and the address of the surface to which each leads (null: it cannot be read).

    `next` is the address of the next page, or null.
    """
    return described(request, parts, await asyncio.to_thread(_page, after, limit, caller, parts, request))


@readable(
    router,
    "/{name}",
    summary="Describe the surface to which a name leads",
    responses={
        200: descriptions.answer("The surface to which it leads now", models.Surface),
        304: {"description": "The client has it"},
        **responses(404, 422, 429, 503),
    },
)
async def get_name(caller: Reader, request: Request, parts: Parts, name: _Name, wait: Wait = 0.0) -> Response:
    """Return what is told of the surface to which a name leads now; its `url` is that of the surface."""
    await settled(request, parts, caller, (await leads_to(parts, name)).id, wait)
    return described(request, parts, await description(await leads_to(parts, name), caller, parts, request))


@readable(
    router,
    "/{name}/container",
    dependencies=[READ],
    summary="Fetch the container to which a name leads, or ranges of it",
    response_class=FileResponse,
    responses={**files.CONTAINER, **responses(404, 409, 416, 422, 503)},
)
async def get_name_container(request: Request, parts: Parts, name: _Name) -> Response:
    """Return the container of the surface to which a name leads now; another one, with another ETag, later."""
    return await files.container_of(request, parts, await ready(parts, (await leads_to(parts, name)).id))


@router.delete("/{name}", status_code=204, summary="Delete a name", responses=responses(403, 404, 422, 503))
async def delete_name(caller: Writer, parts: Parts, name: _Name) -> Response:
    """Delete a name. The surface to which it leads stays, and so do those that it has replaced.

    Only its owner and an admin may do this.
    """
    await in_store(parts.surfaces.names.delete, name, caller.may_change)
    return Response(status_code=204)


async def _asked(request: Request, parts: State) -> str | None:
    """Return the id of the surface in the body of a request; None if it asks of none."""
    body, seconds = bytearray(), parts.settings.idle_seconds
    try:
        async with asyncio.timeout(seconds):
            async for chunk in request.stream():
                body += chunk
                if len(body) > _LONGEST_BODY:
                    raise TooLargeError(f"The body is longer than the {_LONGEST_BODY} bytes that it may be")
    except TimeoutError:
        raise SlowUploadError(f"The body was not complete within {seconds:g} s") from None
    try:
        surface = models.Pointing.model_validate_json(bytes(body)).surface
    except ValidationError as error:
        raise InputError(fault_of_body(error.errors(include_url=False)[0], _POINTING)) from None
    return None if surface is None else surface.removeprefix(f"{base(request)}/")


async def leads_to(parts: State, name: str) -> Surface:
    """Return the surface to which a name leads.

    Raises
    ------
    NotFoundError
        If there is no such name, or its surface was deleted.
    DamagedNameError
        If it cannot be read.
    StoreError, BusyError
        See `look_for`.
    """
    if not parts.surfaces.writes and parts.surfaces.index.find_name(name) is None:
        await parts.following.look_for(name_key(name))
    leads = parts.surfaces.names.get(name).surface
    if leads is not None:
        await look_for(parts, leads)
    found = None if leads is None else parts.surfaces.index.find(leads)
    if found is None:
        raise NotFoundError(f"The name {name} led to the surface {leads}, which was deleted")
    return found


def _page(after: str, limit: int, caller: Caller, parts: State, request: Request) -> bytes:
    following = parts.surfaces.index.names(after, limit + 1)
    shown = following[:limit]
    address = None
    if len(following) > limit:
        address = f"{_base(request)}?limit={limit}&after={shown[-1].name}"
    return json.dumps({"names": [_told(named, caller, request) for named in shown], "next": address}).encode()


def _told(named: Named, caller: Caller, request: Request) -> dict[str, Any]:
    told = {"name": named.name, "url": f"{_base(request)}/{named.name}"}
    if named.surface is None:
        return {**told, "surface": None}
    return {
        **told,
        "surface": f"{base(request)}/{named.surface}",
        **owned(named.owner, caller),
        "changed": datetime.fromtimestamp(named.changed, UTC).isoformat(timespec="milliseconds"),
    }


def _base(request: Request) -> str:
    return f"{request.scope.get('root_path', '')}{router.prefix}"
