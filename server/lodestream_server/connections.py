"""HTTP connections that do not wait for ever: for the head of a request, or for a client to take an answer."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from .settings import Settings

__all__ = ["connections"]


def connections(settings: Settings) -> type[H11Protocol]:
    """The class of a server's connections; uvicorn makes one for each."""

    class Chosen(_Connection):
        head_seconds = settings.head_seconds
        idle_seconds = settings.idle_seconds
        most = settings.max_connections

    return Chosen


class _Connection(H11Protocol):
    """uvicorn's connection, with the limits that it does not have.

    Attributes
    ----------
    head_seconds : float
        How long the head of a request may take, its first byte included.
    idle_seconds : float
        How long a client may take nothing of what is to be sent.
    most : int
        How many connections there may be.
    """

    head_seconds: float
    idle_seconds: float
    most: int

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._head_timer: asyncio.TimerHandle | None = None
        self._watch: _Watch | None = None
        self._upgraded = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._watch = _Watch(transport, self.loop, self.idle_seconds)
        if len(self.connections) > self.most:
            self._refuse(503, "busy", f"expected at most {self.most} connections; come back in a few seconds")
        else:
            self._follow_head()

    def data_received(self, data: bytes) -> None:
        if not self.transport.is_closing():
            super().data_received(data)
            self._follow_head()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._follow_head()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        self._upgraded = True
        if self._watch is not None:
            self._watch.upgraded = True
        super().handle_websocket_upgrade(event)

    def connection_lost(self, exc: Exception | None) -> None:
        self._forget_head()
        super().connection_lost(exc)

    def resume_writing(self) -> None:
        if self._watch is not None:
            self._watch.moved = True
        super().resume_writing()

    def _follow_head(self) -> None:
        # The clock is not set back by a byte: a head that comes byte by byte is late like one that does not come. The
        # rest of a body that was answered before it was whole is read, since a client may look only after it.
        answered = self.cycle is not None and self.cycle.response_complete
        waiting = self.conn.their_state is h11.IDLE or (answered and self.conn.their_state is h11.SEND_BODY)
        if self._upgraded or self.transport.is_closing() or not waiting:
            self._forget_head()
        elif self._head_timer is None:
            self._head_timer = self.loop.call_later(self.head_seconds, self._head_is_late)

    def _forget_head(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _head_is_late(self) -> None:
        self._head_timer = None
        if self.conn.our_state is h11.IDLE:
            self._refuse(408, "idle", f"expected the whole head of a request within {self.head_seconds:g} s")
        else:
            self.transport.close()

    def _refuse(self, status: int, code: str, detail: str) -> None:
        title = "Nothing was heard for too long" if status == 408 else "As much to do as the server can; come back"
        problem = {"type": f"urn:lodestream:{code}", "title": title, "status": status, "code": code, "detail": detail}
        body = json.dumps({**problem, "instance": None}).encode()
        headers = [
            ("content-type", "application/problem+json"),
            ("content-length", str(len(body))),
            ("retry-after", "5"),
            ("connection", "close"),
        ]
        events = (h11.Response(status_code=status, headers=headers), h11.Data(data=body), h11.EndOfMessage())
        for event in events:
            self.transport.write(self.conn.send(event))
        self.transport.close()


class _Watch:
    """Looks from time to time whether the other side takes what is to be sent; breaks the connection if it does not.

    It holds the transport and not the connection, which is gone once it has become a stream.

    Attributes
    ----------
    moved : bool
        Something has been taken since the last look.
    upgraded : bool
        The connection has become a stream.
    """

    def __init__(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop, seconds: float) -> None:
        self.moved = False
        self.upgraded = False
        self._transport = transport
        self._loop = loop
        self._seconds = seconds
        self._unsent = 0
        loop.call_later(seconds, self._look)

    def _look(self) -> None:
        # A transport that is told to close first sends what it holds, for as long as that takes: this is its end, too.
        unsent, closing = self._transport.get_write_buffer_size(), self._transport.is_closing()
        if closing and not unsent:
            return
        # In a stream the other side's credit and the stream's own clock decide, until it is being closed.
        judged = closing or not self.upgraded
        if judged and not self.moved and 0 < self._unsent <= unsent:
            self._transport.abort()
            return
        self._unsent, self.moved = unsent, False
        self._loop.call_later(self._seconds, self._look)
