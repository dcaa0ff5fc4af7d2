"""uvicorn's connections, with the bounds that they do not have: whatever a client sends, or does not read.

This module alone overrides or reads members of uvicorn's classes that are not documented; a test names each
(``tests/server/connections/test_members.py``).

Little is read at a time. What is not looked at yet waits in the system, which slows its sender down, and other
connections get their turn.
"""

from __future__ import annotations

import asyncio
import json
import time
from functools import partial
from typing import Any, cast

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame

from ..operation.least_rate import LeastRate
from ..operation.pace import Pace
from ..operation.settings import Settings
from ..problems import MEDIA_TYPE, document
from .cuts import Cuts
from .joined import Joined
from .open_files import most_connections
from .requests import MOST_REST, Requests
from .slow_readers import Answers

__all__ = ["MOST_FRAGMENTS", "connections"]

# Bytes that are read at a time: of a body whose length is known, and of anything else over HTTP, where chunks of a byte
# cost as much as many bytes.
_BODY = 64 * 1024
_PIECE = 8 * 1024

# The same of a stream: 170 of the smallest frames, which take a millisecond or two.
_FRAMES_PIECE = 1024

# How long a client has to see the answer to a request that it has not sent whole.
_REST_SECONDS = 3.0

# Frames that are no message, which are pings, pongs and fragments: at once, a second, and for each message that the
# server sends, since a client may answer in fragments.
_FRAMES = 200.0
_FRAMES_A_SECOND = 50.0
_FRAMES_A_MESSAGE = 4.0

#: Fragments of a message: the longest one in pieces of 260 bytes.
MOST_FRAGMENTS = 256


def connections(settings: Settings, cuts: Cuts, pace: Pace) -> tuple[type[H11Protocol], type[WebSocketsSansIOProtocol]]:
    """Return the classes of a server's HTTP connections and streams; uvicorn creates an instance for each."""

    class Http(_Http):
        buffer = memoryview(bytearray(_BODY))

    class Stream(_Stream):
        buffer = memoryview(bytearray(_FRAMES_PIECE))

    Http.settings, Http.most, Http.pace = settings, most_connections(settings), pace
    Http.cuts, Stream.cuts, Stream.idle_seconds = cuts, cuts, settings.idle_seconds
    return Http, Stream


