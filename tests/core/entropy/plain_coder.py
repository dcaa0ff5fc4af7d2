"""The embedded coder in plain Python, both ends, and the reading end of large units: what the kernel is compared with.

See docs/format.md, section 7.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lodestream.entropy.band_fields import (
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

__all__ = ["PlainLargeUnit", "PlainTile", "RangeCoder"]

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


_STARTS = """
    1769 6269 10941 17037 22777 15303 12725 16197 21319 25579 22090 19291 22284 26014 30911 24483 24690 26193 28805
    33543 37136 21576 21544 29250 40871 17460 29848 28496 30599 33607 30402 31139 33249 37776 33696 34465 34348
    32465 35933 32560 31473 873 5445 19444 9223 22512 37850 16482 23482 41024 9867 20496 43481 14984 37936 58064
    18912 40816 56828 21977 44089 58982 19476 54276 63525 15755 53595 63560
"""
_REFINEMENT, _SIGN, _FLAG = 25, 26, 41


class PlainLargeUnit:
    """A large unit that is read, in the flat arrays that a table of bands describes."""

    def __init__(self, bands: NDArray[np.int64], size: int, flag_count: int) -> None:
        self.bands = bands
        self.known, self.sign = np.zeros(size, np.int64), np.zeros(size, np.int64)
        self.early, self.flags = np.zeros(size, np.int64), np.zeros(flag_count, np.int64)
        self.contexts = [[int(start), 6] for start in _STARTS.split()]
        self._counted: dict[int, list[int]] = defaultdict(list)
        self._states: list[int] = []

    def read(self, first: int, last: int, data: bytes) -> None:
        """Read the passes of a segment."""
        self._data, self._place = data, 0
        if not self._states:
            self._states = [max(self._number(4), 2**16) for _ in range(2)]
        for number in range(first, last - 1, -1):
            if number & 1:
                self.contexts = [[p, min(n, 16)] for p, n in self.contexts]
            for band in self.bands.tolist():
                classes = self._classes(band, number >> 1)  # no bit of this pass changes them
                for stripe in self._stripes(band):
                    self._stripe(band, number, *stripe, *classes)
            if not number & 1:
                self._raw(number >> 1)

    def _number(self, count: int) -> int:
        self._place += count
        return int.from_bytes(self._data[self._place - count : self._place].ljust(count, b"\0"), "little")

    @staticmethod
    def _stripes(band: list[int]) -> list[tuple[range, range]]:
        """Rows and columns of each."""
        tops, lefts = range(0, band[ROWS], 8), range(0, band[COLUMNS], 64)
        return [
            (range(top, min(top + 8, band[ROWS])), range(left, min(left + 64, band[COLUMNS])))
            for top in tops
            for left in lefts
        ]

    def _decide(self, context: int) -> int:
        state, other = self._states
        chance = max(self.contexts[context][0] >> 4, 1)
        rest, bit = state & 4095, int(state & 4095 < chance)
        state = chance * (state >> 12) + rest if bit else (4096 - chance) * (state >> 12) + rest - chance
        self._states = [other, (state << 16) + self._number(2) if state < 2**16 else state]
        self._counted[context].append(bit)
        return bit

    def _adapt(self) -> None:
        for context, bits in self._counted.items():
            (p, n), k = self.contexts[context], len(bits)
            p += (65536 * sum(bits) - k * p) * (2**17 // (2 * n + 2 * k + 1)) >> 16
            self.contexts[context] = [p, min(n + k, 127)]
        self._counted.clear()

    @staticmethod
    def _places(band: list[int], margin: int = 0) -> NDArray[np.int64]:
        rows, columns = (np.arange(-margin, band[axis] + margin) for axis in (ROWS, COLUMNS))
        return np.asarray(band[OFFSET] + rows[:, None] * band[STRIDE] + columns)

    @staticmethod
    def _parents(band: list[int]) -> NDArray[np.int64]:
        rows, columns = np.arange(band[ROWS])[:, None], np.arange(band[COLUMNS])
        down, across = rows >> band[ROW_SHIFT], columns >> band[COLUMN_SHIFT]
        return np.asarray(band[PARENT] + down * band[PARENT_STRIDE] + across)

    def _classes(self, band: list[int], plane: int) -> tuple[NDArray[np.int64], ...]:
        """m of each coefficient of a band, and its two classes."""
        m = np.minimum(self.known[self._places(band, 2)] >> (plane + 1), 2)
        weights = np.array([0, 2, 3])[m]
        near, far = np.zeros((2, band[ROWS], band[COLUMNS]), np.int64)
        for i in range(-2, 3):
            for j in range(-2, 3):
                weight = weights[2 + i : 2 + i + band[ROWS], 2 + j : 2 + j + band[COLUMNS]]
                if max(abs(i), abs(j)) == 1:
                    near += weight * (2 if i and j else 3)
                elif i or j:
                    far += weight * (1 if i and j else 2)
        parents, stride = self._parents(band), band[PARENT_STRIDE]
        beside = sum(self.known[parents + step] >> plane for step in (-1, 1, -stride, stride))
        far += 3 * np.minimum(self.known[parents] >> plane, 4) + np.minimum(beside, 12)
        classes = [
            sum((total >= limit).astype(np.int64) for limit in limits)
            for total, limits in (
                (near, (1, 6, 13, 24)),
                (far, (1, 4, 9, 18)),
            )
        ]
        return m[2:-2, 2:-2], *classes

    def _stripe(self, band: list[int], number: int, rows: range, columns: range, *classes: NDArray[np.int64]) -> None:
        plane, second, across = number >> 1, not number & 1, (band[COLUMNS] + 7) // 8
        m, a, b = classes
        row, fresh = band[FLAGS] + rows[0] // 8 * (across + 1), set()
        for block in range(columns[0] // 8, columns[-1] // 8 + 1):
            if second and not self.flags[row + block]:
                inside = np.s_[rows[0] : rows[-1] + 1, 8 * block : 8 * block + 8]
                family = int(np.bitwise_or.reduce(self.known[self._parents(band)[inside]], None)) >> plane
                before, after = (
                    int(self.flags[row + block + s]) + int(self.flags[row + block + s * (across + 1)]) for s in (-1, 1)
                )
                self.flags[row + block] = self._decide(_FLAG + (3 * before + after) * 3 + min(family, 2))
                fresh |= {block} if self.flags[row + block] else set()
        found = []
        for i in rows:
            for j in columns:
                visits = (a[i, j] == 0 or j // 8 in fresh) if second else a[i, j] > 0
                if not self.flags[row + j // 8] or m[i, j] > 1 or (not second if m[i, j] else not visits):
                    continue
                at = band[OFFSET] + i * band[STRIDE] + j
                if self._decide(_REFINEMENT if m[i, j] else int(5 * a[i, j] + b[i, j])):
                    self.known[at] += 1 << plane
                    found += [] if m[i, j] else [((i + j) % 2, i, j, at)]
        for *_, at in sorted(found):
            self.early[at] = plane + 1 + 128 * second
            x, y = (int(np.sign(self.sign[at - d] + self.sign[at + d])) for d in (1, band[STRIDE]))
            total = 3 * y + x if band[KIND] == 2 else 3 * x + y
            bit = self._decide(_SIGN + 3 * abs(total) + max(band[KIND], 1) - 1) ^ (total < 0)
            self.sign[at] = -1 if bit else 1
        self._adapt()

    def _raw(self, plane: int) -> None:
        bits = 8 * self._place
        for band in self.bands.tolist():
            places = self._places(band)
            for rows, columns in self._stripes(band):
                for at in places[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].ravel():
                    if self.known[at] >> (plane + 1) > 1:
                        byte = self._data[bits >> 3] if bits >> 3 < len(self._data) else 0
                        self.known[at] += (byte >> (bits & 7) & 1) << plane
                        bits += 1
        self._place = (bits + 7) >> 3
