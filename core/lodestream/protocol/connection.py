"""One end of a stream, without I/O: the order of messages, and the credit.

A `Connection` turns received messages into events and events into messages to send. It checks order, credit and ends.
It knows nothing of sockets, clocks, or the contents of a container.

The state machine
-----------------
The client opens. The server answers with a header, then sends slices and layers as far as the credit goes, then ends.
The client opens again, for something else of the same surface, or says bye; the server closes. Two things make this
more than a list of steps:

- *Messages cross.* A ``credit`` or ``stop`` may be in flight while the server ends by itself, and slices are in flight
  when the client stops. So each side has its own table: after its own ``stop`` the client still accepts what comes
  until ``end``; after its own ``end`` the server still accepts these two until ``open`` or ``bye``.
- *Stop takes effect at once.* After ``stop`` the server may send ``end`` and nothing else. A client that has stopped is
  in one of two states: it may stop before the header has come, and must not accept two headers.

An ``error`` is the server's last message in any state; messages of the client that are still in flight are then
accepted and ignored.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import TypeAlias

from ..errors import LocalProtocolError
from .messages import (
    BASE_CREDIT,
    MAX_CREDIT,
    MAX_DATA,
    Bye,
    Credit,
    End,
    Error,
    Event,
    Layer,
    MessageError,
    Open,
    Opened,
    Segments,
    Stop,
)
from .wire import parse, serialize

__all__ = ["TRANSITIONS", "Connection", "Side", "State"]


class Side(Enum):
    """The two ends of a stream."""

    CLIENT = "client"
    SERVER = "server"


class State(Enum):
    """The states of a side; `TRANSITIONS` lists the transitions."""

    IDLE = "idle"
    OPENED = "opened"
    STREAMING = "streaming"
    WITHDRAWN = "withdrawn"
    STOPPING = "stopping"
    ENDED = "ended"
    CLOSED = "closed"
    FAILED = "failed"


_Moves: TypeAlias = Mapping[type[Event], State]

#: For each side and state: what it may send, what it may receive, and the state after it.
TRANSITIONS: Mapping[Side, Mapping[State, tuple[_Moves, _Moves]]] = {
    Side.CLIENT: {
        State.IDLE: (
            {Open: State.OPENED},
            {Error: State.FAILED},
        ),
        State.OPENED: (
            {Credit: State.OPENED, Stop: State.WITHDRAWN},
            {Opened: State.STREAMING, Error: State.FAILED},
        ),
        State.STREAMING: (
            {Credit: State.STREAMING, Stop: State.STOPPING},
            {Segments: State.STREAMING, Layer: State.STREAMING, End: State.ENDED, Error: State.FAILED},
        ),
        State.WITHDRAWN: (
            {},
            {Opened: State.STOPPING, End: State.ENDED, Error: State.FAILED},
        ),
        State.STOPPING: (
            {},
            {Segments: State.STOPPING, Layer: State.STOPPING, End: State.ENDED, Error: State.FAILED},
        ),
        State.ENDED: (
            {Open: State.OPENED, Bye: State.CLOSED},
            {Error: State.FAILED},
        ),
        State.CLOSED: ({}, {Error: State.FAILED}),
        State.FAILED: ({}, {}),
    },
    Side.SERVER: {
        State.IDLE: (
            {Error: State.FAILED},
            {Open: State.OPENED},
        ),
        State.OPENED: (
            {Opened: State.STREAMING, Error: State.FAILED},
            {Credit: State.OPENED, Stop: State.STOPPING},
        ),
        State.STREAMING: (
            {Segments: State.STREAMING, Layer: State.STREAMING, End: State.ENDED, Error: State.FAILED},
            {Credit: State.STREAMING, Stop: State.STOPPING},
        ),
        State.STOPPING: (
            {End: State.ENDED, Error: State.FAILED},
            {},
        ),
        State.ENDED: (
            {Error: State.FAILED},
            {Open: State.OPENED, Credit: State.ENDED, Stop: State.ENDED, Bye: State.CLOSED},
        ),
        State.CLOSED: ({}, {}),
        State.FAILED: (
            {},
            {
                Open: State.FAILED,
                Credit: State.FAILED,
                Stop: State.FAILED,
                Bye: State.FAILED,
            },
        ),
    },
}


class Connection:
    """One end of a stream.

    Parameters
    ----------
    side : Side
        Which end this is.
    most : int
        The most credit that the server keeps, `BASE_CREDIT` to `MAX_CREDIT`. A client learns it from the header.

    Attributes
    ----------
    state : State
        Current state of this side.
    credit : int
        Bytes of `Segments.data` that the server may still send (on the server), or that may still arrive (on the
        client). From 0 to `most`.
    most : int
    """

    def __init__(self, side: Side, most: int = BASE_CREDIT) -> None:
        self.side = side
        self.most = most
        self.state = State.IDLE
        self.credit = 0

    def send(self, event: Event) -> bytes:
        """Return the bytes of an event that this side sends now, and change the state.

        Raises
        ------
        LocalProtocolError
            If the event is not allowed now, or exceeds the credit; nothing has changed then.
        """
        moves = TRANSITIONS[self.side][self.state][0]
        if type(event) not in moves:
            raise LocalProtocolError(f"expected to send {self._allowed(moves)}, got {event.type}")
        if isinstance(event, Segments):
            self._spend(len(event.data))
        elif isinstance(event, Open):
            self.credit = 0  # the rest of the previous credit ended with the previous `Open`
            self._grant(event.credit, least=0)
        elif isinstance(event, Credit):
            self._grant(event.bytes, least=1)
        self.state = moves[type(event)]
        return serialize(event)

    def receive(self, message: bytes) -> Event:
        """Parse a message from the other side, and change the state; return the event.

        Raises
        ------
        MessageError
            If it is not a message, or not one that is allowed now. Nothing has changed then; a server may still send an
            `Error`.
        UnsupportedVersionError
            If the other side speaks another version.
        """
        event = parse(message)
        moves = TRANSITIONS[self.side][self.state][1]
        if type(event) not in moves:
            raise MessageError("out-of-turn", f"expected {self._allowed(moves)}, got {event.type}")
        if isinstance(event, Segments):
            if len(event.data) > self.credit:
                raise MessageError("out-of-turn", f"expected at most {self.credit} bytes, got {len(event.data)}")
            self.credit -= len(event.data)
        elif isinstance(event, Open):
            self.credit = min(event.credit, self.most)
        elif isinstance(event, Credit):
            # Credit beyond the cap is ignored, not refused: a client may grant generously.
            self.credit = min(self.credit + event.bytes, self.most)
        elif isinstance(event, Opened):
            self.most = min(event.credit or BASE_CREDIT, MAX_CREDIT)
        self.state = moves[type(event)]
        return event

    def _spend(self, size: int) -> None:
        """Deduct the bytes that this side sends from the credit."""
        most = min(self.credit, MAX_DATA)
        if not 0 < size <= most:
            raise LocalProtocolError(f"expected 1 to {most} bytes (the credit is {self.credit}), got {size}")
        self.credit -= size

    def _grant(self, size: int, least: int) -> None:
        """Add to the credit, within its cap."""
        most = self.most - self.credit
        if not least <= size <= most:
            raise LocalProtocolError(f"expected {least} to {most} bytes of credit on top of {self.credit}, got {size}")
        self.credit += size

    def _allowed(self, moves: _Moves) -> str:
        """Describe the events that are allowed now."""
        names = " or ".join(kind.type for kind in moves) or "nothing"
        return f"{names} (the {self.side.value} is {self.state.value})"
