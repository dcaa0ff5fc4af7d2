"""The messages of a stream, a frozen dataclass for each, and the error codes.

An event that one side sends is received as the same event by the other side. `wire` has the bytes of messages,
`connection` their order; `docs/protocol.md` is the specification.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, TypeAlias

from ..errors import RemoteProtocolError
from ..target import Target

__all__ = [
    "BASE_CREDIT",
    "CODES",
    "MAX_CREDIT",
    "MAX_DATA",
    "MAX_HELD",
    "MAX_MESSAGE",
    "MIN_WINDOW",
    "SUBPROTOCOL",
    "VERSION",
    "Bye",
    "Code",
    "Credit",
    "End",
    "Error",
    "Event",
    "Layer",
    "MessageError",
    "Open",
    "Opened",
    "Segments",
    "Stop",
]

#: The version that `Open` names; a server answers another one with ``unsupported-version``.
VERSION = 1

#: The WebSocket subprotocol that both sides agree on.
SUBPROTOCOL = "lodestream.v1"

#: The most bytes of a container in one `Segments`. A message cannot be interrupted: this is what a `stop` waits for.
MAX_DATA = 64 * 1024

#: The most bytes of a whole message, either way.
MAX_MESSAGE = MAX_DATA + 1024

#: The credit that every server keeps. TCP buffers hold megabytes before anyone notices; credit bounds what a slow
#: reader has in front of it, and what still arrives after a `stop`.
BASE_CREDIT = 256 * 1024

#: The most credit that a server keeps, if its `Opened` says so: enough for 640 Mbit/s over a round trip of 100 ms.
MAX_CREDIT = 8 * 1024 * 1024

#: What a client has outstanding at least, however slow the link is: below it, messages and their framing cost too much.
MIN_WINDOW = 16 * 1024

#: The most ranges of `Open.held`: they fit into one message, and subtracting them is no work.
MAX_HELD = 4096


@dataclass(frozen=True)
class Code:
    """An error code: its title, and the close code of the WebSocket after it."""

    close: int
    title: str


#: Error codes, and how the WebSocket is closed after each. Close codes of our own are 4000 plus the HTTP status that
#: says the same.
CODES: Mapping[str, Code] = {
    "bad-message": Code(4400, "Not a message of this protocol"),
    "out-of-turn": Code(4400, "The message is not allowed now"),
    "no-token": Code(4401, "A token is needed"),
    "bad-token": Code(4401, "The token is unknown, expired or revoked"),
    "small-scope": Code(4403, "The token's scope does not allow this"),
    "not-found": Code(4404, "There is no such thing"),
    "idle": Code(4408, "The client was silent, or did not read, for too long"),
    "not-ready": Code(4409, "The surface is still being built"),
    "other-container": Code(4412, "The surface has another container than the one held"),
    "bad-held": Code(4416, "The list of held slices is not valid"),
    "failed": Code(4409, "The surface could not be built"),
    "waiting": Code(4409, "The surface could not be built yet; it waits for a retry"),
    "bad-target": Code(4422, "The surface cannot meet the target"),
    "unsupported-version": Code(4426, "Another version of the protocol"),
    "too-many": Code(4429, "The client has too much in progress"),
    "message-too-large": Code(1009, "The message is too large"),
    "damaged": Code(4500, "The stored container is damaged"),
    "busy": Code(4503, "The server is busy; try again later"),
    "internal": Code(1011, "The server failed"),
    "restarting": Code(1012, "The server is restarting; try again"),
}


class MessageError(RemoteProtocolError):
    """The other side sent something that the protocol does not allow; `code` is the answer to send.

    Attributes
    ----------
    code : str
        Key of `CODES`.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True)
