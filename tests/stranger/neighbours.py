"""Section 9.4 of the page: the numbers of a window, each by those around it."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.stranger.coder import Model, RangeDecoder, clamp, new_contexts
from tests.stranger.header import Lattice

Values = NDArray[Any]
Place = tuple[int, int]

BEFORE = "0,-1 -1,0 -1,-1 -1,1 0,-2 -2,0 -1,-2 -2,-1 -2,1 -1,2 -2,-2 -2,2 0,-3 -3,0 -3,1 -3,-1"
AROUND = "0,0 0,1 1,0 1,1 1,-1 0,-1 -1,0 0,2"
FURTHEST = 2**25
NEIGHBOURS = b"\xff"  # how a piece begins
MOST_BITS = 26


@functools.cache
def places(text: str) -> list[Place]:
    """Rows and columns from a point."""
    return [(int(row), int(column)) for row, column in (pair.split(",") for pair in text.split())]


def log(v: int) -> int:
    """Eight times a logarithm."""
    if v == 0:
        return 0
    length = v.bit_length() - 1
    return 8 * length + ((8 * v >> length) & 7) if v < 4096 else 96 + log(min(v >> 12, 4095))


def class_of(v: int) -> int:
    """Two classes for each power of two."""
    return 0 if v == 0 else 1 + (log(v) >> 2)


def number_of(x: Any, lattice: Lattice) -> int:
    """The whole number that a value gives."""
    with np.errstate(over="ignore"):
        wide = np.float64(x)
        q = wide * lattice.step - lattice.origin if lattice.decimal else (wide - lattice.origin) / lattice.step
    return int(np.rint(np.clip(q, -float(FURTHEST), float(FURTHEST))))


@dataclass
class Mixed:
    """Contexts and sets of weights by their names, made where they are first asked for."""

    coder: RangeDecoder
    contexts: dict[tuple[Any, ...], int] = field(default_factory=dict)
    weights: dict[tuple[Any, ...], list[int]] = field(default_factory=dict)
    model: Model = field(default_factory=lambda: new_contexts(0))

    def _slot(self, name: tuple[Any, ...]) -> int:
        if name not in self.contexts:
            self.contexts[name] = self.model.add()
        return self.contexts[name]

    def bit(self, sort: str, names: list[tuple[Any, ...]], weights: tuple[Any, ...]) -> int:
        """A bit in five contexts."""
        slots = [self._slot((sort, number, *name)) for number, name in enumerate(names)]
        return self.model.mixed_by(self.coder, slots, self.weights.setdefault((sort, *weights), [16384] * 5))

    def alone(self, name: tuple[Any, ...]) -> int:
        """A bit in one context."""
        return self.model.alone(self.coder, self._slot(("alone", *name)))


class Neighbours:
    """What is known of the points of a window while they are decoded."""

    def __init__(self, picture: list[list[int]], parts: list[int], coder: RangeDecoder) -> None:
        self.s = picture
        self.rows, self.columns = len(picture), len(picture[0])
        self.parts = parts
        self.bits = Mixed(coder)
        self.q: dict[Place, int] = {}
        self.miss: dict[Place, list[int]] = {}
        self.off: dict[Place, int] = {}
        self.way: dict[Place, int] = {}

    def _s(self, row: int, column: int) -> int:
        return self.s[clamp(row, 0, self.rows - 1)][clamp(column, 0, self.columns - 1)]

    def _beside(self, row: int, column: int) -> Place:
        """Where the numbers of a place stand that may lie beside the window."""
        if column < 0:
            return row - 1, 0
        return row, min(column, self.columns - 1)

    def _q(self, row: int, column: int) -> int:
        if row < 0:
            return self._s(row, column)
        row, column = self._beside(row, column)
        return self._s(row, column) if row < 0 else self.q[row, column]

    def _miss(self, row: int, column: int) -> list[int]:
        return self.miss.get(self._beside(row, column), [0] * 4)

    def _off(self, row: int, column: int) -> int:
        return self.off.get(self._beside(row, column), 0)

    def hole(self, row: int, column: int) -> None:
        """A point that is not coded."""
        here = row, column
        self.q[here], self.miss[here], self.off[here], self.way[here] = self._s(row, column), [0] * 4, 0, 0

    def point(self, row: int, column: int) -> None:
        """Decode a point."""
        before = [self._q(row + i, column + j) for i, j in places(BEFORE)]
        around = [self._s(row + i, column + j) for i, j in places(AROUND)]
        w, n, nw, ne, _, nn = before[:6]
        total = sum(g * (value - n) for g, value in zip(self.parts, before + around, strict=True))
        f = [(total + 4) >> 3, 8 * (w - nw), 8 * (w + ne - 2 * n), 8 * (n - nn)]
        blend = self._blend(row, column, n, f)
        p, e = (blend + 4) >> 3, (blend + 4) & 7
        d = self._difference(row, column, before, p, e, abs(f[1] - (blend - 8 * n)))
        q = clamp(p + d, -FURTHEST, FURTHEST)
        here = row, column
        self.q[here] = q
        self.miss[here] = [abs(8 * (q - n) - told) for told in f]
        self.off[here] = abs(8 * q - blend)
        self.way[here] = clamp(d, -1, 1)

    def _blend(self, row: int, column: int, n: int, f: list[int]) -> int:
        errors = []
        near = [(2, -1, 0), (1, -1, -1), (1, -1, 1), (2, 0, -1), (1, 0, -2)]
        for k in range(4):
            m = sum(times * self._miss(row + i, column + j)[k] for times, i, j in near) >> 2
            errors.append(log(m + 1))
        counts = [0 if d >= 52 else round(2 ** (12 - d / 4)) for d in (e - min(errors) for e in errors)]
        counts[0] *= 8
        every = sum(counts)
        mean = (sum(count * told for count, told in zip(counts, f, strict=True)) + every // 2) // every
        return clamp(8 * n + mean, -(2**28), 2**28)

    def _difference(self, row: int, column: int, before: list[int], p: int, e: int, gap: int) -> int:
        w, n, nw, ne, ww, nn = before[:6]
        near = [(2, 0, -1), (2, -1, 0), (1, -1, -1), (1, -1, 1), (1, 0, -2), (1, -2, 0)]
        offs = {(i, j): self._off(row + i, column + j) for _, i, j in near}
        far = min(class_of(sum(times * offs[i, j] for times, i, j in near) >> 1), 31)
        varied = min(class_of(abs(w - nw) + abs(n - nw) + abs(n - ne) + abs(w - ww) + abs(n - nn)), 15)
        lies = 0
        for value in (w, n, nw, ne):
            lies = 5 * lies + clamp(value - p, -2, 2) + 2
        pattern = 9 * lies + 3 * (clamp(ww - p, -1, 1) + 1) + clamp(nn - p, -1, 1) + 1
        side = 3 * (self.way.get((row, column - 1), 0) + 1) + self.way.get((row - 1, column), 0) + 1
        equal = int("".join(str(int(value == p)) for value in before), 2)
        zero = [(far, e), (pattern,), (varied, far), (side, varied, e), (equal,)]
        if self.bits.bit("zero", zero, (far,)):
            return 0
        trits = int("".join(str(clamp(value - p, -1, 1) + 1) for value in before[:8]), 3)
        greater = [w > n, nw > n, ne > n, nn > n, ww > w, w > nw]
        order = sum(2**k for k, yes in enumerate(greater) if yes)
        more = self.bits.bit("more", [(far, e), (pattern,), (side, e), (order, e), (trits,)], (far,))
        both = 16 * min(class_of(offs[0, -1]), 15) + min(class_of(offs[-1, 0]), 15)
        apart = min(class_of(gap), 31)
        turned = e if more else 7 - e

        def bits(i: int) -> int:
            second = (varied, i) if i else ("lies", lies, more)
            return self.bits.bit("bits", [(far, more, i), second, (both, i), (varied, turned, i), (apart, i)], (i,))

        c = x = max(far - 11, 0) >> 1
        while c < MOST_BITS and bits(c):
            c += 1
        if c == x:
            while c > 0 and not bits(27 + c):
                c -= 1
        magnitude = 1
        for k in range(c):
            magnitude = 2 * magnitude + self.bits.alone((far, c, magnitude) if k < 3 else ())
        return magnitude if more else -magnitude


def numbers_of(data: bytes, x: Values, valid: Values, lattice: Lattice) -> list[list[int]]:
    """The whole numbers of a window, from what follows the first byte of its piece."""
    parts = np.frombuffer(data, np.int8, 24).tolist()
    window = Neighbours([[number_of(value, lattice) for value in row] for row in x], parts, RangeDecoder(data[24:]))
    for row in range(window.rows):
        for column in range(window.columns):
            if valid[row, column]:
                window.point(row, column)
            else:
                window.hole(row, column)
    return [[window.q[row, column] for column in range(window.columns)] for row in range(window.rows)]
