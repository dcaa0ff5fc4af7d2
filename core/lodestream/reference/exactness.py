"""Sections 9, 9.1 and 9.2 of docs/format.md: from the values of the complete layers to those that were written."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StreamError
from .fields import Fields
from .offsets import with_offsets
from .range_coder import Model, clamp

__all__ = ["restore"]

RAW, DECIMALS, OFFSETS = 0, 2, 3
MEMORY = 16384
SPREAD = 0x9E3779B97F4A7C15
SAFE = 2**53


def _signed(number: int) -> int:
    """An integer modulo 2^64, as a signed one."""
    return (number + 2**63) % 2**64 - 2**63


class _Line:
    """Section 9.1: the places of values of a type, by a rule and its argument."""

    def __init__(self, dtype: np.dtype[Any], rule: int, t: int) -> None:
        self.dtype = dtype
        self.t = t
        self.bits = 8 * dtype.itemsize
        self.in_decimals = rule == DECIMALS
        self.in_patterns = dtype.kind == "f" and not self.in_decimals
        self.mantissa = 52 if self.bits == 64 else 23  # bits, of a float
        if t >= (16 if self.in_decimals else self.bits) or (self.in_decimals and dtype.kind != "f"):
            raise StreamError(f"expected a rule of exactness for {dtype}, got rule {rule} with {t}")

    def _pattern(self, value: Any) -> int:
        return int(value.view(f"u{self.dtype.itemsize}"))

    def place(self, value: Any) -> int:
        """Where a value is."""
        if self.in_decimals:
            return round(min(max(float(value) * 10.0**self.t, -SAFE), SAFE))
        if not self.in_patterns:
            return _signed(int(value)) >> self.t
        pattern = self._pattern(value)
        m = (pattern & (1 << self.bits - 1) - 1) >> self.t
        return -1 - m if pattern >> self.bits - 1 else m

    def exponent(self, value: Any) -> int:
        """The exponent field of a float's pattern, otherwise 0."""
        if not self.in_patterns:
            return 0
        return self._pattern(value) >> self.mantissa & (1 << self.bits - 1 - self.mantissa) - 1

    def value(self, place: int) -> bytes:
        """The value at a place, little-endian."""
        if self.in_decimals:
            return np.array(clamp(place, -SAFE, SAFE) / 10.0**self.t).astype(self.dtype).tobytes()
        sign = 0
        if self.in_patterns and place < 0:
            place, sign = -1 - place, 1 << self.bits - 1
        pattern = (place << self.t) % (1 << self.bits - int(self.in_patterns))
        return (pattern | sign).to_bytes(self.dtype.itemsize, "little")


class _Differences:
    """Section 9.2: the values of a piece, one after another."""

    def __init__(self, line: _Line, fields: Fields) -> None:
        packed = fields.number("H")
        self.line = line
        self.most = packed & 4095
        self.specials = [fields.take(line.dtype.itemsize) for _ in range(packed >> 12)]
        self.model = Model(fields.take(fields.varint()))
        self.stored = fields.rest()
        self.taken = 0  # bits of what is stored
        self.last_two = 0  # bits that said whether a value is special, as one number
        self.memory: dict[int, tuple[int, int]] = {}  # entry -> place, difference

    def value(self, x: Any) -> bytes:
        """The value sought where the layers gave x."""
        if self.specials:
            bit = self.model.bit("special", self.last_two)
            self.last_two = 2 * (self.last_two & 1) + bit
            if bit:
                k = 1
                while k < len(self.specials) and self.model.bit("which", k):
                    k += 1
                return self.specials[k - 1]
        place = self.line.place(x)
        entry = (place * SPREAD % 2**64 >> 40) & (MEMORY - 1)
        remembered = self.memory.get(entry)
        z: int | None = None
        if remembered is not None and remembered[0] == place:
            if self.model.bit("same"):
                z = remembered[1]
            elif self.model.bit("close"):
                z = remembered[1] - 8 + self.model.number(4, "beside")
        if z is None:
            z = self._coded(clamp(self.most - self.line.exponent(x), 0, 63))
        self.memory[entry] = place, z
        return self.line.value(_signed(place + z))

    def _take(self, count: int) -> int:
        """The next stored bits as a number, its lowest bit first; 0 where there are none."""
        first, end = self.taken, self.taken + count
        self.taken = end
        return int.from_bytes(self.stored[first // 8 : (end + 7) // 8], "little") >> first % 8 & (1 << count) - 1

    def _coded(self, limit: int) -> int:
        c = limit
        while c > 0 and self.model.bit("shorter", 16 * min(limit, 15) + min(limit - c, 15)):
            c -= 1
        if c == 0:
            return 0
        magnitude, r = 1, c - 1
        while r > 32:
            magnitude = magnitude << 32 | self._take(32)
            r -= 32
        last = self._take(r + 1)
        magnitude = magnitude << r | last >> 1
        return -magnitude if last & 1 else magnitude


def restore(piece: bytes, values: NDArray[Any]) -> NDArray[Any]:
    """The values sought.

    Parameters
    ----------
    piece : bytes
    values : integers or floats, shape (value,)
        Those that the complete layers give.

    Returns
    -------
    array of the same shape and type, little-endian

    Raises
    ------
    StreamError
        Where the piece is not one of so many values of this type.
    """
    values = values.astype(values.dtype.newbyteorder("<"))
    if not piece:
        return values
    fields = Fields(piece)
    first = fields.number("B")
    rule, t = first & 3, first >> 2
    if rule == RAW:
        if t or len(piece) != 1 + values.nbytes:
            raise StreamError(f"expected {values.nbytes} bytes of values, got {len(piece) - 1}, and the argument {t}")
        return np.frombuffer(fields.rest(), values.dtype)
    if rule == OFFSETS:
        return with_offsets(fields, t, values)
    differences = _Differences(_Line(values.dtype, rule, t), fields)
    restored = b"".join(differences.value(x) for x in values)
    if (differences.taken + 7) // 8 != len(differences.stored):
        raise StreamError(f"expected {differences.taken} stored bits, got {len(differences.stored)} bytes")
    return np.frombuffer(restored, values.dtype)
