"""Learning, before a stream, to which surface or container a name leads now."""

from __future__ import annotations

from typing import TYPE_CHECKING

from lodestream.errors import TruncatedStreamError

from ..requests import api, problems
from ..requests.answers import Answer, Head, Incoming
from ..requests.calls import Call
from .effects import Flow, Get, HangUp, Read

if TYPE_CHECKING:
    from .session import Session

__all__ = ["located"]


def located(session: Session) -> Flow[str]:
    """Return the URL of the surface or container to which the name leads that a stream is of.

    Raises
    ------
    UnreachableError, SilenceError, TruncatedStreamError
        If there is no connection, nothing comes for too long, or the answer breaks off.
    LodestreamError
        What the server refuses, or what is wrong with what it sent.
    """
    steps = api.locate(session.url)
    answer: Answer | None = None
    while True:
        try:
            call = steps.send(answer)
        except StopIteration as end:
            url: str = end.value
            yield HangUp()
            return url
        assert isinstance(call, Call), "it waits for nothing but answers"
        answer = yield from _read(session, call)


def _read(session: Session, call: Call) -> Flow[Answer]:
    """Return a short answer, which takes no longer than a server may be silent."""
    import httpx

    until = session.clock() + session.silence
    try:
        headers = {"Accept-Encoding": "identity", **call.headers, **session.authorization(call.url)}
        head: Head = yield Get(call.url, headers, session.patience(session.tick()))
        session.landed(call.url, head.url)
        incoming = Incoming(head, call.most, call.url, session.url, None)
        while (chunk := (yield Read())) and incoming.take(chunk):
            if session.tick() == 0:
                raise TruncatedStreamError(f"expected to learn where {session.url} leads, but its time is over")
            if session.clock() >= until:
                raise session.silent()
    except httpx.HTTPError as error:
        raise problems.from_connection(error, session.url) from error
    return incoming.answer()
