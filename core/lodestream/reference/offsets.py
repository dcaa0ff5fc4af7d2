"""Section 9.3 of docs/format.md: values on a lattice with offsets that come again."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import StreamError
from .fields import Fields
from .range_coder import Model, clamp

__all__ = ["with_offsets"]

MOST_BITS = 34
LISTED = 64
LARGEST = 0x7F7FFFFF


def _place_of(number: float) -> int:
    """The place of the nearest float32."""
    with np.errstate(over="ignore"):
        nearest = np.float32(number)
    if not np.isfinite(nearest):
        return LARGEST
    m = int(np.abs(nearest).view(np.uint32))
    return -1 - m if np.signbit(nearest) else m


def _value_at(place: int) -> float:
    """The float32 at a place."""
    magnitude = float(np.uint32(min(-1 - place if place < 0 else place, LARGEST)).view(np.float32))
    return -magnitude if place < 0 else magnitude


class _Offsets:
    """The list of intervals, the last used first, and the contexts."""

    def __init__(self, coded: bytes, bits: int) -> None:
        self.bits = bits
        self.model = Model(coded)
        self.listed: list[tuple[float, float]] = []
        self.in_turn = 0

    def _rank(self) -> int | None:
        if not self.listed:
            return None
        if self.model.bit("first", self.in_turn):
            self.in_turn = min(self.in_turn + 1, 15)
            return 0
        self.in_turn = 0
        return min(self.model.number(6, "which"), len(self.listed) - 1) if self.model.bit("listed") else None

    def place(self, x: float, base: float) -> int:
        """The place sought where the layers gave x."""
        rank = self._rank()
        low, high = -np.inf, np.inf
        if rank is None:
            w = self.model.number(min(self.bits, 4), "new")
            for j in range(4, self.bits):
                w = 2 * w + self.model.bit("new", 12 + j)
            place = _place_of(x) + w - (1 << self.bits >> 1)
            del self.listed[LISTED - 1 :]
        else:
            low, high = self.listed.pop(rank)
            place = _place_of(base + 0.5 * (low + high)) + self.model.number(3, "off", 8 if rank else 0) - 4
        f = _value_at(place)
        bottom = max(0.5 * (f + _value_at(place - 1)) - base, low)
        top = min(0.5 * (f + _value_at(place + 1)) - base, high)
        if bottom > top:
            bottom = top = f - base
        self.listed.insert(0, (bottom, top))
        return place


def with_offsets(fields: Fields, bits: int, values: NDArray[Any]) -> NDArray[Any]:
    """The values sought, from what follows the first byte of a piece, B, and what the layers gave, shape (value,)."""
    step = fields.f64()
    if values.dtype.str != "<f4" or bits > MOST_BITS or not 0 < step < np.inf:
        raise StreamError(f"expected float32, at most {MOST_BITS} bits and a step, got {values.dtype}, {bits}, {step}")
    offsets = _Offsets(fields.rest(), bits)
    patterns = []
    for x in map(float, values):
        place = clamp(offsets.place(x, float(np.rint(x / step)) * step), -(2**31), 2**31 - 1)
        patterns.append((-1 - place) | 1 << 31 if place < 0 else place)
    offsets.model.finish()
    return np.array(patterns, "<u4").view(values.dtype)
