"""Sections 7.1 and 7.2 of docs/format.md: the range coder, and contexts."""

from __future__ import annotations

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Hashable

from ..errors import StreamError

__all__ = ["Model", "RangeDecoder", "clamp"]

#: The table L, from which `squash` is interpolated.
LOGISTIC = [
    *(32768, 36843, 40793, 44511, 47911, 50941, 53581, 55834, 57724, 59287, 60565),
    *(61598, 62428, 63090, 63615, 64030, 64357, 64614, 64816, 64974, 65097, 65194),
    *(65269, 65328, 65374, 65410, 65438, 65459, 65476, 65489, 65500, 65508, 65514),
]


def clamp(value: int, least: int, most: int) -> int:
    """The value, or the end of the range beyond which it lies."""
    return least if value < least else most if value > most else value


def _squash(x: int) -> int:
    points = [65536 - number for number in LOGISTIC[:0:-1]] + LOGISTIC
    i, f = (x + 2048) >> 6, (x + 2048) & 63
    return clamp((points[i] * (64 - f) + points[i + 1] * f) >> 6, 32, 65504)


SQUASH = [_squash(x) for x in range(-2048, 2048)]
STRETCH = [clamp(bisect_left(SQUASH, 16 * p + 8) - 2048, -2047, 2047) for p in range(4096)]  # SQUASH rises
RATE = [2**17 // (2 * n + 3) for n in range(128)]


class RangeDecoder:
    """Section 7.1: a range-coded string, behind whose end everything is 0."""

    def __init__(self, string: bytes) -> None:
        self.unread = iter(string)
        self._width, self._low = 2**32 - 1, 0
        for _ in range(4):
            self._low = self._low * 256 + next(self.unread, 0)
        self._low = min(self._low, self._width - 1)

    def bit(self, probability: int) -> int:
        """The next bit, whose probability of being 1 is `probability` / 2^16."""
        bound = (self._width >> 16) * probability
        if self._low < bound:
            bit = 1
            self._width = bound
        else:
            bit = 0
            self._low -= bound
            self._width -= bound
        while self._width < 2**24:
            self._low = self._low * 256 + next(self.unread, 0)
            self._width *= 256
        return bit


class Model:
    """Section 7.2: contexts and pairs of weights, each made when it is first used.

    A context is named by what the page numbers it with: as all begin alike, the numbers themselves do not matter.
    """

    def __init__(self, string: bytes = b"") -> None:
        self.begin(string)
        self._contexts: defaultdict[Hashable, tuple[int, int]] = defaultdict(lambda: (2**19, 1))
        self._weights: defaultdict[Hashable, tuple[int, int]] = defaultdict(lambda: (32768, 32768))

    def begin(self, string: bytes) -> None:
        """Go on with another string."""
        self._coder = RangeDecoder(string)

    def finish(self) -> None:
        """The string has no bytes that decoding has not read."""
        if next(self._coder.unread, None) is not None:
            raise StreamError("expected no more bytes of a range-coded string than decoding reads, got more")

    def bit(self, *context: Hashable) -> int:
        """A bit with a single context."""
        state = self._contexts[context]
        bit = self._coder.bit(clamp(state[0] >> 4, 32, 65504))
        self._adapt(context, state, bit)
        return bit

    def mixed(self, first: Hashable, second: Hashable, pair: Hashable) -> int:
        """A bit with two mixed contexts and one of the pairs of weights."""
        one, other = self._contexts[first], self._contexts[second]
        x, y = STRETCH[one[0] >> 8], STRETCH[other[0] >> 8]
        u, v = self._weights[pair]
        probability = SQUASH[clamp((u * x + v * y) >> 16, -2047, 2047) + 2048]
        bit = self._coder.bit(probability)
        error = (65536 if bit else 0) - probability
        self._weights[pair] = _moved(u, x * error), _moved(v, y * error)
        self._adapt(first, one, bit)
        self._adapt(second, other, bit)
        return bit

    def number(self, bits: int, name: str, first: int = 0) -> int:
        """A number of so many bits, the highest first, each in context `first` + v: v = 1, then 2 v + bit."""
        v = 1
        for _ in range(bits):
            v = 2 * v + self.bit(name, first + v)
        return v - (1 << bits)

    def _adapt(self, context: Hashable, state: tuple[int, int], bit: int) -> None:
        p, n = state
        target = 2**20 - 1 if bit else 0
        self._contexts[context] = p + ((target - p) * RATE[n] >> 16), min(n + 1, 127)


def _moved(weight: int, by: int) -> int:
    return clamp(weight + ((by + 16384) >> 15), -(2**18), 2**18)
