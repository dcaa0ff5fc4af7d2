"""The route of levels, which are made as files on request."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request
from fastapi.responses import Response
from starlette.types import Receive, Scope, Send

from lodestream.errors import OptionError
from lodestream.formats import written

from ..access.scopes import Reader
from ..builds.level_files import REMOVED, Key
from ..builds.level_maker import Loan
from ..builds.levels import MEDIA_TYPES, written_by
from ..problems import BusyError, responses
from ..store.index import Surface
from . import descriptions
from .byte_ranges import sort_out
from .routing import Parts, State, caching, matches, readable
from .sending import SentFile, ready, still_there, while_there

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["files"])


@readable(
    router,
    "/surfaces/{surface}/levels/{level}",
    summary="Fetch one level as a file",
    response_class=Response,
    responses={
        200: descriptions.LEVEL,
        206: {"description": "The range asked for"},
        304: {"description": "The client has it"},
        **responses(404, 409, 413, 416, 422, 429, 501, 503, 507),
    },
)
async def get_level(
    caller: Reader,
    request: Request,
    parts: Parts,
    surface: str,
    level: int,
    wanted: Annotated[
        str, Query(alias="format", description=f"{', '.join(MEDIA_TYPES)}; or a suffix of theirs, such as tif")
    ] = "npy",
    _: Annotated[
        str | None, Query(alias="name", description="not used: for programs that go by how an address ends: level.nc")
    ] = None,
) -> Response:
    """Return the grid of one level, 0 being the coarsest; the same file as ``lodestream decode --level`` writes.

    Ranges of it are answered, so that a program such as GDAL (``/vsicurl/``) can read what it shows of a ``cog``.
    """
    found = await ready(parts, surface)
    _check(found, level)
    format_ = written(wanted)
    etag = f'"{found.container}-{level}-{format_.name}-{written_by()}"'
    headers = {"etag": etag, "cache-control": caching(parts)}
    unchanged = matches(request.headers.get("if-none-match"), etag)
    if unchanged is not None:
        return unchanged
    key = Key(found.container or "", level, format_.name)
    with still_there(parts, surface):
        loan = await while_there(request, parts.levels.take(key, caller), Loan.release)
    there = partial(_there, parts, key.container)
    try:
        sort_out(request, loan.size, etag)
        headers["content-disposition"] = f'attachment; filename="{found.id}-{level}{format_.stream_suffix}"'
        with there():
            return _Borrowed(loan, headers, format_.media_type, there)
    except BaseException:
        loan.release()
        raise


class _Borrowed(SentFile):
    """A level file that is released once it was sent, or when the client has disconnected."""

    def __init__(
        self, loan: Loan, headers: dict[str, str], media_type: str, there: Callable[[], AbstractContextManager[None]]
    ) -> None:
        super().__init__(loan.path, headers=headers, media_type=media_type, stat_result=loan.path.stat())
        self._loan = loan
        self._there = there

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            with self._there():
                await super().__call__(scope, receive, send)
        finally:
            self._loan.release()


@contextmanager
def _there(parts: State, container: str) -> Iterator[None]:
    """Guard the reading of a level file of a container.

    Raises
    ------
    BusyError
        If the file was removed, with the scratch folder.
    """
    try:
        yield
    except FileNotFoundError as error:
        parts.levels.forget(container)  # or it would be lent again
        raise BusyError(REMOVED) from error


def _check(surface: Surface, level: int) -> None:
    finest = surface.summary.levels - 1
    if not 0 <= level <= finest:
        raise OptionError(f"No level {level} of this surface: it has levels 0 to {finest}")
