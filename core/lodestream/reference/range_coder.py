"""Sections 7.1 and 7.2 of docs/format.md: the range coder, and contexts."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable

from ..errors import StreamError

__all__ = ["Model", "RangeDecoder", "clamp"]

RATE = [2**17 // (2 * n + 3) for n in range(128)]


def clamp(value: int, least: int, most: int) -> int:
    """The value, or the end of the range beyond which it lies."""
    return least if value < least else most if value > most else value


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
    """Section 7.2: contexts, each made when it is first used.

    A context is named by what the page numbers it with: as all begin alike, the numbers themselves do not matter.
    """

    def __init__(self, string: bytes = b"") -> None:
        self.begin(string)
        self._contexts: defaultdict[Hashable, tuple[int, int]] = defaultdict(lambda: (2**19, 1))

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

    def raw_bit(self) -> int:
        """A bit without a context."""
        return self._coder.bit(2**15)

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
