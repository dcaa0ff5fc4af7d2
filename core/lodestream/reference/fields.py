"""Section 1 of docs/format.md: numbers and bytes, one after another."""

from __future__ import annotations

import struct

from ..errors import StreamError

__all__ = ["Fields"]


class Fields:
    """Reads one field after another, from a position of the bytes on."""

    def __init__(self, data: bytes, position: int = 0) -> None:
        self.data = data
        self.position = position

    def take(self, count: int) -> bytes:
        """The next bytes as they are; StreamError where there are fewer, as of everything here."""
        if not 0 <= count <= len(self.data) - self.position:
            raise StreamError(f"expected {count} bytes, got {len(self.data) - self.position}")
        self.position += count
        return self.data[self.position - count : self.position]

    def rest(self) -> bytes:
        """All bytes that are left."""
        return self.take(len(self.data) - self.position)

    def number(self, layout: str) -> int:
        """An integer of fixed size, by its letter of `struct`."""
        (value,) = struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))
        return int(value)

    def f64(self) -> float:
        """A binary64."""
        (value,) = struct.unpack("<d", self.take(8))
        return float(value)

    def short_f64(self) -> float:
        """A binary64 of which the last bytes are left out."""
        highest = self.take(self.number("B"))
        if len(highest) > 8:
            raise StreamError(f"expected at most 8 bytes of a binary64, got {len(highest)}")
        (value,) = struct.unpack(">d", highest + bytes(8 - len(highest)))
        return float(value)

    def error(self) -> float:
        """The upper half of a binary64."""
        (value,) = struct.unpack("<d", bytes(4) + self.take(4))
        return float(value)

    def rough(self) -> float:
        """Sixteen bits of a binary64, below its sign."""
        (value,) = struct.unpack("<d", (self.number("H") << 47).to_bytes(8, "little"))
        return float(value)

    def varint(self) -> int:
        """A varint: seven bits a byte, at most nine bytes."""
        value = 0
        for place in range(9):
            byte = self.number("B")
            value |= (byte & 127) << 7 * place
            if byte < 128:
                return value
        raise StreamError("expected a varint of at most nine bytes, got more")

    def finish(self) -> None:
        """Nothing may be left."""
        if self.position != len(self.data):
            raise StreamError(f"expected the end, got {len(self.data) - self.position} bytes more")
