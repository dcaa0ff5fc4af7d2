"""HTTP connections with limits on waiting and reading.

The head of a request must arrive in time, and a client must read its answer at a least rate. Received data are
processed in small pieces, so that other connections get their turn. If a request is answered before all of it has
arrived, a bounded rest is read so that the client sees the answer; then the connection is cut.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from functools import partial
from typing import Any, cast

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from lodestream.operating_system import unacknowledged

from ..operation.least_rate import LeastRate
from ..operation.pace import Pace
from ..operation.settings import Settings
from .bodies import MOST_REST, CountedConnection, Offence
from .cuts import Cuts
from .frames import call_when_lost
from .places import Places

__all__ = ["connections"]

# What is given to h11 at once where a body does not say how long it is: little where chunks are small, since each costs
# as much as many bytes, and more from one piece to the next where they are not.
_LEAST_PIECE = 256
_LARGEST_PIECE = 8 * 1024

# Chunks of a piece that are few, and chunks after which others have their turn.
_FEW_CHUNKS = 4
_CHUNKS_A_TURN = 16

# How long a client has to see the answer to a request that it has not sent whole.
_REST_SECONDS = 3.0

_TITLES = {
    "bad-request": "Not a valid request",
    "busy": "The server is busy; try again later",
    "idle": "The client was too slow",
    "small-chunks": "The chunks of the body are too small",
    "too-many": "This client has too many connections",
}


def connections(settings: Settings, cuts: Cuts, pace: Pace, places: Places) -> type[H11Protocol]:
    """Return the class of a server's HTTP connections; uvicorn creates one instance for each."""

    class Chosen(_Connection):
        head_seconds = settings.head_seconds
        idle_seconds = settings.idle_seconds
        least_rate = settings.least_rate

    Chosen.cuts = cuts
    Chosen.pace = pace
    Chosen.places = places
    return Chosen


