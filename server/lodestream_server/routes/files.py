"""The routes of containers and levels, which are fetched as files."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import FileResponse, RedirectResponse, Response
from starlette.types import Message, Receive, Scope, Send

from lodestream.errors import NotFoundError, OptionError, StreamError

from ..access.access import anybody
from ..access.gate import caller_of
from ..access.scopes import needs
from ..builds.level_files import Key
from ..builds.level_queue import Loan
from ..builds.levels import MEDIA_TYPES
from ..problems import BuildFailedError, MissingError, NotReadyError, PostponedError, responses
from ..storage import damage
from ..storage.records import Record
from ..storage.storage import Storage
from . import examples
from .byte_ranges import sort_out
from .routing import Parts, State, matches, readable

__all__ = ["router"]

_log = logging.getLogger(__name__)

router = APIRouter(prefix="/v1", tags=["files"])


@readable(
    router,
    "/surfaces/{surface}/container",
    status_code=307,
    summary="Find a surface's container",
    response_class=Response,
    responses={307: {"description": "Location is the immutable container"}, **responses(404, 409, 424, 503)},
)
@needs("read")
async def find(request: Request, parts: Parts, surface: str) -> Response:
    """Redirect to the container; 409 with Retry-After while it is being built."""
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
        **responses(404, 416, 503),
    },
)
@needs("read")
async def fetch(request: Request, parts: Parts, sha256: str) -> Response:
    """A container never changes: its name is the SHA-256 of its contents, which is also its strong ETag."""
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
    except FileNotFoundError:
        raise parts.storage.gone(sha256) from None
    kept = parts.storage.container_bytes(sha256)
    if kept not in (None, status.st_size):
        error = StreamError(f"expected {kept} bytes of the container {sha256}, got {status.st_size}")
        damage.tell(parts.storage, sha256, error)
        raise error
    sort_out(request, status.st_size, etag)
    return _Container(parts.storage, sha256, path, headers, status)


@readable(
    router,
    "/surfaces/{surface}/levels/{level}",
    summary="Fetch one level as a file",
    response_class=Response,
    responses={
        200: examples.LEVEL,
        206: {"description": "The range asked for"},
        304: {"description": "The client has it"},
        **responses(404, 409, 413, 416, 422, 424, 429, 501, 503, 507),
    },
)
@needs("read")
async def level(
    request: Request,
    parts: Parts,
    surface: str,
    level: int,
    format_name: Annotated[str, Query(alias="format", description=", ".join(MEDIA_TYPES))] = "npy",
) -> Response:
    """The grid of one level, 0 being the coarsest; the same file as ``lodestream decode --level`` writes."""
    record = ready(parts, surface)
    _check(record, level, format_name)
    etag = f'"{record.container}-{level}-{format_name}"'
    headers = {"etag": etag, "cache-control": "no-cache"}
    unchanged = matches(request.headers.get("if-none-match"), etag)
    if unchanged is not None:
        return unchanged
    key = Key(record.container or "", level, format_name)
    with still_there(parts, surface):
        loan = await parts.levels.borrow(request, key, (caller_of(request) or anybody(request)).key)
    try:
        sort_out(request, loan.size, etag)
        headers["content-disposition"] = f'attachment; filename="{record.id}-{level}.{format_name}"'
        return _Borrowed(loan, headers, MEDIA_TYPES[format_name])
    except BaseException:
        loan.release()
        raise


class _File(FileResponse):
    """A file; once all of it was sent nothing that befalls it concerns the client.

    It is opened before anything is sent, so a file that is not there can still be answered by a problem document.
    """

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        head: Message | None = None
        complete = False

        async def watched(message: Message) -> None:
            nonlocal head, complete
            if message["type"] == "http.response.start":  # the file is opened after it
                head = message
                return
            if head is not None:
                start, head = head, None
                await send(start)
            await send(message)
            complete = message["type"] == "http.response.body" and not message.get("more_body", False)

        try:
            await super().__call__(scope, receive, watched)
        except OSError as error:
            if not complete:
                raise
            # The connection would be cut, perhaps with the client's next request on it.
            _log.warning("%s was sent completely, but could not be closed: %s", self.path, error.strerror or error)


class _Container(_File):
    """A stored container, which may be deleted before it is opened."""

    def __init__(
        self, storage: Storage, sha256: str, path: Path, headers: dict[str, str], status: os.stat_result
    ) -> None:
        super().__init__(path, headers=headers, media_type=examples.CONTAINER_TYPE, stat_result=status)
        self._storage = storage
        self._sha256 = sha256

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        except FileNotFoundError:
            raise self._storage.gone(self._sha256) from None


class _Borrowed(_File):
    """A file that is given back once it was sent, or the client has gone."""

    def __init__(self, loan: Loan, headers: dict[str, str], media_type: str) -> None:
        super().__init__(loan.path, headers=headers, media_type=media_type, stat_result=loan.path.stat())
        self._loan = loan

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._loan.release()


def ready(parts: State, surface: str) -> Record:
    """The record of a surface that has a container.

    Raises
    ------
    NotFoundError
        If there is no such surface.
    NotReadyError, PostponedError, BuildFailedError
        If it is still being built, waits for a retry, or has failed.
    MissingError
        If it is not on disk now.
    """
    record = parts.storage.get(surface)
    if record.state == "failed":
        raise BuildFailedError(f"{surface} could not be built: {record.reason}")
    if record.state == "waiting":
        raise PostponedError(f"{surface} could not be built and waits for a retry: {record.reason}")
    if record.state == "missing":
        raise MissingError(f"{surface} is not on the server's disk now: {record.reason}")
    if record.state != "ready":
        state, progress = parts.builder.state(record)
        raise NotReadyError(f"{surface} is {state} ({progress:.0%} done); try again soon")
    return record


@contextmanager
def still_there(parts: State, surface: str) -> Iterator[None]:
    """Around what reads the container of a surface: if there is none, raise what is true of the surface now.

    It may have been deleted meanwhile, although another surface has the same container, or been made again.

    Raises
    ------
    NotFoundError, NotReadyError, PostponedError, BuildFailedError, MissingError
        See `ready`.
    BusyError
        If its container can be read again.
    """
    try:
        yield
    except (NotFoundError, MissingError):
        raise parts.storage.gone(ready(parts, surface).container or "") from None


def _check(record: Record, level: int, format_name: str) -> None:
    finest = len((record.info or {})["levels"]) - 1
    if not 0 <= level <= finest:
        raise OptionError(f"expected a level of 0 to {finest}, got {level}")
    if format_name not in MEDIA_TYPES:
        raise OptionError(f"expected format to be one of {', '.join(MEDIA_TYPES)}, got {format_name[:80]!a}")
