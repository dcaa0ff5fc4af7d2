"""Section 9.3 of the page: values on a lattice with offsets that come again."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.stranger.coder import Contexts, RangeDecoder
from tests.stranger.fields import Fields

Values = NDArray[Any]

MOST_BITS = 34
LISTED = 64
LARGEST = 0x7F7FFFFF


def place_of(number: float) -> int:
    """The place of the nearest float32."""
    with np.errstate(over="ignore"):
        nearest = np.float32(number)
    if not np.isfinite(nearest):
        return LARGEST
    m = int(np.abs(nearest).view(np.uint32))
    return -1 - m if np.signbit(nearest) else m


def value_at(place: int) -> float:
    """The float32 at a place."""
    magnitude = float(np.uint32(min(-1 - place if place < 0 else place, LARGEST)).view(np.float32))
    return -magnitude if place < 0 else magnitude


class Offsets:
    """The list of offsets, the last one first, and the contexts."""

    def __init__(self, coder: RangeDecoder, bits: int) -> None:
        self.bits = bits
        self.contexts = Contexts(coder)
        self.listed: list[tuple[float, float]] = []
        self.in_turn = 0

    def _rank(self) -> int | None:
        if not self.listed:
            return None
        if self.contexts.bit("first", self.in_turn):
            self.in_turn = min(self.in_turn + 1, 15)
            return 0
        self.in_turn = 0
        return min(self.contexts.number("which", 6), len(self.listed) - 1) if self.contexts.bit("listed") else None

    def place(self, x: float, base: float) -> int:
        """The place sought where the layers gave x."""
        rank = self._rank()
        if rank is None:
            w = self.contexts.number("new", min(self.bits, 4))
            for j in range(4, self.bits):
                w = 2 * w + self.contexts.bit("new", 12 + j)
            place = place_of(x) + w - (1 << self.bits >> 1)
        else:
            low, high = self.listed[rank]
            place = place_of(base + 0.5 * (low + high)) + self.contexts.number("off", 3, 8 if rank else 0) - 4
        f = value_at(place)
        bottom, top = (0.5 * (f + value_at(beside)) - base for beside in (place - 1, place + 1))
        if rank is None:
            del self.listed[LISTED - 1 :]
        else:
            del self.listed[rank]
            bottom, top = max(bottom, low), min(top, high)
            if bottom > top:
                bottom = top = f - base
        self.listed.insert(0, (bottom, top))
        return place


def with_offsets(fields: Fields, bits: int, values: Values) -> Values:
    """The values sought, from what follows the first byte of a piece."""
    step = fields.f64()
    if values.dtype != np.float32 or bits > MOST_BITS or not 0 < step < np.inf:
        raise ValueError("a piece of offsets has another type, more bits or no step")
    offsets = Offsets(RangeDecoder(fields.rest()), bits)
    patterns = []
    for x in map(float, values):
        place = min(max(offsets.place(x, float(np.rint(x / step)) * step), -(2**31)), 2**31 - 1)
        patterns.append((-1 - place) | 1 << 31 if place < 0 else place)
    return np.array(patterns, "<u4").view(values.dtype)