class Open:
    """From the client: what it wants, what it holds, and its first credit. Sent first, and again after an `End`.

    Attributes
    ----------
    target : Target
        What to send, where to stop, and in which order; ``seconds`` is not sent to the server.
    credit : int
        First credit, in bytes of `Segments.data`.
    held : tuple of (offset, length)
        Slices of the container that the client holds, at most `MAX_HELD`. After an `End`, if neither they nor
        `container` are given, the slices sent over this connection count as held.
    container : str or None
        SHA-256 of the container that these slices belong to.
    token : str or None
        For a client that cannot send a header with the handshake, such as a browser; not allowed in an address.
    window_errors : bool or None
        True: of a window, the client knows bounds of errors, and takes the section that has them.
    decodes : bool or None
        True: the client reads from the data where layers end, so it gets no `Layer`, and `Segments` that go on across
        their ends once its credit is large.
    """

    type: ClassVar[str] = "open"
    target: Target = field(default_factory=Target)
    credit: int = BASE_CREDIT
    held: tuple[tuple[int, int], ...] = ()
    container: str | None = None
    token: str | None = field(default=None, repr=False)
    window_errors: bool | None = None
    decodes: bool | None = None


@dataclass(frozen=True)
class Credit:
    """From the client: this many more bytes of `Segments.data` may be sent."""

    type: ClassVar[str] = "credit"
    bytes: int


@dataclass(frozen=True)
class Stop:
    """From the client: stop sending; only `End` may follow."""

    type: ClassVar[str] = "stop"


@dataclass(frozen=True)
class Bye:
    """From the client: the answer to `End`; the server then closes."""

    type: ClassVar[str] = "bye"


@dataclass(frozen=True)
class Opened:
    """From the server: which container is sent, and how much of it.

    Attributes
    ----------
    container : str
        SHA-256 of the container, 64 hexadecimal digits.
    size : int
        Bytes of the whole container.
    planned : int
        Bytes of the surface (header, layers, residual) that the target needs, including cached ones; index and metadata
        are not counted.
    extent : float
        Unit of relative tolerances: the range of the heights, or the diagonal of the bounding box.
    index, metadata : (offset, length)
        Places of these two sections.
    prefix : bool
        True if the file is sent from its first byte on (cached slices left out), then the metadata. False if the index
        comes first, then slices.
    credit : int or None
        The most credit that the server keeps for this stream; None: `BASE_CREDIT`.
    window_errors : (offset, length) or None
        Of a window: the section with bounds of its errors, which comes behind the index, or a length of 0 where the
        container has none. None: the server tells no errors of windows before their end.
    channels : bool or None
        True: the server stops by the errors of channels that the target names. None: it names none, or the server does
        not know them and sends everything.
    """

    type: ClassVar[str] = "header"
    container: str
    size: int
    planned: int
    extent: float
    index: tuple[int, int]
    metadata: tuple[int, int]
    prefix: bool
    credit: int | None = None
    window_errors: tuple[int, int] | None = None
    channels: bool | None = None


@dataclass(frozen=True)
class Segments:
    """From the server: a slice of the container that starts at ``offset``."""

    type: ClassVar[str] = "segments"
    offset: int
    data: bytes = field(repr=False)


@dataclass(frozen=True)
class Layer:
    """From the server: a layer (quality order) or a level (level order) is complete with what was sent so far.

    A client that decodes gets none, see `Open.decodes`.
    ``number`` counts layers or levels from 0. ``bytes``, ``rms`` and ``max`` are those recorded in the container. If a
    region comes first, the message is sent when the layer is complete in the region, and again when it is complete
    everywhere. While the client has been sent more than belongs to the layer, ``rms`` and ``max`` are NaN, and
    ``bytes`` counts all that is cached.
    """

    type: ClassVar[str] = "layer"
    number: int
    level: int
    bytes: int
    rms: float
    max: float


@dataclass(frozen=True)
class End:
    """From the server: nothing more will be sent, and why: complete, level, rms, max, bytes or stopped."""

    type: ClassVar[str] = "end"
    why: str


@dataclass(frozen=True)
class Error:
    """From the server: it refuses, and closes the WebSocket with the code's close code."""

    type: ClassVar[str] = "error"
    code: str
    title: str
    detail: str


Event: TypeAlias = Open | Credit | Stop | Bye | Opened | Segments | Layer | End | Error
