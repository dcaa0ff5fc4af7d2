"""The embedded coder in plain Python, both ends: what the kernel is compared with. See docs/format.md, section 7."""

from __future__ import annotations

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

_AROUND = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if i or j]
_NEAR = [(i, j) for i, j in _AROUND if max(abs(i), abs(j)) == 1]
_NEXT = [(0, 2), (5, 7), (1, 3), (6, 4), (2, 0), (4, 6), (3, 1), (7, 5)]


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

    def _pass(self, number: int, band: list[int]) -> None:
        plane, first = number >> 1, number & 1
        lowest = self.trellis and plane == 0
        rows, columns, across = band[ROWS], band[COLUMNS], (band[COLUMNS] + 7) // 8
        for top in range(0, rows, 8):
            state = 0
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

    def _around(self, band: list[int], at: int, plane: int) -> dict[tuple[int, int], int]:
        return {(i, j): min(self.known[at + i * band[STRIDE] + j] >> plane, 3) for i, j in _AROUND}

    def _visits(self, band: list[int], at: int, number: int) -> bool:
        plane = number >> 1
        if number & 1:
            near = (self.known[at + i * band[STRIDE] + j] >> plane for i, j in _NEAR)
            visits = not self.known[at] and any(near)
            self.early[at] = plane + 1 if visits else self.early[at]
            return visits
        return self.early[at] != plane + 1

    def _visit(self, band: list[int], i: int, j: int, plane: int, state: int | None) -> None:
        at, known = band[OFFSET] + i * band[STRIDE] + j, self.known
        lowest = () if state is None else (state & 1,)
        own = min(known[at] >> (plane + 1), 2)
        true = self._true[at] if self._true else 0
        bit = abs(true) >> plane & 1
        if own == 2 and state is None:
            bit = self._coder.bit(bit, 32768)
        elif own:
            bit = self._alone(("refinement", own, *lowest), bit)
        else:
            bit = self._alone((*self._surroundings(band, i, j, plane), *lowest), bit)
        if bit:
            if not known[at]:
                self._visit_sign(band, at, true)
            known[at] += 1 << plane

    def _surroundings(self, band: list[int], i: int, j: int, plane: int) -> tuple[int, ...]:
        around = self._around(band, band[OFFSET] + i * band[STRIDE] + j, plane)
        across, down = (
            sum(u for place, u in around.items() if place[axis] == 0 and 1 in map(abs, place)) for axis in (0, 1)
        )
        further = 0
        for (row, column), u in around.items():
            if 0 in (row, column) and max(abs(row), abs(column)) == 1:
                continue
            further += u * (2 if 0 in (row, column) or abs(row) + abs(column) == 2 else 1)
        parent, stride = self._parent(band, i, j), band[PARENT_STRIDE]
        beside = sum(self.known[parent + d] >> plane for d in (-1, 1, -stride, stride))
        further += 3 * min(self.known[parent] >> plane, 4) + min(beside, 12)
        two = [(total > 0) + (total > 2) for total in (across, down)]
        if band[KIND] == 2:
            two.reverse()
        return *two, (further > 0) + (further > 3) + (further > 11)

    def _visit_sign(self, band: list[int], at: int, true: int) -> None:
        x, y = (int(np.sign(self.sign[at - d] + self.sign[at + d])) for d in (1, band[STRIDE]))
        kind = band[KIND]
        total = 3 * y + x if kind == 2 else 3 * x + y
        flip = total < 0
        bit = self._alone(("sign", abs(total), max(kind - 1, 0)), int(true < 0) ^ flip) ^ flip
        self.sign[at] = -1 if bit else 1