class _Http(H11Protocol, asyncio.BufferedProtocol):
    """uvicorn's HTTP connection.

    The head of a request must arrive in time, and a client must read its answer at a least rate. If a request is
    answered before all of it has arrived, a bounded rest is read so that the client sees the answer; then the
    connection is cut.

    Attributes
    ----------
    settings : Settings
    most : int
        Connections of all kinds that a server has at most.
    buffer : memoryview
        Of all connections of a server, into which the system writes: what comes is taken out of it at once.
    cuts : Cuts
        Where it is written down when a connection is cut.
    pace : Pace
        What has become a stream begins in its turn.
    """

    settings: Settings
    most: int
    buffer: memoryview
    cuts: Cuts
    pace: Pace
    conn: Requests

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        self.conn = Requests()
        self._socket = transport
        self._head_timer: asyncio.TimerHandle | None = None
        self._rest_timer: asyncio.TimerHandle | None = None
        self._rest = 0
        self._upgrades = False
        note = partial(self.cuts.note, "slow-answer", transport.get_extra_info("peername"))
        seconds = self.settings.idle_seconds
        rate = LeastRate(self.settings.least_rate, seconds, self.loop.time)
        self._answers = Answers(transport, self.loop, seconds, rate, note)
        self._answers.close, self._answers.is_closing = self.close, self.is_closing
        super().connection_made(cast(asyncio.Transport, self._answers))
        self._follow_head()
        if len(self.connections) > self.most:
            self._refuse(
                "busy", f"The server has {self.most} connections, as many as it takes; try again in a few seconds"
            )

    def get_buffer(self, sizehint: int) -> memoryview:
        return self.buffer if self.conn.remaining > _PIECE else self.buffer[:_PIECE]

    def buffer_updated(self, nbytes: int) -> None:
        self.data_received(bytes(self.buffer[:nbytes]))

    def data_received(self, data: bytes) -> None:
        if self._rest_timer is not None:
            self._rest += len(data)
            if self._rest > MOST_REST:
                self._socket.pause_reading()
        elif not self._socket.is_closing():
            super().data_received(data)
            self._follow_head()

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        self._forget_head()
        self._answers.end()
        self.transport = self._socket
        # It costs five times as much as the rest of a connection's beginning.
        self._upgrades = True
        self._socket.pause_reading()
        self.pace.later(partial(self._upgrade, event))

    def _upgrade(self, event: h11.Request) -> None:
        if not self._socket.is_closing():
            super().handle_websocket_upgrade(event)

    def shutdown(self) -> None:
        if self._upgrades:  # h11 does not let uvicorn end what is to be a stream
            self._socket.close()
        else:
            super().shutdown()

    def connection_lost(self, exc: Exception | None) -> None:
        self._forget_head()
        if self._rest_timer is not None:
            self._rest_timer.cancel()
        super().connection_lost(exc)
        self._answers.end()

    def send_400_response(self, msg: str) -> None:
        self.cuts.note("bad-request", self.client)
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            self._refuse("bad-request", self.conn.wrong)
        else:  # the answer is under way already, or was sent
            self._socket.abort()

    def is_closing(self) -> bool:
        """Return whether the connection takes no other request."""
        return self._rest_timer is not None or self._socket.is_closing()

    def close(self) -> None:
        """Close, but let a client that is still sending see the answer first.

        A socket that is closed before everything was read from it sends a reset, which may overtake the answer.
        """
        if self.is_closing() or self.conn.their_state not in (h11.SEND_BODY, h11.ERROR):
            self._socket.close()
            return
        self._forget_head()
        self._leave_request()
        try:
            self._socket.write_eof()
        except OSError:
            # The client has reset the connection, and the loop has not heard of it yet.
            self._socket.abort()
            return
        self._socket.resume_reading()
        self._rest_timer = self.loop.call_later(_REST_SECONDS, self._rest_is_over)

    def _rest_is_over(self) -> None:
        if self._rest > MOST_REST:
            self._note_rest()
        self._socket.close()

    def _note_rest(self) -> None:
        # There is no scope before a head was read; and no client knows before it sends a body that it is for another.
        if not (self.scope and self.scope["state"].get("is_for_another")):
            self.cuts.note("refused-body", self.client)

    def _leave_request(self) -> None:
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.disconnected = True
            self.cycle.message_event.set()

    def _follow_head(self) -> None:
        # The clock is not set back by a byte: a head that comes byte by byte is late like one that does not come. The
        # rest of a body that was answered before it was whole is read, since a client may look only after it. Where
        # nothing comes after an answer uvicorn has a clock of its own (`timeout_keep_alive`).
        answered = self.cycle is not None and self.cycle.response_complete
        waiting = self.conn.their_state is h11.IDLE or (answered and self.conn.their_state is h11.SEND_BODY)
        if self.is_closing() or not waiting:
            self._forget_head()
        elif self._head_timer is None:
            self._head_timer = self.loop.call_later(self.settings.head_seconds, self._head_is_late)

    def _forget_head(self) -> None:
        if self._head_timer is not None:
            self._head_timer.cancel()
            self._head_timer = None

    def _head_is_late(self) -> None:
        self._head_timer = None
        if self.conn.our_state is h11.IDLE:
            seconds = self.settings.head_seconds
            self._refuse("idle", f"The head of the request was not complete within {seconds:g} s")
        else:
            self._note_rest()
            self._socket.abort()

    def _refuse(self, code: str, detail: str) -> None:
        self._leave_request()
        problem = document(code, detail, self.settings.root_path, None)
        status, body = problem["status"], json.dumps(problem).encode()
        headers = [
            ("content-type", MEDIA_TYPE),
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


class _Stream(WebSocketsSansIOProtocol, asyncio.BufferedProtocol):
    """uvicorn's WebSocket connection.

    uvicorn answers each ping at once, whether or not the client reads the pongs, and takes any number of fragments.
    Here the pongs of the last read wait until the client reads, and frames that are no message are counted. A
    connection that has too many is cut: a client that does this does not read a close frame. What is sent is joined to
    larger packets.

    Attributes
    ----------
    idle_seconds : float
        How long a connection that is closed may take to send what it holds.
    buffer, cuts
        As those of `_Http`.
    """

    idle_seconds: float
    buffer: memoryview
    cuts: Cuts

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._allowed = _FRAMES
        self._counted = time.monotonic()
        self._is_cut = False
        self._pong = b""
        socket = cast(asyncio.Transport, transport)
        # Nothing should come before the handshake is answered.
        socket.pause_reading()
        note = partial(self.cuts.note, "slow-answer", socket.get_extra_info("peername"))
        super().connection_made(cast(asyncio.Transport, Joined(socket, self.idle_seconds, note)))

    def get_buffer(self, sizehint: int) -> memoryview:
        return self.buffer

    def buffer_updated(self, nbytes: int) -> None:
        self.data_received(bytes(self.buffer[:nbytes]))

    async def send(self, message: Any) -> None:
        await super().send(message)
        if message["type"] == "websocket.accept":
            self.transport.resume_reading()
        else:
            self._allowed = min(self._allowed + _FRAMES_A_MESSAGE, _FRAMES)

    def resume_writing(self) -> None:
        super().resume_writing()
        self._send_pong()

    def _send_pong(self) -> None:
        pong, self._pong = self._pong, b""
        if pong:
            self.transport.write(pong)

    def handle_ping(self) -> None:
        if not self._count():
            return
        if self.writable.is_set():
            super().handle_ping()
        else:
            # With the first ping of a read come the pongs of all of them, and with the others none.
            self._pong = b"".join(self.conn.data_to_send()) or self._pong

    def handle_close(self, event: Frame) -> None:
        self._send_pong()  # if one read has brought both, the answer to this is behind it
        super().handle_close(event)

    def handle_pong(self, event: Frame) -> None:
        super().handle_pong(event)
        self._count()

    def handle_cont(self, event: Frame) -> None:
        super().handle_cont(event)
        self._count(len(self.frames) <= MOST_FRAGMENTS)

    def _count(self, few: bool = True) -> bool:
        """Count a frame that is no message; cut the connection, and return False, if there are too many."""
        now = time.monotonic()
        self._allowed = min(self._allowed + (now - self._counted) * _FRAMES_A_SECOND, _FRAMES) - 1
        self._counted = now
        if not self._is_cut and (self._allowed < 0 or not few):
            self._is_cut = True
            self.cuts.note("frames", self.client)
            self.transport.abort()
        return not self._is_cut
