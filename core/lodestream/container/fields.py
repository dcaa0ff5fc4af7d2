"""Fields of numbers: little-endian, integers in groups of seven bits (LEB128), floats without trailing zero bytes."""

from __future__ import annotations

import struct

from ..errors import CorruptStreamError

__all__ = ["LARGEST", "FieldReader", "FieldWriter", "told", "told_roughly"]

#: The largest whole number that a field holds.
LARGEST = 2**63 - 1
# A field of an error holds the highest bits below the sign of a float64: their number, and the field's bytes.
_ERROR_FIELD, _ROUGH_ERROR_FIELD = (31, 4), (16, 2)
_PATTERN, _FLOAT = struct.Struct(">Q"), struct.Struct(">d")
_INFINITY = 0x7FF << 52


def told(error: float) -> float:
    """Round an error up to the next number that a field of an error holds, or down to the largest it holds."""
    return _from_upper(_upper(error, _ERROR_FIELD[0]), _ERROR_FIELD[0])


def told_roughly(error: float) -> float:
    """Round an error as `told` does, for a field of two bytes."""
    return _from_upper(_upper(error, _ROUGH_ERROR_FIELD[0]), _ROUGH_ERROR_FIELD[0])


def _upper(error: float, bits: int) -> int:
    """Return the highest bits below the sign of a number of 0 or more, rounded up."""
    pattern, shift = int.from_bytes(struct.pack(">d", error)), 63 - bits
    return min(-(-pattern >> shift), (_INFINITY >> shift) - 1)


def _from_upper(upper: int, bits: int) -> float:
    """Return the float64 whose highest bits below the sign are given."""
    number: float = _FLOAT.unpack(_PATTERN.pack(upper << 63 - bits))[0]
    return number


class FieldWriter:
    """Collects fields into bytes."""

    def __init__(self) -> None:
        self.data = bytearray()

    def varint(self, number: int) -> None:
        """Write an integer of 0 to `LARGEST`: seven bits a byte, lowest first; the eighth bit says that more follow."""
        while number > 127:
            self.data.append(number & 127 | 128)
            number >>= 7
        self.data.append(number)

    def byte(self, number: int) -> None:
        """Write an integer of 0 to 255."""
        self.data.append(number)

    def pack(self, layout: str, *numbers: float) -> None:
        """Write numbers by a layout of `struct`, little-endian."""
        self.data += struct.pack("<" + layout, *numbers)

    def number(self, value: float) -> None:
        """Write a float64: a count of bytes, then so many bytes, the highest first; omitted bytes are 0."""
        pattern = struct.pack(">d", value).rstrip(b"\0")
        self.data.append(len(pattern))
        self.data += pattern

    def errors(self, *errors: float) -> None:
        """Write errors of 0 or more, each rounded up to what four bytes hold, see `told`."""
        for error in errors:
            self.data += _upper(error, _ERROR_FIELD[0]).to_bytes(_ERROR_FIELD[1], "little")

    def rough_errors(self, *errors: float) -> None:
        """Write errors of 0 or more, each rounded up to what two bytes hold, see `told_roughly`."""
        for error in errors:
            self.data += _upper(error, _ROUGH_ERROR_FIELD[0]).to_bytes(_ROUGH_ERROR_FIELD[1], "little")


class FieldReader:
    """Reads fields from bytes at ``offset`` of a container.

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

    @property
    def left(self) -> int:
        """Number of bytes that remain."""
        return len(self.data) - self.place

    def take(self, count: int) -> memoryview:
        """Read the next bytes.

        Raises
        ------
        CorruptStreamError
            If there are fewer.
        """
        if count > len(self.data) - self.place:
            raise CorruptStreamError(f"expected {count} more bytes, got {len(self.data) - self.place}", self.at)
        self.place += count
        return self.data[self.place - count : self.place]

    def byte(self) -> int:
        """Read an integer of 0 to 255.

        Raises
        ------
        CorruptStreamError
            If there is no byte left.
        """
        try:
            value = self.data[self.place]
        except IndexError:
            raise CorruptStreamError("expected 1 more bytes, got 0", self.at) from None
        self.place += 1
        return value

    def varint(self, limit: int = LARGEST) -> int:
        """Read an integer of at most ``limit``.

        Raises
        ------
        CorruptStreamError
            If it is larger, takes more than nine bytes, or the bytes end before it does.
        """
        byte = self.byte()
        if byte < 128 and byte <= limit:  # nearly always
            return byte
        start, number, shift = self.at - 1, byte & 127, 7
        while byte >= 128:
            byte = self.byte()
            number |= (byte & 127) << shift
            shift += 7
            if shift == 63 and byte >= 128:
                raise CorruptStreamError("expected a whole number of at most 9 bytes, got more", start)
        if number > limit:
            raise CorruptStreamError(f"expected a number of at most {limit}, got {number}", start)
        return number

    def unpack(self, layout: str) -> tuple[float, ...]:
        """Read numbers by a layout of `struct`, little-endian."""
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout)))

    def number(self) -> float:
        """Read a float64 without its trailing bytes, see `FieldWriter.number`; it may be infinite or NaN.

        Raises
        ------
        CorruptStreamError
            If it takes more than eight bytes, or the bytes end before it does.
        """
        start, count = self.at, self.byte()
        if count > 8:
            raise CorruptStreamError(f"expected at most 8 bytes of a float64, got {count}", start)
        (value,) = struct.unpack(">d", bytes(self.take(count)).ljust(8, b"\0"))
        return float(value)

    def errors(self) -> tuple[float, float]:
        """Read RMS and maximum error in four bytes each."""
        return self._errors(*_ERROR_FIELD)

    def rough_errors(self) -> tuple[float, float]:
        """Read RMS and maximum error in two bytes each."""
        return self._errors(*_ROUGH_ERROR_FIELD)

    def _errors(self, bits: int, size: int) -> tuple[float, float]:
        """Read two errors of ``bits`` bits in ``size`` bytes each."""
        start, limit = self.place, _INFINITY >> 63 - bits
        rms, worst = int.from_bytes(self.take(size), "little"), int.from_bytes(self.take(size), "little")
        if rms >= limit or worst >= limit:
            raise CorruptStreamError(
                f"expected errors of 0 or more, got the patterns {rms:x} and {worst:x}", self.offset + start
            )
        return _from_upper(rms, bits), _from_upper(worst, bits)

    def end(self) -> None:
        """Raise `CorruptStreamError` unless every byte was read."""
        if self.place != len(self.data):
            raise CorruptStreamError(
                f"expected the end of the section, got {len(self.data) - self.place} more bytes", self.at
            )
