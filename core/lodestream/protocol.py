"""One end of a stream without I/O: whose turn it is, and how much may be in flight.

A `Connection` is fed with messages and says which events they are; it is told events and gives the messages to send. It
knows turns, credit and ends; it knows neither sockets nor clocks nor what the bytes of a container mean.

The machine
-----------
The client opens, the server answers with a header, then sends slices and figures as far as credit goes, then ends; the
client opens again, for something else of the same surface, or says bye; the server closes. Two things make it more than
a list of steps:

- *Messages cross.* A ``credit`` or ``stop`` may be under way while the server ends by itself, and slices are under way
  when the client stops. So each side has its own table: after its own ``stop`` the client still takes what comes until
  ``end``; after its own ``end`` the server still takes these two until ``open`` or ``bye``.
- *Stop takes effect at once.* Once the server has heard ``stop``, its table allows ``end`` and nothing else. A client
  that has stopped is in one of two states, since it may stop before the header has come, and must not take two.

An ``error`` is the server's last word in any state; what the client still had under way is then taken and ignored.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import TypeAlias

from .errors import LocalProtocolError
from .messages import (
    MAX_CREDIT,
    MAX_DATA,
    Bye,
    Credit,
    End,
    Error,
    Event,
    Header,
    Layer,
    MessageError,
    Open,
    Segments,
    Stop,
)
from .wire import parse, serialize

__all__ = ["TRANSITIONS", "Connection", "Side", "State"]


class Side(Enum):
    """Which end of the stream."""

    CLIENT = "client"
    SERVER = "server"


class State(Enum):
    """Where a side is; `TRANSITIONS` says what leads where."""

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
            {Header: State.STREAMING, Error: State.FAILED},
        ),
        State.STREAMING: (
            {Credit: State.STREAMING, Stop: State.STOPPING},
            {Segments: State.STREAMING, Layer: State.STREAMING, End: State.ENDED, Error: State.FAILED},
        ),
        State.WITHDRAWN: (
            {},
            {Header: State.STOPPING, End: State.ENDED, Error: State.FAILED},
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
            {Header: State.STREAMING, Error: State.FAILED},
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

    Attributes
    ----------
    state : State
        Where this side is.
    credit : int
        Bytes of `Segments.data` that the server may still send (server), or that may still arrive (client). Never
        negative, never above `MAX_CREDIT`.
    """

    def __init__(self, side: Side) -> None:
        self.side = side
        self.state = State.IDLE
        self.credit = 0

    def send(self, event: Event) -> bytes:
        """The message for an event that this side sends now.

        Raises
        ------
        LocalProtocolError
            When it is not allowed now, or goes beyond the credit; nothing has changed then.
        """
        moves = TRANSITIONS[self.side][self.state][0]
        if type(event) not in moves:
            raise LocalProtocolError(f"expected to send {self._allowed(moves)}, got {event.type}")
        if isinstance(event, Segments):
            self._spend(len(event.data))
        elif isinstance(event, Open):
            self.credit = 0  # what was left of the last one's ended with it
            self._grant(event.credit, least=0)
        elif isinstance(event, Credit):
            self._grant(event.bytes, least=1)
        self.state = moves[type(event)]
        return serialize(event)

    def receive(self, message: bytes) -> Event:
        """The event that a message from the other side stands for.

        Raises
        ------
        MessageError
            When it is not a message, or not one that is allowed now. Nothing has changed then; a server may still send
            an `Error`.
        UnsupportedVersionError
            When the other side speaks another version.
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
            self.credit = min(event.credit, MAX_CREDIT)
        elif isinstance(event, Credit):
            # What goes beyond the cap is forgotten rather than refused: a client that grants generously loses nothing.
            self.credit = min(self.credit + event.bytes, MAX_CREDIT)
        self.state = moves[type(event)]
        return event

    def _spend(self, size: int) -> None:
        most = min(self.credit, MAX_DATA)
        if not 0 < size <= most:
            raise LocalProtocolError(f"expected 1 to {most} bytes (the credit is {self.credit}), got {size}")
        self.credit -= size

    def _grant(self, size: int, least: int) -> None:
        most = MAX_CREDIT - self.credit
        if not least <= size <= most:
            raise LocalProtocolError(f"expected {least} to {most} bytes of credit on top of {self.credit}, got {size}")
        self.credit += size

    def _allowed(self, moves: _Moves) -> str:
        names = " or ".join(kind.type for kind in moves) or "nothing"
        return f"{names} (the {self.side.value} is {self.state.value})"
