"""WebSocket connections with limits on control frames and fragments.

uvicorn answers each ping at once, whether or not the client reads the pongs, and processes all received frames before
anything else gets its turn. Here received data are processed in small pieces, and frames and unsent bytes of pongs are
counted. A connection that exceeds a limit is cut: a client that does this does not read a close frame. What is sent is
joined to larger packets.
"""

from __future__ import annotations

from asyncio import BaseProtocol, BaseTransport, Transport
from collections.abc import Callable
from typing import Any, cast

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import Frame

from ..operation.pace import Pace
from .cuts import Allowance, Cuts
from .joined import Joined

__all__ = ["call_when_lost", "stream_connections"]

# How many bytes are looked at before the bounds are: at most 42 frames, which take less than a millisecond.
_PIECE = 256

# Frames after which others have their turn.
_FRAMES_A_TURN = 16

# Before the handshake is answered nothing should come; a client that hurries is not refused for it.
_MOST_EARLY = 64 * 1024

_MOST_CONTROL_BYTES = 64 * 1024

# The longest message in fragments of 260 bytes.
_MOST_FRAGMENTS = 256

# Frames of any kind: at once, and a second. A link that was held up delivers several seconds of messages together.
_FRAMES = (2000.0, 500.0)

# Of these, frames that are no message: pings, pongs, fragments.
_OTHER_FRAMES = (200.0, 50.0)

# What comes in answer to what the server has sent comes at the pace of the server: a grant, in fragments even.
_EARNED = 4.0


def stream_connections(cuts: Cuts, pace: Pace) -> type[WebSocketsSansIOProtocol]:
    """Return the class of a server's WebSocket connections; uvicorn creates one instance for each."""

    class Chosen(_Connection):
        pass

    Chosen.cuts = cuts
    Chosen.pace = pace
    return Chosen


def call_when_lost(connection: BaseProtocol, work: Callable[[], None]) -> None:
    """Call a function when a WebSocket connection has ended."""
    if isinstance(connection, _Connection):
        connection.when_lost = work


class _Connection(WebSocketsSansIOProtocol):
    """uvicorn's WebSocket connection, with the bounds that it does not have.

    Attributes
    ----------
    cuts : Cuts
        Where it is written down when the connection is cut.
    pace : Pace
        What has come and is not looked at yet waits there.
    when_lost : callable or None
        Called when the connection has ended.
    """

    cuts: Cuts
    pace: Pace
    when_lost: Callable[[], None] | None = None

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._held = bytearray()
        self._asked = False
        self._waits = False
        self._is_cut = False
        self._frames = Allowance(*_FRAMES)
        self._other_frames = Allowance(*_OTHER_FRAMES)
        self._seen = 0
        self._fragments = 0
        self._control_bytes = 0

    def connection_made(self, transport: BaseTransport) -> None:
        super().connection_made(cast(Transport, Joined(cast(Transport, transport))))

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        if self.when_lost is not None:
            self.when_lost()

    def data_received(self, data: bytes) -> None:
        if not self._asked:
            # The request, which the HTTP connection passes on.
            self._asked = True
            super().data_received(data)
            return
        self._held += data
        if not self._waits:
            self._feed()
        if not self.handshake_complete and len(self._held) > _MOST_EARLY:
            self._cut("frames")

    async def receive(self) -> Any:
        message = await super().receive()
        self._feed()
        return message

    async def send(self, message: Any) -> None:
        await super().send(message)
        if message["type"] == "websocket.send":
            self._frames.earn(_EARNED)
            self._other_frames.earn(_EARNED)
        elif self._held:
            # The handshake is answered, or the close frame is sent and its answer is waited for.
            self._feed()

    def _feed(self) -> None:
        # After each message it is the application's turn: what is behind it waits, and no more is read meanwhile.
        before = self._seen
        while self._may_feed() and self._seen - before < _FRAMES_A_TURN:
            piece = bytes(self._held[:_PIECE])
            del self._held[:_PIECE]
            super().data_received(piece)
        if self.transport.is_closing():
            self._held.clear()
        elif self._may_feed():
            # While some of it waits no more is read.
            self.transport.pause_reading()
            if not self._waits:
                self._waits = True
                self.pace.later(self._go_on)

    def _go_on(self) -> None:
        self._waits = False
        self._feed()
        if not self._waits and not self.read_paused:
            self.transport.resume_reading()

    def _may_feed(self) -> bool:
        able = self.handshake_complete and not self.read_paused and not self.transport.is_closing()
        return bool(self._held) and able

    def handle_ping(self) -> None:
        if self._is_cut:
            return
        before = self.transport.get_write_buffer_size()
        super().handle_ping()
        unsent = self.transport.get_write_buffer_size()
        # Of what waits, this much at the most are pongs: nobody knows what has left of a buffer that was never empty.
        self._control_bytes = (self._control_bytes if before else 0) + unsent - before
        if min(self._control_bytes, unsent) > _MOST_CONTROL_BYTES:
            self._cut("control-data")
        self._count(message=False)

    def handle_pong(self, event: Frame) -> None:
        super().handle_pong(event)
        self._count(message=False)

    def handle_text(self, event: Frame) -> None:
        self._fragments = 1
        super().handle_text(event)
        self._count(message=event.fin)

    def handle_bytes(self, event: Frame) -> None:
        self._fragments = 1
        super().handle_bytes(event)
        self._count(message=event.fin)

    def handle_cont(self, event: Frame) -> None:
        self._fragments += 1
        super().handle_cont(event)
        if self._fragments > _MOST_FRAGMENTS:
            self._cut("fragments")
        self._count(message=event.fin)

    def _count(self, *, message: bool) -> None:
        self._seen += 1
        if not self._frames.take() or not (message or self._other_frames.take()):
            self._cut("frames")

    def _cut(self, reason: str) -> None:
        if self._is_cut:
            return
        self._is_cut = True
        self._held.clear()
        self.cuts.note(reason, self.client)
        self.transport.abort()
