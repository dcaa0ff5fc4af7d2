"""The embedded coder in plain Python, both ends: what the kernel is compared with. See docs/format.md, section 7."""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodestream.band_fields import (
    COLUMN_SHIFT,
    COLUMNS,
    FLAGS,
    KIND,
    OFFSET,
    PARENT,
    PARENT_STRIDE,
    ROW_SHIFT,
    ROWS,
    STRIDE,
)

__all__ = ["PlainTile", "RangeCoder"]

# fmt: off
_LOGISTIC = [
    32768, 36843, 40793, 44511, 47911, 50941, 53581, 55834, 57724, 59287, 60565,
    61598, 62428, 63090, 63615, 64030, 64357, 64614, 64816, 64974, 65097, 65194,
    65269, 65328, 65374, 65410, 65438, 65459, 65476, 65489, 65500, 65508, 65514,
]
# fmt: on
_ANCHORS = [65536 - value for value in _LOGISTIC[:0:-1]] + _LOGISTIC
_CLASSES = [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 5, 6]
_NEXT = [(0, 2), (5, 7), (1, 3), (6, 4), (2, 0), (4, 6), (3, 1), (7, 5)]


def _squashed(x: int) -> int:
    whole, part = divmod(x + 2048, 64)
    return min(max((_ANCHORS[whole] * (64 - part) + _ANCHORS[whole + 1] * part) >> 6, 32), 65504)


_SQUASH = [_squashed(x) for x in range(-2048, 2048)]
_STRETCH = [min(max(bisect_left(_SQUASH, 16 * p + 8) - 2048, -2047), 2047) for p in range(4096)]


