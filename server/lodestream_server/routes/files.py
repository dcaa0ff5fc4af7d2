"""The routes of containers, which are fetched as files."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request
from fastapi.responses import FileResponse, Response
from starlette.types import Receive, Scope, Send

from lodestream.stores import AbsentError, Blob

from ..access.scopes import READ
from ..operation.threads import in_store
from ..problems import BusyError, responses
from ..store.containers import Containers
from ..store.index import Surface
from ..store.layout import CHANGES
from . import descriptions
from .byte_ranges import sort_out
from .routing import Parts, State, caching, matches, readable
from .sending import SentBlob, SentFile, ready, still_there

__all__ = ["CONTAINER", "container_of", "router"]

router = APIRouter(prefix="/v1", tags=["files"])


#: What OpenAPI says of answers with a container.
CONTAINER: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The whole container",
        "content": {descriptions.CONTAINER_TYPE: {"schema": descriptions.BINARY}},
    },
    206: {"description": "The range asked for"},
    304: {"description": "The client has it"},
}


@readable(
    router,
    "/surfaces/{surface}/container",
    dependencies=[READ],
    summary="Fetch the container of a surface, or ranges of it",
    response_class=FileResponse,
    responses={**CONTAINER, **responses(404, 409, 416, 503)},
)
async def get_surface_container(request: Request, parts: Parts, surface: str) -> Response:
    """Return the container of a surface; 409 with Retry-After while it is being built.

    Its strong ETag is the SHA-256 of its contents. Content-Location is its own address, where it may be kept for ever.
    """
    return await container_of(request, parts, await ready(parts, surface))


async def container_of(request: Request, parts: State, surface: Surface) -> Response:
    """Return an answer with the container of a surface that is ready, as the request asks for it."""
    sha256 = surface.container or ""
    place = f"{request.scope.get('root_path', '')}{router.prefix}/containers/{sha256}.lode"
    with still_there(parts, surface.id):
        return await _sent(request, parts, sha256, {"cache-control": caching(parts), "content-location": place})


@readable(
    router,
    "/containers/{sha256}.lode",
    dependencies=[READ],
    summary="Fetch a container, or ranges of it",
    response_class=FileResponse,
    responses={**CONTAINER, **responses(404, 416, 503)},
)
async def get_container(request: Request, parts: Parts, sha256: str) -> Response:
    """Return a container. It never changes: its name is the SHA-256 of its contents, which is also its strong ETag."""
    if not parts.surfaces.writes and not parts.surfaces.index.uses_container(sha256):
        await parts.following.look_for(CHANGES)
    return await _sent(request, parts, sha256, {"cache-control": caching(parts, forever=True)})


async def _sent(request: Request, parts: State, sha256: str, headers: dict[str, str]) -> Response:
    place, size = await asyncio.to_thread(_place, parts.containers, sha256)  # of a bucket nothing is asked here
    etag = f'"{sha256}"'
    headers = {**headers, "etag": etag}
    unchanged = matches(request.headers.get("if-none-match"), etag)
    if unchanged is not None:
        unchanged.headers.update(headers)
        return unchanged
    sort_out(request, size, etag)
    if isinstance(place, tuple):
        return _Container(parts.containers, sha256, place, request, headers)
    return _Object(parts.containers, sha256, place, request, headers)


def _place(containers: Containers, sha256: str) -> tuple[tuple[Path, os.stat_result] | Blob, int]:
    """Return the file of a container, which may be deleted at any moment, and its status, or its blob; and its size."""
    with containers.blob(sha256) as blob:
        if blob.path is None:  # in a bucket, where nothing is to be closed
            return blob, blob.size
        try:
            return (blob.path, blob.path.stat()), blob.size
        except FileNotFoundError:
            raise BusyError(f"The container {sha256} was deleted and stored again meanwhile; try again") from None


class _Container(SentFile):
    """A container in a file, which may be removed before it is opened."""

    def __init__(
        self,
        containers: Containers,
        sha256: str,
        place: tuple[Path, os.stat_result],
        request: Request,
        headers: dict[str, str],
    ) -> None:
        path, status = place
        super().__init__(path, headers=headers, media_type=descriptions.CONTAINER_TYPE, stat_result=status)
        self._containers = containers
        self._sha256 = sha256
        self._request = request
        self._given = headers

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        except FileNotFoundError:
            place, _ = await asyncio.to_thread(_place, self._containers, self._sha256)  # or it says why
            if not isinstance(place, tuple):  # the file was one of the cache, and had to make room
                sent = _Object(self._containers, self._sha256, place, self._request, self._given)
                await sent(scope, receive, send)
                return
            raise BusyError(f"The container {self._sha256} was deleted and stored again; try again") from None


class _Object(SentBlob):
    """A container in a bucket, which only its first read finds not to be there."""

    def __init__(
        self, containers: Containers, sha256: str, blob: Blob, request: Request, headers: dict[str, str]
    ) -> None:
        super().__init__(blob, request, headers, descriptions.CONTAINER_TYPE)
        self._containers = containers
        self._sha256 = sha256

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        except AbsentError:
            await in_store(self._containers.gone, self._sha256)
