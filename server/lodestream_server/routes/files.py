"""The routes of containers, which are fetched as files."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

from fastapi import APIRouter, Request
from fastapi.responses import FileResponse, RedirectResponse, Response
from starlette.types import Receive, Scope, Send

from ..access.scopes import READ
from ..problems import BusyError, responses
from ..store.containers import Containers
from . import examples
from .byte_ranges import sort_out
from .routing import Parts, matches, readable
from .sending import SentFile, ready

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["files"])


@readable(
    router,
    "/surfaces/{surface}/container",
    dependencies=[READ],
    status_code=307,
    summary="Find a surface's container",
    response_class=Response,
    responses={307: {"description": "Location is the immutable container"}, **responses(404, 409, 503)},
)
async def find(request: Request, parts: Parts, surface: str) -> Response:
    """Redirect to the container; 409 with Retry-After while it is being built."""
    found = ready(parts, surface)
    address = f"{request.scope.get('root_path', '')}{router.prefix}/containers/{found.container}.lode"
    return RedirectResponse(address, headers={"cache-control": "no-cache"})


@readable(
    router,
    "/containers/{sha256}.lode",
    dependencies=[READ],
    summary="Fetch a container, or ranges of it",
    response_class=FileResponse,
    responses={
        200: {"description": "The whole container", "content": {examples.CONTAINER_TYPE: {}}},
        206: {"description": "The range asked for"},
        304: {"description": "The client has it"},
        **responses(404, 416, 503),
    },
)
async def fetch(request: Request, parts: Parts, sha256: str) -> Response:
    """Return a container. It never changes: its name is the SHA-256 of its contents, which is also its strong ETag."""
    path, status = await asyncio.to_thread(_file, parts.containers, sha256)
    etag = f'"{sha256}"'
    # What needs a token must not come out of a shared cache for those who have none.
    shared = "public" if parts.settings.public_reads else "private"
    headers = {"etag": etag, "cache-control": f"{shared}, max-age=31536000, immutable"}
    unchanged = matches(request.headers.get("if-none-match"), etag)
    if unchanged is not None:
        unchanged.headers.update(headers)
        return unchanged
    sort_out(request, status.st_size, etag)
    return _Container(parts.containers, sha256, path, headers, status)


def _file(containers: Containers, sha256: str) -> tuple[Path, os.stat_result]:
    """Return the file of a container, which may be deleted at any moment, and its status."""
    with containers.blob(sha256) as blob:
        assert blob.path is not None, "the store is a folder"
        try:
            return blob.path, blob.path.stat()
        except FileNotFoundError:
            raise BusyError(f"The container {sha256} was deleted and stored again meanwhile; try again") from None


class _Container(SentFile):
    """A stored container, which may be deleted before it is opened."""

    def __init__(
        self, containers: Containers, sha256: str, path: Path, headers: dict[str, str], status: os.stat_result
    ) -> None:
        super().__init__(path, headers=headers, media_type=examples.CONTAINER_TYPE, stat_result=status)
        self._containers = containers
        self._sha256 = sha256

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        except FileNotFoundError:
            await asyncio.to_thread(_file, self._containers, self._sha256)  # which says why
            raise BusyError(f"The container {self._sha256} was deleted and stored again; try again") from None
