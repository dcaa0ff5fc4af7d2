"""Receiving over one WebSocket, until the stream ends or the connection breaks."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NoReturn

from lodestream.errors import LodestreamError, RemoteError, RemoteProtocolError
from lodestream.protocol.handshake import to_address
from lodestream.protocol.messages import SUBPROTOCOL
from lodestream.transfer.download import Download

from ..requests import addresses, problems
from .effects import Dial, DialError, Dialled, Flow, HangUp, Hear, Send

if TYPE_CHECKING:
    from websockets.exceptions import ConnectionClosed

    from .session import Session

__all__ = ["receive"]

# Close codes that a WebSocket library gives a peer that breaks the rules.
_OFFENCES = {1002, 1003, 1007, 1009}


def receive(session: Session) -> Flow[None]:
    """Open a WebSocket, and receive what is missing.

    Raises
    ------
    UnreachableError, SilenceError, TruncatedStreamError
        If there is no connection, nothing comes for too long, or the connection breaks.
    LodestreamError
        What the server refuses, or what is wrong with what it sent.
    """
    download = yield from _opened(session)
    while session.ended is None:
        left = session.tick()
        yield Send()
        patience = session.patience()
        message = yield from _heard(session, download, patience if left is None else min(patience, left))
        if message is None:
            if left is not None and left <= patience:
                continue
            raise session.silent()
        waited = session.clock() - session.asked
        yield from session.pace(len(message))
        session.take(partial(download.receive, message, session.clock(), waited))
    if download.window.measured:
        session.windows.remember(session.url, download.window.size, session.clock())
    yield Send()
    # Whoever receives has everything: a close frame from the other side, a round trip later, would tell nothing.
    yield HangUp(over=True)


def _opened(session: Session) -> Flow[Download]:
    with session.lock:
        turns, session.download = session.turns, None
        first = session.windows.first(session.url, session.clock())
        download = Download(window=session.window, reception=session.reception, first_window=first)
    began = session.clock()
    opening = to_address(download.opening)
    dialled = yield from _dialled(session, addresses.stream_url(session.url, opening))
    session.connections += 1
    if dialled.subprotocol != SUBPROTOCOL:
        raise problems.NoStreamError(
            f"expected {session.url} to speak {SUBPROTOCOL}, got {dialled.subprotocol or 'no subprotocol'}"
        )
    if opening is not None:
        download.opened(began)
    with session.lock:
        session.download = download
        # What was asked for while the connection was being made.
        if session.stopped:
            download.stop()
        elif session.turns != turns:
            download.turn()
    session.transports.met = True
    return download


def _dialled(session: Session, url: str) -> Flow[Dialled]:
    try:
        dialled: Dialled = yield Dial(
            url,
            session.authorization(url),
            session.patience(),
            session.options.close_timeout,
            direct=addresses.is_loopback(session.url),
        )
    except DialError as failure:
        session.landed(url, failure.url)
        cause = failure.__cause__
        if not isinstance(cause, Exception):
            raise
        raise problems.from_connection(cause, session.url) from cause
    session.landed(url, dialled.url)
    return dialled


def _heard(session: Session, download: Download, seconds: float) -> Flow[bytes | None]:
    from websockets.exceptions import ConnectionClosed

    try:
        message: bytes | None = yield Hear(session.clock() + seconds)
    except ConnectionClosed as error:
        _lost(session, download, error)
    return message


def _lost(session: Session, download: Download, error: ConnectionClosed) -> NoReturn:
    """Raise the error for the end of a WebSocket."""
    if error.rcvd is None and error.sent is not None and error.sent.code in _OFFENCES:
        raise RemoteProtocolError(
            f"{session.url} sent an invalid WebSocket message: {error.sent.reason or error.sent.code}"
        )
    try:
        if error.rcvd is None:
            download.connection_lost()
        else:
            download.connection_lost(error.rcvd.code, error.rcvd.reason)
    except RemoteError as refusal:
        raise problems.from_code(refusal.code, str(refusal)) from error
    failure: LodestreamError = problems.from_connection(error, session.url)
    raise failure from error
