"""WebSockets with nothing between a test and the bytes, and an honest reader made of them."""

from __future__ import annotations

import asyncio
import hashlib
import os
import struct
from base64 import b64encode
from collections.abc import Iterator
from dataclasses import dataclass, field
from urllib.parse import urlsplit

from lodestream import Target
from lodestream.protocol.messages import BASE_CREDIT, SUBPROTOCOL, Bye, Credit, End, Error, Open, Opened, Segments
from lodestream.protocol.wire import parse, serialize

__all__ = [
    "BINARY",
    "CHUNKS",
    "CLOSE",
    "CONTINUATION",
    "PING",
    "PONG",
    "Frames",
    "Place",
    "Reader",
    "chunked",
    "frame",
    "handshake",
    "read_stream",
]

CONTINUATION, TEXT, BINARY, CLOSE, PING, PONG = 0, 1, 2, 8, 9, 10

#: A body in chunks of a byte, without its end.
CHUNKS = b"1\r\na\r\n" * 40_000


@dataclass(frozen=True)
class Place:
    """Where a surface is: what its URL says."""

    host: str
    port: int
    path: str

    @classmethod
    def of(cls, url: str) -> Place:
        """The place that a URL names."""
        parts = urlsplit(url)
        assert parts.hostname is not None
        assert parts.port is not None
        return cls(parts.hostname, parts.port, parts.path)


def handshake(place: Place) -> bytes:
    """What a client says first."""
    key = b64encode(os.urandom(16)).decode()
    lines = (
        f"GET {place.path}/stream HTTP/1.1",
        f"Host: {place.host}:{place.port}",
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        f"Sec-WebSocket-Key: {key}",
        f"Sec-WebSocket-Protocol: {SUBPROTOCOL}",
    )
    return "\r\n".join((*lines, "", "")).encode()


def chunked(request: bytes = b"POST /v1/surfaces") -> bytes:
    """The head of a request whose body comes in chunks."""
    return request + b" HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n"


def frame(data: bytes, opcode: int = BINARY, *, last: bool = True) -> bytes:
    """A client's frame, the last of its message or not: masked, as it has to be, with a mask that changes nothing."""
    if len(data) < 126:
        length = bytes([0x80 | len(data)])
    else:
        length = b"\xfe" + struct.pack(">H", len(data)) if len(data) < 65536 else b"\xff" + struct.pack(">Q", len(data))
    return bytes([0x80 * last | opcode]) + length + bytes(4) + data


class Frames:
    """A server's frames out of any chunking of their bytes."""

    def __init__(self) -> None:
        self._data = bytearray()

    def feed(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Take bytes; opcode and payload of each frame that is whole now."""
        self._data += data
        while len(self._data) >= 2:
            size, start = self._data[1], 2
            if size == 126:
                size, start = int.from_bytes(self._data[2:4], "big"), 4
            elif size == 127:
                size, start = int.from_bytes(self._data[2:10], "big"), 10
            if len(self._data) < start + size:
                return
            opcode, payload = self._data[0] & 15, bytes(self._data[start : start + size])
            del self._data[: start + size]
            yield opcode, payload


@dataclass
class Reader:
    """An honest client without I/O: bytes in, bytes out. It keeps the hash of what came in place of what came.

    Attributes
    ----------
    size : int
        Bytes of the container that came.
    ended : str or None
        Why the server has sent its last.
    closed : int or None
        The close code.
    """

    target: Target = field(default_factory=Target)
    window: int = BASE_CREDIT
    size: int = 0
    ended: str | None = None
    closed: int | None = None
    container: str = ""
    expected: int = 0

    def __post_init__(self) -> None:
        self._frames = Frames()
        self._digest = hashlib.sha256()
        self._head: bytes | None = b""
        self._ungranted = 0

    @property
    def sha256(self) -> str:
        """Hash of the bytes so far, in the order in which they came."""
        return self._digest.hexdigest()

    def start(self) -> bytes:
        """What to send once the handshake is answered."""
        return frame(serialize(Open(self.target, self.window)))

    def receive(self, data: bytes) -> bytes:
        """Take what came; what to send now."""
        if self._head is not None:
            head, found, data = (self._head + data).partition(b"\r\n\r\n")
            if not found:
                self._head = head
                return b""
            if not head.startswith(b"HTTP/1.1 101"):
                raise ConnectionError(f"expected the handshake to be answered, got {head[:200]!r}")
            self._head = None
            return self.start() + self.receive(data)
        return b"".join(self._answer(opcode, payload) for opcode, payload in self._frames.feed(data))

    def _answer(self, opcode: int, payload: bytes) -> bytes:
        if opcode == PING:
            return frame(payload, PONG)
        if opcode == CLOSE:
            self.closed = int.from_bytes(payload[:2], "big")
            return frame(payload, CLOSE)
        if opcode != BINARY:
            raise ConnectionError(f"expected a binary message, got opcode {opcode}")
        event = parse(payload)
        if isinstance(event, Segments):
            return self._take(event)
        if isinstance(event, Opened):
            self.container, self.expected = event.container, event.size
        elif isinstance(event, End):
            self.ended = event.why
            return frame(serialize(Bye()))
        elif isinstance(event, Error):
            raise ConnectionError(f"expected a stream, got {event.code}: {event.detail}")
        return b""

    def _take(self, event: Segments) -> bytes:
        self._digest.update(event.data)
        self.size += len(event.data)
        self._ungranted += len(event.data)
        if self._ungranted * 4 < self.window:
            return b""
        granted, self._ungranted = self._ungranted, 0
        return frame(serialize(Credit(granted)))


async def read_stream(place: Place, reader: Reader, source: str | None = None) -> Reader:
    """Read a surface to its end; from another address of this machine, if one is given."""
    local = None if source is None else (source, 0)
    incoming, outgoing = await asyncio.open_connection(place.host, place.port, local_addr=local)
    try:
        outgoing.write(handshake(place))
        while reader.closed is None:
            data = await incoming.read(65536)
            if not data:
                raise ConnectionError(f"expected a close frame, got {reader.size} bytes and nothing more")
            outgoing.write(reader.receive(data))
            await outgoing.drain()
    finally:
        outgoing.close()
    return reader
