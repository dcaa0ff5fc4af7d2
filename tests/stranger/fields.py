"""Section 1 of the page: numbers and bytes, one after another."""

from __future__ import annotations

import struct


class DamagedError(ValueError):
    """The bytes are not those of a container, or not of one that this reader knows."""


class Fields:
    """Reads one field after another."""

    def __init__(self, data: bytes, position: int = 0) -> None:
        self.data = data
        self.position = position

    def take(self, count: int) -> bytes:
        """The next bytes as they are."""
        if count > len(self.data) - self.position:
            raise DamagedError("the bytes end within a field")
        self.position += count
        return self.data[self.position - count : self.position]

    def rest(self) -> bytes:
        """All bytes that are left."""
        return self.take(len(self.data) - self.position)

    def number(self, layout: str) -> int:
        """A whole number of fixed size."""
        (value,) = struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))
        return int(value)

    def f64(self) -> float:
        """A binary64."""
        (value,) = struct.unpack("<d", self.take(8))
        return float(value)

    def varint(self) -> int:
        """A varint: seven bits a byte, at most nine bytes."""
        value = 0
        for place in range(9):
            byte = self.number("B")
            value |= (byte & 127) << 7 * place
            if byte < 128:
                return value
        raise DamagedError("a varint of more than nine bytes")

    def finish(self) -> None:
        """Nothing may be left."""
        if self.position != len(self.data):
            raise DamagedError("bytes are left over")
