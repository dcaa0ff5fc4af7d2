"""Receiving by HTTP Range requests, until the stream ends or a request fails."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from lodestream.errors import LodestreamError, TruncatedStreamError
from lodestream.protocol.messages import MIN_WINDOW
from lodestream.transfer.range_download import RangeDownload

from ..errors import SilenceError
from ..requests import addresses, problems
from ..requests.answers import LONGEST_PROBLEM, Head, Incoming
from .effects import Ahead, Flow, Get, HangUp, Read

if TYPE_CHECKING:
    from lodestream.transfer.range_download import RangeRequest
    from lodestream.transfer.receiver_state import DownloadEvent

    from .session import Session

__all__ = ["receive"]

# Statuses of answers that say something of the file asked for; with others, the body says what is wrong.
_OF_THE_FILE = {200, 206, 416}


def receive(session: Session) -> Flow[None]:
    """Request missing ranges one after the other, each while the one before it arrives.

    Raises
    ------
    UnreachableError, SilenceError, TruncatedStreamError
        If there is no connection, nothing comes for too long, or an answer breaks off.
    LodestreamError
        What the server refuses, or what is wrong with what it sent.
    """
    if session.ranges is None:
        session.ranges = RangeDownload(session.reception)
    download, url = session.ranges, addresses.container_url(session.url)
    download.leave()
    turns = session.turns
    while True:
        # First: what was asked to stop has stopped, even if all that there is has come.
        left = _tick(session, download)
        if session.ended is not None:
            break
        if session.turns != turns:
            download.leave()  # what was asked for ahead may not be what comes first now
        turns = session.turns
        request = _next_request(session, download)
        if request is None:
            break
        try:
            get = _get(session, url, request, left)
            if session.shows:
                yield Ahead(get)  # before somebody looks at what is there
            head = yield from _answered(session, get, beside=download.was_ahead)
            url = head.url
            download.answer(head.status, head.headers, session.clock())
            session.transports.met = True
            yield from _body(session, download, turns, url)
        except SilenceError:
            _tick(session, download)
            if session.ended is None:
                raise
        if session.ended is not None:
            break
        if _elsewhere(session, download, turns):
            download.leave()
            yield HangUp()
        else:
            download.finish(session.clock())
    yield HangUp()


def _get(session: Session, url: str, request: RangeRequest, left: float | None) -> Get:
    return Get(url, {**request.headers, **session.authorization(url)}, session.patience(left))


def _answered(session: Session, request: Get, *, beside: bool) -> Flow[Head]:
    """Return the head of an answer for the file; raise any other answer."""
    import httpx

    session.transports.beside = session.transports.beside and not beside
    try:
        head: Head = yield request
        session.landed(request.url, head.url)
        session.connections += head.status in _OF_THE_FILE
        if head.status in _OF_THE_FILE:
            session.transports.beside = session.transports.beside or beside
            return head
        incoming = Incoming(head, LONGEST_PROBLEM, request.url, session.url, None)
        while (chunk := (yield Read())) and incoming.take(chunk):
            pass
    except httpx.HTTPError as error:
        raise problems.from_connection(error, session.url) from error
    answer = incoming.answer()
    failure: LodestreamError = problems.from_response(answer.status, answer.reason, answer.content, head.url)
    raise failure


def _body(session: Session, download: RangeDownload, turns: int, url: str) -> Flow[None]:
    """Read an answer to its end, or until the stream ends or another region comes first."""
    while True:
        left = _tick(session, download)
        if session.ended is not None or _elsewhere(session, download, turns):
            return
        if session.transports.beside and (request := download.ahead()) is not None:
            yield Ahead(_get(session, url, request, left))
        chunk = yield from _chunk(session)
        if not chunk:
            return
        yield from session.pace(len(chunk))
        session.take(partial(download.receive, chunk))


def _chunk(session: Session) -> Flow[bytes]:
    import httpx

    try:
        chunk: bytes = yield Read()
    except httpx.TimeoutException as error:
        raise session.silent() from error
    except httpx.HTTPError as error:
        raise TruncatedStreamError(f"expected the rest of an answer of {session.url}, got none: {error}") from error
    return chunk


def _elsewhere(session: Session, download: RangeDownload, turns: int) -> bool:
    """Return whether another region now comes first, and too much of this answer is left to wait for its end."""
    return session.turns != turns and download.left > MIN_WINDOW


def _next_request(session: Session, download: RangeDownload) -> RangeRequest | None:
    requests: list[RangeRequest | None] = []

    def ask() -> list[DownloadEvent]:
        request, events = download.request(session.clock())
        requests.append(request)
        return events

    session.take(ask)
    return requests[0]


def _tick(session: Session, download: RangeDownload) -> float | None:
    with session.lock:
        left = session.reception.tick(session.clock())
        if session.stopped:
            download.stop()
        elif left == 0:
            download.stop("seconds")
        return left