class _Connection(H11Protocol):
    """uvicorn's connection, with the limits that it does not have.

    Attributes
    ----------
    head_seconds : float
        How long the head of a request may take, its first byte included.
    idle_seconds : float
        Seconds over which the rate is measured at which a client reads an answer.
    least_rate : int
        Bytes a second of an answer that a client must read at least.
    places : Places
        Counts the connections.
    cuts : Cuts
        Where it is written down when the connection is cut.
    pace : Pace
        What has come and is not looked at yet waits there.
    """

    head_seconds: float
    idle_seconds: float
    least_rate: int
    places: Places
    cuts: Cuts
    pace: Pace
    conn: CountedConnection

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.conn = CountedConnection()
        self._head_timer: asyncio.TimerHandle | None = None
        self._rest_timer: asyncio.TimerHandle | None = None
        self._waits = False
        self._held = bytearray()
        self._piece = _LEAST_PIECE
        self._rest = 0
        self._watch: _Watch | None = None
        self._upgraded = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        self._socket = transport
        rate = LeastRate(self.least_rate, self.idle_seconds, self.loop.time)
        self._watch = _Watch(transport, self.loop, self.idle_seconds, rate)
        self._guarded = _Transport(self, transport, self._watch.write)
        super().connection_made(cast(asyncio.Transport, self._guarded))
        # Neither holds the connection, which is gone once it has become a stream.
        self._watch.when_slow = partial(self.cuts.note, "slow-answer", self.client)
        self._host = self.client[0] if self.client else "unknown"
        refusal = self.places.take(self._host)
        if refusal is None:
            self._follow_head()
        else:
            self._refuse(*refusal)

    def data_received(self, data: bytes) -> None:
        if self._rest_timer is not None:
            self._rest += len(data)
            if self._rest > MOST_REST:
                self._socket.pause_reading()
        elif not self._socket.is_closing():
            self._held += data
            if not self._waits:
                self._feed()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._follow_head()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        self._upgraded = True
        if self._watch is not None:
            self._watch.upgraded = True
        # It costs five times as much as the rest of a connection's beginning.
        self._socket.pause_reading()
        self.pace.later(partial(self._upgrade, event))

    def _upgrade(self, event: h11.Request) -> None:
        if self._socket.is_closing():
            return
        self.transport = self._socket
        self._guarded.let_go()
        super().handle_websocket_upgrade(event)
        if self._watch is not None:
            call_when_lost(self._socket.get_protocol(), partial(_ended, self._watch, self.places, self._host))
        self._socket.resume_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        self._forget_head()
        if self._rest_timer is not None:
            self._rest_timer.cancel()
        self._held.clear()
        if self._watch is not None:
            _ended(self._watch, self.places, self._host)
        super().connection_lost(exc)
        self._guarded.let_go()

    def send_400_response(self, msg: str) -> None:
        code, detail = self.conn.offence or Offence("bad-request", "expected a valid HTTP/1.1 request")
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            self.cuts.note(code, self.client)
            self._refuse(400, code, detail)
        else:
            # The answer is under way already, or was sent.
            self._cut(code)

    def resume_reading(self) -> None:
        """Continue with the bytes that were received meanwhile, then with new ones."""
        if self._held and not self._upgraded:
            self._feed_later()
        else:
            self._socket.resume_reading()

    def is_closing(self) -> bool:
        """Return whether the connection takes no other request."""
        return self._rest_timer is not None or self._socket.is_closing()

    def close(self) -> None:
        """Close, but let a client that is still sending see the answer first.

        A socket that is closed before everything was read from it sends a reset, which may overtake the answer.
        """
        unread = self._held or self.conn.their_state in (h11.SEND_BODY, h11.ERROR)
        if self._upgraded or self.is_closing() or not unread:
            self._socket.close()
            return
        self._forget_head()
        self._leave_request()
        self._rest = len(self._held)
        self._held.clear()
        try:
            self._socket.write_eof()
        except OSError:
            # The client has reset the connection, and the loop has not heard of it yet.
            self._socket.abort()
            return
        if self._rest <= MOST_REST:
            self._socket.resume_reading()
        self._rest_timer = self.loop.call_later(_REST_SECONDS, self._rest_is_over)

    def _feed(self) -> None:
        self._waits = False
        before = self.conn.chunks
        while self._may_feed() and self.conn.chunks - before < _CHUNKS_A_TURN:
            size, chunks = max(self._piece, self.conn.remaining), self.conn.chunks
            piece = bytes(self._held[:size])
            del self._held[:size]
            super().data_received(piece)
            few = self.conn.chunks - chunks <= _FEW_CHUNKS
            self._piece = min(2 * self._piece, _LARGEST_PIECE) if few else _LEAST_PIECE
        if self._upgraded:
            # A client waits for the answer to its handshake before it sends anything else.
            self._held.clear()
        elif not self.is_closing():
            # While some of it waits no more is read.
            if self._held:
                self._socket.pause_reading()
            elif not self.flow.read_paused:
                self._socket.resume_reading()
            if self._may_feed():
                self._feed_later()
        self._follow_head()

    def _feed_later(self) -> None:
        if not self._waits:
            self._waits = True
            self.pace.later(self._feed)

    def _may_feed(self) -> bool:
        return bool(self._held) and not (self._upgraded or self.flow.read_paused or self.is_closing())

    def _rest_is_over(self) -> None:
        if self._socket.get_write_buffer_size():
            # A client that takes nothing of the answer is found out by the watch.
            self._rest_timer = self.loop.call_later(_REST_SECONDS, self._rest_is_over)
        elif self._rest > MOST_REST:
            self._cut("refused-body")
        else:
            self._socket.abort()

    def _leave_request(self) -> None:
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.disconnected = True
            self.cycle.message_event.set()

    def _cut(self, reason: str) -> None:
        self.cuts.note(reason, self.client)
        self._held.clear()
        self._socket.abort()

    def _follow_head(self) -> None:
        # The clock is not set back by a byte: a head that comes byte by byte is late like one that does not come. The
        # rest of a body that was answered before it was whole is read, since a client may look only after it.
        answered = self.cycle is not None and self.cycle.response_complete
        waiting = self.conn.their_state is h11.IDLE or (answered and self.conn.their_state is h11.SEND_BODY)
        if self._upgraded or self.is_closing() or not waiting:
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
            self._refuse(408, "idle", f"expected the complete head of a request within {self.head_seconds:g} s")
        else:
            self._cut("refused-body")

    def _refuse(self, status: int, code: str, detail: str) -> None:
        self._leave_request()
        problem = {"type": f"urn:lodestream:{code}", "title": _TITLES[code], "status": status, "code": code}
        body = json.dumps({**problem, "detail": detail, "instance": None}).encode()
        headers = [
            ("content-type", "application/problem+json"),
            ("content-length", str(len(body))),
            ("connection", "close"),
        ]
        if status != 400:
            headers.append(("retry-after", "5"))
        only_head = self.conn.our_state is h11.SEND_RESPONSE and self.conn.only_head
        sent = h11.Data(data=b"" if only_head else body)
        for event in (h11.Response(status_code=status, headers=headers), sent, h11.EndOfMessage()):
            self.transport.write(self.conn.send(event))
        self.transport.close()


