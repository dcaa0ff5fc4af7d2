"""The messages of a stream, one frozen dataclass each, and the codes of its errors.

What one side sends as an event, the other receives as the same event. `wire` has their bytes, `protocol` their order,
`docs/protocol.md` is the manual.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, TypeAlias

from .errors import RemoteProtocolError
from .target import Target

__all__ = [
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
    "Header",
    "Layer",
    "MessageError",
    "Open",
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

#: The most credit that may be outstanding. TCP buffers hold megabytes before anyone notices; this bounds what a slow
#: reader has in front of it, and what still arrives after a `stop`.
MAX_CREDIT = 256 * 1024

#: What a client has outstanding at least, however slow the link is: below it, messages and their framing cost too much.
MIN_WINDOW = 16 * 1024

#: The most ranges of `Open.held`: they fit into one message, and subtracting them is no work.
MAX_HELD = 4096


@dataclass(frozen=True)
class Code:
    """What an error code means: its title, and the close code of the WebSocket after it."""

    close: int
    title: str


#: Error codes, and how the WebSocket is closed after each. Close codes of our own are 4000 plus the HTTP status that
#: says the same.
CODES: Mapping[str, Code] = {
    "bad-message": Code(4400, "Not a message of this protocol"),
    "out-of-turn": Code(4400, "A message that is not allowed now"),
    "no-token": Code(4401, "A token is needed"),
    "bad-token": Code(4403, "A token that is not known, or no longer, or that does not allow it"),
    "not-found": Code(4404, "No such surface"),
    "idle": Code(4408, "Nothing was heard or taken for too long"),
    "not-ready": Code(4409, "The surface is still being built"),
    "other-container": Code(4412, "The surface has another container than the one held"),
    "bad-held": Code(4416, "A list of what is held that cannot be"),
    "failed": Code(4424, "The surface could not be built"),
    "waiting": Code(4424, "The surface could not be built yet; somebody has to ask for another attempt"),
    "bad-target": Code(4422, "A target that the surface cannot meet"),
    "unsupported-version": Code(4426, "Another version of the protocol"),
    "too-many": Code(4429, "More at the same time than one client may have"),
    "message-too-large": Code(1009, "A message above the limit"),
    "damaged": Code(4500, "The stored container is damaged"),
    "busy": Code(4503, "As much to do as the server can; come back"),
    "missing": Code(4503, "The surface is not on the server's disk now"),
    "internal": Code(1011, "The server failed"),
    "restarting": Code(1012, "The server is restarting; come back"),
}


class MessageError(RemoteProtocolError):
    """The other side sent what the protocol does not allow; `code` says which answer it gets.

    Attributes
    ----------
    code : str
        Word from `CODES`.
    """

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True)
class Open:
    """Client: what it wants, what it holds, and how much may be sent at once; at the start, and again after an `End`.

    Attributes
    ----------
    target : Target
        Where to stop and the order on the way there; ``seconds`` stays with the client and does not travel.
    credit : int
        First credit, in bytes of `Segments.data`.
    held : tuple of (offset, length)
        Slices of the container that the client holds already, at most `MAX_HELD`. With neither them nor `container`,
        after an `End`, those that were sent over this connection.
    container : str or None
        SHA-256 of the container that they are slices of.
    token : str or None
        For a client that cannot send a header with the handshake, as in a browser; never in an address.
    """

    type: ClassVar[str] = "open"
    target: Target = field(default_factory=Target)
    credit: int = MAX_CREDIT
    held: tuple[tuple[int, int], ...] = ()
    container: str | None = None
    token: str | None = field(default=None, repr=False)


@dataclass(frozen=True)
class Credit:
    """Client: so many more bytes of `Segments.data` may be sent."""

    type: ClassVar[str] = "credit"
    bytes: int


@dataclass(frozen=True)
class Stop:
    """Client: enough; nothing but `End` is to follow."""

    type: ClassVar[str] = "stop"


@dataclass(frozen=True)
class Bye:
    """Client: the answer to `End`; the server closes."""

    type: ClassVar[str] = "bye"


@dataclass(frozen=True)
class Header:
    """Server: which container is being sent, and how much of it.

    Attributes
    ----------
    container : str
        SHA-256 of the container, 64 hexadecimal digits.
    size : int
        Bytes of the whole container.
    planned : int
        Bytes of the surface (header, layers, exactness) that the target needs, held ones included; index and metadata
        are not counted.
    extent : float
        What a relative tolerance refers to: the range of the heights, or the diagonal of the box.
    index, metadata : (offset, length)
        Where these two sections stand.
    prefix : bool
        What is sent, and what was held of it, is the file from its first byte on, then the metadata; otherwise the
        index comes first and slices follow.
    """

    type: ClassVar[str] = "header"
    container: str
    size: int
    planned: int
    extent: float
    index: tuple[int, int]
    metadata: tuple[int, int]
    prefix: bool


@dataclass(frozen=True)
class Segments:
    """Server: the slice of the container that starts at ``offset``."""

    type: ClassVar[str] = "segments"
    offset: int
    data: bytes = field(repr=False)


@dataclass(frozen=True)
class Layer:
    """Server: with what has been sent so far, a layer (quality order) or a level (level order) is complete.

    ``number`` counts layers or levels from 0; ``bytes``, ``rms`` and ``max`` are those of the container's own record.
    Where a region comes first it is complete there first, then everywhere; while more is held than belongs to it,
    ``rms`` and ``max`` are NaN, and ``bytes`` are what is held.
    """

    type: ClassVar[str] = "layer"
    number: int
    level: int
    bytes: int
    rms: float
    max: float


@dataclass(frozen=True)
class End:
    """Server: no more will be sent, and why: complete, level, rms, max, bytes or stopped."""

    type: ClassVar[str] = "end"
    why: str


@dataclass(frozen=True)
class Error:
    """Server: it refuses; the WebSocket is closed with the code's close code."""

    type: ClassVar[str] = "error"
    code: str
    title: str
    detail: str


Event: TypeAlias = Open | Credit | Stop | Bye | Header | Segments | Layer | End | Error
