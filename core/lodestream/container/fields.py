"""Numbers in bytes: little-endian, and whole numbers of any size in groups of seven bits (LEB128)."""

from __future__ import annotations

import struct

from ..errors import CorruptStreamError

__all__ = ["FieldReader", "FieldWriter"]


class FieldWriter:
    """Collects fields into bytes."""

    def __init__(self) -> None:
        self.data = bytearray()

    def varint(self, number: int) -> None:
        """A whole number of 0 or more: seven bits a byte, least significant first; the eighth bit: more follow."""
        while number > 127:
            self.data.append(number & 127 | 128)
            number >>= 7
        self.data.append(number)

    def byte(self, number: int) -> None:
        """A whole number of 0 to 255."""
        self.data.append(number)

    def pack(self, layout: str, *numbers: float) -> None:
        """Numbers by a layout of `struct`, little-endian."""
        self.data += struct.pack("<" + layout, *numbers)


class FieldReader:
    """Takes fields from bytes that stand at ``offset`` of a container.

    Every method raises `CorruptStreamError` where the bytes end too early.
    """

    def __init__(self, data: bytes | memoryview, offset: int) -> None:
        self.data = memoryview(data)
        self.offset = offset
        self.place = 0

    @property
    def at(self) -> int:
        """Offset in the container of the next field."""
        return self.offset + self.place

    def take(self, count: int) -> memoryview:
        """The next bytes."""
        if count > len(self.data) - self.place:
            raise CorruptStreamError(f"expected {count} more bytes, got {len(self.data) - self.place}", self.at)
        self.place += count
        return self.data[self.place - count : self.place]

    def byte(self) -> int:
        """A whole number of 0 to 255."""
        if self.place == len(self.data):
            raise CorruptStreamError("expected 1 more bytes, got 0", self.at)
        self.place += 1
        return self.data[self.place - 1]

    def varint(self, limit: int) -> int:
        """A whole number that must not exceed ``limit``."""
        start, number, shift = self.at, 0, 0
        while True:
            byte = self.byte()
            number |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                break
            if shift > 63:
                raise CorruptStreamError("expected a whole number of at most 9 bytes, got more", start)
        if number > limit:
            raise CorruptStreamError(f"expected a number of at most {limit}, got {number}", start)
        return number

    def unpack(self, layout: str) -> tuple[float, ...]:
        """Numbers by a layout of `struct`, little-endian."""
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def end(self) -> None:
        """Raises `CorruptStreamError` unless every byte was taken."""
        if self.place != len(self.data):
            raise CorruptStreamError(
                f"expected the end of the section, got {len(self.data) - self.place} more bytes", self.at
            )