def _ended(watch: _Watch, places: Places, host: str) -> None:
    """Count a connection that has ended, also if it had become a stream, which has another object."""
    watch.end()
    places.leave(host)


class _Transport:
    """What a connection and its requests see of their transport.

    Closing and reading are left to the connection, and what is written is counted.
    """

    def __init__(self, connection: _Connection, transport: asyncio.Transport, write: Callable[[bytes], None]) -> None:
        self._transport = transport
        self.write = write
        self.close = connection.close
        self.is_closing = connection.is_closing
        self.resume_reading = connection.resume_reading

    def let_go(self) -> None:
        """Drop the reference to the connection, so that it needs no garbage collection."""
        self.close = self._transport.close
        self.is_closing = self._transport.is_closing
        self.resume_reading = self._transport.resume_reading

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)


class _Watch:
    """Looks from time to time how much of an answer the client has read; breaks the connection if it is too little.

    It holds the transport and not the connection, which is gone once it has become a stream.

    Parameters
    ----------
    transport : asyncio.Transport
    loop : asyncio.AbstractEventLoop
    seconds : float
        Time between two looks.
    rate : LeastRate

    Attributes
    ----------
    upgraded : bool
        The connection has become a stream.
    when_slow : callable
        Called before the connection is broken.
    """

    def __init__(
        self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop, seconds: float, rate: LeastRate
    ) -> None:
        self.upgraded = False
        self.when_slow: Callable[[], None] = lambda: None
        self._transport = transport
        self._loop = loop
        self._seconds = seconds
        self._rate = rate
        self._written = 0
        self._closing = False
        self._begin_look()

    def write(self, data: bytes) -> None:
        """Write to the transport."""
        # Until now the server kept the client waiting, and not the client the server.
        if not self._transport.get_write_buffer_size():
            self._rate.begin(self._read())
        self._written += len(data)
        self._transport.write(data)

    def end(self) -> None:
        """Stop watching, so that nothing of an ended connection is kept until the next check."""
        self._timer.cancel()

    def _look(self) -> None:
        # A transport that is told to close first sends what it holds, for as long as that takes: this is its end, too.
        unsent, closing = self._transport.get_write_buffer_size(), self._transport.is_closing()
        if closing and not unsent:
            return
        # In a stream the other side's credit and the stream's own clock decide, until it is being closed: its time for
        # that begins when this is first seen. While the event loop was held up, nothing more was given to the client.
        late = self._loop.time() - self._due > self._seconds / 2
        begins, self._closing = closing and not self._closing, closing
        if not unsent or (self.upgraded and not closing) or begins or late:
            self._rate.begin(self._read())
        elif self._rate.shortfall(self._read()) is not None:
            self.when_slow()
            self._transport.abort()
            return
        self._begin_look()

    def _begin_look(self) -> None:
        self._due = self._loop.time() + self._seconds
        self._timer = self._loop.call_later(self._seconds, self._look)

    def _read(self) -> int:
        """Return the bytes that the client's system has acknowledged, up to a constant."""
        return self._written - self._transport.get_write_buffer_size() - _queued(self._transport)


def _queued(transport: asyncio.Transport) -> int:
    """Return the bytes of a socket's send buffer that the other side has not acknowledged.

    0 if the system does not tell.

    The system takes more from a transport only when a third of that buffer is free, which may be a megabyte: a client
    that reads slowly but steadily would seem to read nothing for minutes.
    """
    try:
        return unacknowledged(transport.get_extra_info("socket").fileno())
    except (OSError, ValueError):  # a socket that is closed has no number
        return 0
