"""Sets of byte ranges of a file: the bytes of a container that are cached, and those that are missing."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator

__all__ = ["RangeSet"]


class RangeSet:
    """A set of bytes as sorted ranges that neither overlap nor touch; iteration yields (offset, length).

    Parameters
    ----------
    ranges : iterable of (offset, length)
        In any order; they may overlap. Empty ranges are ignored.
    """

    def __init__(self, ranges: Iterable[tuple[int, int]] = ()) -> None:
        self._starts: list[int] = []
        self._ends: list[int] = []
        for offset, length in sorted(ranges):
            if length <= 0:
                continue
            # In order, so that nothing is searched for or moved.
            if self._ends and offset <= self._ends[-1]:
                self._ends[-1] = max(self._ends[-1], offset + length)
            else:
                self._starts.append(offset)
                self._ends.append(offset + length)

    def add(self, offset: int, length: int) -> None:
        """Add bytes; some or all of them may be in the set already."""
        if length <= 0:
            return
        start, end = offset, offset + length
        first = bisect_left(self._ends, start)
        last = bisect_right(self._starts, end)
        if first < last:
            start = min(start, self._starts[first])
            end = max(end, self._ends[last - 1])
        self._starts[first:last] = [start]
        self._ends[first:last] = [end]

    def run(self, offset: int) -> int:
        """Return the number of consecutive bytes from `offset` on that are in the set."""
        number = bisect_right(self._starts, offset) - 1
        return max(self._ends[number] - offset, 0) if number >= 0 else 0

    def missing(self, offset: int, length: int) -> Iterator[tuple[int, int]]:
        """Return the parts of a range that are not in the set, as (offset, length) in order."""
        position, end = offset, offset + length
        number = bisect_right(self._ends, position)
        while position < end:
            start = self._starts[number] if number < len(self._starts) else end
            if position < start:
                yield position, min(start, end) - position
            if start >= end:
                return
            position = self._ends[number]
            number += 1

    def overlap(self, offset: int, length: int) -> Iterator[tuple[int, int]]:
        """Return the parts of a range that are in the set, as (offset, length) in order."""
        position = offset
        for start, size in self.missing(offset, length):
            if position < start:
                yield position, start - position
            position = start + size
        if position < offset + length:
            yield position, offset + length - position

    def covers(self, offset: int, length: int) -> bool:
        """Return whether a whole range is in the set."""
        return self.run(offset) >= length

    @property
    def total(self) -> int:
        """Number of bytes in the set."""
        return sum(self._ends) - sum(self._starts)

    @property
    def end(self) -> int:
        """The offset after the last byte; 0 for an empty set."""
        return self._ends[-1] if self._ends else 0

    def copy(self) -> RangeSet:
        """Return a copy that can change independently."""
        duplicate = RangeSet()
        duplicate._starts, duplicate._ends = self._starts[:], self._ends[:]
        return duplicate

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return ((start, end - start) for start, end in zip(self._starts, self._ends, strict=True))

    def __len__(self) -> int:
        return len(self._starts)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, RangeSet):
            return NotImplemented
        return self._starts == other._starts and self._ends == other._ends

    __hash__ = None  # type: ignore[assignment]  # it grows

    def __repr__(self) -> str:
        return f"RangeSet({list(self)})"
