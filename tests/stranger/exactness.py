"""Section 9 of the page: from the values of the complete layers to the values that were written."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.stranger.coder import Contexts, RangeDecoder, clamp
from tests.stranger.fields import Fields
from tests.stranger.offsets import with_offsets

Values = NDArray[Any]

MEMORY = 16384
SPREAD = 0x9E3779B97F4A7C15
SAFE = 2**53


def signed(number: int) -> int:
    """A whole number modulo 2^64, as a signed one."""
    return (number + 2**63) % 2**64 - 2**63


class Line:
    """The line of whole numbers on which values have places, by a rule of a piece and its argument."""

    def __init__(self, dtype: np.dtype[Any], rule: int, t: int) -> None:
        self.dtype = dtype
        self.rule = rule
        self.t = t
        self.bits = 8 * dtype.itemsize
        self.is_float = dtype.kind == "f"
        self.mantissa = {32: 23, 64: 52}[self.bits] if self.is_float else 0

    def _pattern(self, value: Any) -> int:
        return int(value.view(f"<u{self.dtype.itemsize}"))

    def place(self, value: Any) -> int:
        """Where a value is on the line."""
        if self.rule == 2:
            return round(min(max(float(value) * 10.0**self.t, -SAFE), SAFE))
        if not self.is_float:
            return signed(int(value)) >> self.t
        pattern = self._pattern(value)
        m = (pattern & (1 << self.bits - 1) - 1) >> self.t
        return -1 - m if pattern >> self.bits - 1 else m

    def exponent(self, value: Any) -> int:
        """The exponent field of a value's pattern, where it plays a part."""
        if self.rule == 2 or not self.is_float:
            return 0
        return self._pattern(value) >> self.mantissa & (1 << self.bits - 1 - self.mantissa) - 1

    def back(self, place: int) -> bytes:
        """The value at a place, as it is in memory."""
        if self.rule == 2:
            return np.array(clamp(place, -SAFE, SAFE) / 10.0**self.t).astype(self.dtype).tobytes()
        size = self.dtype.itemsize
        if not self.is_float:
            return ((place << self.t) % (1 << self.bits)).to_bytes(size, "little")
        m = (-1 - place if place < 0 else place) << self.t
        return (m % (1 << self.bits - 1) | (place < 0) << self.bits - 1).to_bytes(size, "little")


class Stored:
    """A string of bits, the lowest bit of each byte first."""

    def __init__(self, data: bytes) -> None:
        self._number = int.from_bytes(data, "little")
        self._length = len(data)
        self._taken = 0

    def take(self, count: int) -> int:
        """The next bits as a number, its lowest bit first."""
        found = self._number >> self._taken & (1 << count) - 1
        self._taken += count
        return found

    def finish(self) -> None:
        """The bytes end with the one in which the last bit lies."""
        if (self._taken + 7) // 8 != self._length:
            raise ValueError("the stored bits of a piece are too many or too few")


@dataclass
class Piece:
    """The state of a piece while its values are decoded one after another."""

    line: Line
    most: int
    specials: list[bytes]
    contexts: Contexts
    stored: Stored
    special: int = 0  # the last two bits that said whether a value is special, as one number
    memory: dict[int, tuple[int, int]] = field(default_factory=dict)  # entry -> place, difference

    def value(self, x: Any) -> bytes:
        """The value sought where the layers gave x."""
        if self.specials:
            bit = self.contexts.bit("special", self.special)
            self.special = 2 * (self.special & 1) + bit
            if bit:
                k = 1
                while k < len(self.specials) and self.contexts.bit("which", k):
                    k += 1
                return self.specials[k - 1]
        place = self.line.place(x)
        entry = (place * SPREAD % 2**64 >> 40) & (MEMORY - 1)
        z = self._difference(x, self.memory.get(entry), place)
        self.memory[entry] = (place, z)
        return self.line.back(signed(place + z))

    def _difference(self, x: Any, remembered: tuple[int, int] | None, place: int) -> int:
        if remembered is not None and remembered[0] == place:
            y = remembered[1]
            if self.contexts.bit("same"):
                return y
            if self.contexts.bit("close"):
                return y - 8 + self.contexts.number("beside", 4)
        limit = clamp(self.most - self.line.exponent(x), 0, 63)
        c = limit
        while c > 0 and self.contexts.bit("shorter", 16 * min(limit, 15) + min(limit - c, 15)):
            c -= 1
        if c == 0:
            return 0
        m, r = 1, c - 1
        while r > 32:
            m = m << 32 | self.stored.take(32)
            r -= 32
        last = self.stored.take(r + 1)
        m = m << r | last >> 1
        return -m if last & 1 else m


def restore(piece: bytes, values: Values) -> Values:
    """The values sought, from those that the complete layers give; one axis."""
    if not piece:
        return values
    dtype = values.dtype
    fields = Fields(piece)
    first = fields.number("B")
    rule, t = first & 3, first >> 2
    if rule == 0:
        found = fields.rest()
        if len(found) != values.size * dtype.itemsize or t:
            raise ValueError("a piece of values themselves has too many or too few")
        return np.frombuffer(found, dtype)
    if rule == 3:
        return with_offsets(fields, t, values)
    if rule == 2 and dtype.kind != "f":
        raise ValueError("a piece of whole numbers has the rule of decimals")
    most = fields.number("H")
    specials = [fields.take(dtype.itemsize) for _ in range(most >> 12)]
    contexts = Contexts(RangeDecoder(fields.take(fields.varint())))
    state = Piece(Line(dtype, rule, t), most & 4095, specials, contexts, Stored(fields.rest()))
    restored = b"".join(state.value(x) for x in values)
    state.stored.finish()
    return np.frombuffer(restored, dtype)
