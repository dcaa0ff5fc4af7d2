"""Shared by routes that answer with files: the state of a surface, and a file that is sent whole or refused."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from contextlib import contextmanager, suppress
from typing import Any, TypeVar

from fastapi import Request
from fastapi.responses import FileResponse, StreamingResponse
from starlette.requests import ClientDisconnect
from starlette.types import Message, Receive, Scope, Send

from lodestream.errors import NotFoundError
from lodestream.stores import Blob, StoreError

from ..operation.threads import in_store
from ..problems import BuildFailedError, BusyError, NotReadyError, PostponedError
from ..store.index import Surface
from .byte_ranges import only_range
from .routing import State

__all__ = ["SentBlob", "SentFile", "look_for", "ready", "still_there", "while_there"]

_log = logging.getLogger(__name__)

_Result = TypeVar("_Result")

# Bytes of a blob that are sent at once.
_PIECE = 256 << 10


class SentFile(FileResponse):
    """A file; once all of it was sent nothing that befalls it concerns the client.

    It is opened before anything is sent, so a file that is not there can still be answered by a problem document.
    """

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the file; an error after its last byte is logged and not raised."""
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


class SentBlob(StreamingResponse):
    """An object of a bucket, or the one range of it that is asked for; of several ranges, all of it.

    Its first bytes are read before anything is sent, so that one that is not there can still be answered by a problem
    document.

    Parameters
    ----------
    blob : Blob
    request : Request
        See `byte_ranges.sort_out`.
    headers : dict of str to str
    media_type : str
    """

    def __init__(self, blob: Blob, request: Request, headers: dict[str, str], media_type: str) -> None:
        wanted = only_range(request, blob.size)
        start, end = wanted or (0, blob.size)
        headers |= {"content-length": str(end - start), "accept-ranges": "bytes"}
        if wanted is not None:
            headers["content-range"] = f"bytes {start}-{end - 1}/{blob.size}"
        pieces = _pieces(blob, start, start if request.method == "HEAD" else end)
        super().__init__(pieces, 200 if wanted is None else 206, headers, media_type)
        self._blob = blob
        self._first = start, min(_PIECE, end - start)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        await in_store(self._blob.read, *self._first)
        await super().__call__(scope, receive, send)


async def _pieces(blob: Blob, start: int, end: int) -> AsyncIterator[bytes]:
    for offset in range(start, end, _PIECE):
        yield await in_store(blob.read, offset, min(_PIECE, end - offset))


async def look_for(parts: State, surface: str) -> None:
    """Look in the bucket for a surface that this server does not know, or not as built: another one may have told so.

    Raises
    ------
    StoreError, BusyError
        If it is not known here, and the bucket does not answer.
    """
    if parts.surfaces.writes:  # it knows everything
        return
    known = parts.surfaces.index.find(surface)
    if known is None:
        await parts.following.look_for(surface)
    elif known.state == "queued":
        with suppress(StoreError, BusyError):
            await parts.following.look_for(surface)


async def ready(parts: State, surface: str) -> Surface:
    """Return a surface that has a container.

    Raises
    ------
    NotFoundError
        If there is no such surface.
    NotReadyError, PostponedError, BuildFailedError
        If it is still being built, waits for a retry, or has failed.
    StoreError, BusyError
        See `look_for`.
    """
    await look_for(parts, surface)
    return _ready(parts, surface)


def _ready(parts: State, surface: str) -> Surface:
    found = parts.surfaces.get(surface)
    if found.state == "failed":
        raise BuildFailedError(f"The surface {surface} could not be built: {found.reason}")
    if found.state == "waiting":
        raise PostponedError(f"The surface {surface} could not be built and waits for a retry: {found.reason}")
    if found.state != "ready":
        done = parts.builder.progress(found)
        raise NotReadyError(f"The surface {surface} is {found.state} ({done:.0%} done); try again soon")
    return found


@contextmanager
def still_there(parts: State, surface: str) -> Iterator[None]:
    """Guard the reading of a surface's container: if it is gone, raise the error of the surface's current state.

    It may have been deleted meanwhile, although another surface has the same container, or is built again.

    Raises
    ------
    NotFoundError, NotReadyError, PostponedError, BuildFailedError
        See `ready`.
    BusyError
        If its container can be read again.
    """
    try:
        yield
    except NotFoundError:
        _ready(parts, surface)
        raise BusyError(f"The container of {surface} was deleted and stored again meanwhile; try again") from None
    except BusyError:
        _ready(parts, surface)
        raise


async def while_there(
    request: Request, work: Coroutine[Any, Any, _Result], release: Callable[[_Result], None]
) -> _Result:
    """Wait for work; it is cancelled when the client disconnects.

    Parameters
    ----------
    request : Request
        Its body must not have been read.
    work : coroutine
    release : callable
        Called with a result that nobody takes any more.

    Raises
    ------
    ClientDisconnect
        If the client has disconnected.
    Exception
        From the work.
    """
    working, watching = asyncio.ensure_future(work), asyncio.ensure_future(_gone(request))
    taken = False

    def let_go(_: object) -> None:
        if not taken and not working.cancelled() and working.exception() is None:
            release(working.result())

    try:
        await asyncio.wait((working, watching), return_when=asyncio.FIRST_COMPLETED)
        if not working.done():
            raise ClientDisconnect
        watching.cancel()
        await asyncio.gather(watching, return_exceptions=True)
        taken = True  # nothing is waited for from here on
        return working.result()
    finally:
        if not taken:
            working.cancel()
            watching.cancel()
            # By its own end, since who waits for that here may be cancelled a second time.
            working.add_done_callback(let_go)
            await asyncio.gather(working, watching, return_exceptions=True)


async def _gone(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