class RangeCoder:
    """Reads data, or writes: then the interval is known with all its digits, and no carry is needed."""

    def __init__(self, data: bytes | None) -> None:
        self.data = data
        self.width, self.place = 2**32 - 1, 4
        self.low = 0 if data is None else min(self._byte(0, 4), self.width - 1)

    def _byte(self, start: int, count: int = 1) -> int:
        assert self.data is not None
        return int.from_bytes(self.data[start : start + count].ljust(count, b"\0"), "big")

    def bit(self, bit: int, chance: int) -> int:
        """Code a bit that is 1 with this probability over 2**16; the one given, or the one read."""
        bound = (self.width >> 16) * chance
        if self.data is not None:
            bit = int(self.low < bound)
            self.low -= 0 if bit else bound
        else:
            self.low += 0 if bit else bound
        self.width = bound if bit else self.width - bound
        while self.width < 2**24:
            self.width <<= 8
            self.low = (self.low << 8) + (self._byte(self.place) if self.data is not None else 0)
            self.place += 1
        return bit

    def written(self) -> bytes:
        """The shortest string that names a number in the interval."""
        for count in range(self.place + 1):
            unit = 1 << 8 * (self.place - count)
            number = -(-self.low // unit)
            if number * unit < self.low + self.width:
                return (number.to_bytes(count, "big").rstrip(b"\0") or b"\0") if count else b"\0"
        raise AssertionError


@dataclass
class PlainTile:
    """A tile of one channel, in the flat arrays that a table of bands describes."""

    bands: NDArray[np.int64]
    size: int
    flag_count: int
    trellis: bool = False
    contexts: dict[tuple[Any, ...], tuple[int, int]] = field(default_factory=lambda: defaultdict(lambda: (2**19, 1)))
    weights: dict[tuple[int, ...], list[int]] = field(default_factory=lambda: defaultdict(lambda: [32768, 32768]))

    def __post_init__(self) -> None:
        self.known, self.sign, self.early = [0] * self.size, [0] * self.size, [0] * self.size
        self.flags = [0] * self.flag_count

    def code(self, first: int, last: int, true: list[int] | None, data: bytes | None) -> RangeCoder:
        """Code passes; writing with the coefficients ``true``, else reading ``data``."""
        self._coder, self._true = RangeCoder(data), true
        for number in range(first, last - 1, -1):
            for row in self.bands:
                if not (self.trellis and number == 1):
                    self._pass(number, [int(x) for x in row])
        return self._coder

    def _learn(self, context: tuple[Any, ...], bit: int) -> None:
        p, n = self.contexts[context]
        self.contexts[context] = p + (((2**20 - 1 if bit else 0) - p) * (2**17 // (2 * n + 3)) >> 16), min(n + 1, 127)

    def _alone(self, context: tuple[Any, ...], bit: int) -> int:
        bit = self._coder.bit(bit, min(max(self.contexts[context][0] >> 4, 32), 65504))
        self._learn(context, bit)
        return bit

    def _mixed(self, first: tuple[Any, ...], second: tuple[Any, ...], pair: tuple[int, ...], bit: int) -> int:
        inputs = [_STRETCH[self.contexts[context][0] >> 8] for context in (first, second)]
        weights = self.weights[pair]
        total = sum(weight * x for weight, x in zip(weights, inputs, strict=True)) >> 16
        chance = _SQUASH[min(max(total, -2047), 2047) + 2048]
        bit = self._coder.bit(bit, chance)
        error = (65536 if bit else 0) - chance
        for i, x in enumerate(inputs):
            weights[i] = min(max(weights[i] + ((x * error + 16384) >> 15), -(2**18)), 2**18)
        self._learn(first, bit)
        self._learn(second, bit)
        return bit

    def _pass(self, number: int, band: list[int]) -> None:
        plane, first = number >> 1, number & 1
        lowest = self.trellis and plane == 0
        state = 0
        rows, columns, across = band[ROWS], band[COLUMNS], (band[COLUMNS] + 7) // 8
        for top in range(0, rows, 8):
            for left in range(0, columns, 8):
                block = band[FLAGS] + top // 8 * (across + 1) + left // 8
                inside = [(i, j) for i in range(top, min(top + 8, rows)) for j in range(left, min(left + 8, columns))]
                if not self.flags[block] and not first:
                    self.flags[block] = self._flag(band, block, across, inside, plane)
                for i, j in inside:
                    at = band[OFFSET] + i * band[STRIDE] + j
                    if self.flags[block] and self._visits(band, at, number):
                        self._visit(band, i, j, plane, state if lowest else None)
                    state = _NEXT[state][self.known[at] & 1]

    def _flag(self, band: list[int], block: int, across: int, inside: list[tuple[int, int]], plane: int) -> int:
        family = seen = 0
        for i, j in inside:
            family |= self.known[self._parent(band, i, j)]
            seen |= abs(self._true[band[OFFSET] + i * band[STRIDE] + j]) if self._true else 0
        before = self.flags[block - 1] + self.flags[block - across - 1]
        after = self.flags[block + 1] + self.flags[block + across + 1]
        return self._alone(("flag", before, after, min(family >> plane, 2)), int(seen >> plane > 0))

    @staticmethod
    def _parent(band: list[int], i: int, j: int) -> int:
        return band[PARENT] + (i >> band[ROW_SHIFT]) * band[PARENT_STRIDE] + (j >> band[COLUMN_SHIFT])

    def _around(self, band: list[int], at: int, distance: int) -> dict[tuple[int, int], int]:
        reach = range(-distance, distance + 1)
        ring = [(i, j) for i in reach for j in reach if max(abs(i), abs(j)) == distance]
        return {(i, j): self.known[at + i * band[STRIDE] + j] for i, j in ring}

    def _visits(self, band: list[int], at: int, number: int) -> bool:
        plane = number >> 1
        if number & 1:
            visits = not self.known[at] and sum(self._around(band, at, 1).values()) >> plane > 0
            self.early[at] = plane + 1 if visits else self.early[at]
            return visits
        return self.early[at] != plane + 1

    def _visit(self, band: list[int], i: int, j: int, plane: int, state: int | None) -> None:
        at, kind, known = band[OFFSET] + i * band[STRIDE] + j, band[KIND], self.known
        odd = () if state is None else (state & 1,)
        own = min((known[at] >> (plane + 1)).bit_length(), 3)
        side, rise = (min((known[at - d] + known[at + d]) >> plane, 4) for d in (1, band[STRIDE]))
        true = self._true[at] if self._true else 0
        bit = abs(true) >> plane & 1
        if own > 1:
            bit = self._alone((own, side, rise, kind), bit)
        else:
            ring = sum(2 * v if 0 in place else v for place, v in self._around(band, at, 2).items())
            parent, stride = self._parent(band, i, j), band[PARENT_STRIDE]
            parents = 4 * (known[parent] >> plane) + sum(known[parent + d] >> plane for d in (-1, 1, -stride, stride))
            around = "around", own, _CLASSES[min(ring >> plane, 17)], min(_CLASSES[min(parents, 17)], 5), odd
            bit = self._mixed((own, side, rise, kind, odd), around, (own, *odd), bit)
        if bit:
            if not known[at]:
                x, y = (int(np.sign(self.sign[at - d] + self.sign[at + d])) for d in (1, band[STRIDE]))
                self.sign[at] = -1 if self._alone(("sign", x, y, kind), int(true < 0)) else 1
            known[at] += 1 << plane
