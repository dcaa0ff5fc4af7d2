"""Fields of a payload, one after another: section 1 of docs/format.md."""

import struct
import zlib
from typing import Any, NamedTuple

import msgpack

from lodestream.errors import CorruptStreamError


class Errors(NamedTuple):
    """Errors of a reconstruction, in the surface's unit.

    `rms`, `maximum` (float): of the distances over the coordinates; `channels` (tuple of (float, float)): both of each
    channel; empty where there is only one channel.
    """

    rms: float
    maximum: float
    channels: tuple[tuple[float, float], ...]


class Fields:
    """Reads the fields of some bytes; nothing is read beyond their end.

    `data` (bytes): what is read; `offset` (int): where it begins in the container, in bytes, for messages of errors.
    Raises CorruptStreamError if from every method, if the bytes end too early or hold no such field.
    """

    def __init__(self, data: bytes, offset: int = 0) -> None:
        self.data = data
        self.position = 0
        self.offset = offset

    def damaged(self, message: str) -> CorruptStreamError:
        """Make the error that says what is wrong, at this place in the container."""
        return CorruptStreamError(message, self.offset + self.position)

    def require(self, right: bool, message: str) -> None:
        """Raise that error unless something is right."""
        if not right:
            raise self.damaged(message)

    @property
    def left(self) -> int:
        """Bytes that are not read yet."""
        return len(self.data) - self.position

    def take(self, count: int) -> bytes:
        """Read the next `count` bytes."""
        if count > self.left:
            raise self.damaged(f"{count} bytes are announced, and {self.left} are there")
        self.position += count
        return self.data[self.position - count : self.position]

    def number(self, kind: str) -> Any:
        """Read a little-endian number of fixed size, by its letter in `struct`."""
        return struct.unpack("<" + kind, self.take(struct.calcsize("<" + kind)))[0]

    def u8(self) -> int:
        """Read an unsigned byte."""
        return self.take(1)[0]

    def varint(self) -> int:
        """Read an unsigned LEB128 number of at most nine bytes."""
        value = 0
        for shift in range(0, 63, 7):
            byte = self.u8()
            value |= (byte & 127) << shift
            if byte < 128:
                return value
        raise self.damaged("a number has more than nine bytes")

    def count(self, each: int = 1, most: int | None = None) -> int:
        """Read a varint that counts things of at least `each` bytes, which must be there; at most so many."""
        value = self.varint()
        self.require(most is None or value <= most, f"{value} entries; a container has at most {most}")
        if value * each > self.left:
            raise self.damaged(f"{value} entries are announced in {self.left} bytes")
        return value

    def real(self) -> float:
        """Read a binary64 without its last bytes; it must be finite."""
        size = self.u8()
        if size > 8:
            raise self.damaged(f"a number of {size} bytes")
        return self._finite(self.take(size).ljust(8, b"\0"))

    def error(self) -> float:
        """Read an error given as the upper half of a binary64."""
        return self._finite(self.take(4)[::-1] + bytes(4), positive=True)

    def rough(self) -> float:
        """Read an error given as bits 47 to 62 of a binary64."""
        return self._finite((self.number("H") << 47).to_bytes(8, "big"), positive=True)

    def _finite(self, pattern: bytes, positive: bool = False) -> float:
        value: float = struct.unpack(">d", pattern)[0]
        if not abs(value) < float("inf") or (positive and pattern[0] & 128):
            raise self.damaged("a number is not finite, or an error is negative")
        return value

    def errors(self, channels: int) -> Errors:
        """Read errors of a surface of so many channels: section 3."""
        rms, maximum = self.error(), self.error()
        return Errors(rms, maximum, tuple((self.rough(), self.rough()) for _ in range(channels if channels > 1 else 0)))

    def end(self) -> None:
        """Refuse bytes that are left over."""
        if self.left:
            raise self.damaged(f"{self.left} bytes more than there are fields")


def crc(data: bytes) -> int:
    """Compute the CRC-32 of zlib and PNG."""
    return zlib.crc32(data)


def unpack_map(data: bytes, offset: int) -> dict[str, Any]:
    """Read a MessagePack map whose keys are strings; raises CorruptStreamError."""
    try:
        value = msgpack.unpackb(data, raw=False, strict_map_key=False)
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise CorruptStreamError(f"no MessagePack: {error}", offset) from None
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise CorruptStreamError("no MessagePack map from strings", offset)
    return value
