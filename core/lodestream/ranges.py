"""Sets of bytes of a file, as ranges: what is held of a container, and what of a slice is missing."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator

__all__ = ["RangeSet"]


class RangeSet:
    """Bytes of a file as sorted ranges that neither overlap nor touch; iterating gives (offset, length).

    Parameters
    ----------
    ranges : iterable of (offset, length)
        In any order; they may overlap. Empty ones are left out.
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
        """Add bytes; some of them, or all, may be there already."""
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
        """How many bytes from `offset` on are there without a gap."""
        number = bisect_right(self._starts, offset) - 1
        return max(self._ends[number] - offset, 0) if number >= 0 else 0

    def missing(self, offset: int, length: int) -> Iterator[tuple[int, int]]:
        """What of a range is not there, as (offset, length) in order."""
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
        """What of a range is there, as (offset, length) in order."""
        position = offset
        for start, size in self.missing(offset, length):
            if position < start:
                yield position, start - position
            position = start + size
        if position < offset + length:
            yield position, offset + length - position

    def covers(self, offset: int, length: int) -> bool:
        """Whether all of a range is there."""
        return self.run(offset) >= length

    @property
    def total(self) -> int:
        """How many bytes there are."""
        return sum(self._ends) - sum(self._starts)

    @property
    def end(self) -> int:
        """The first byte after all of them; 0 where there are none."""
        return self._ends[-1] if self._ends else 0

    def copy(self) -> RangeSet:
        """A set of the same bytes that grows by itself."""
        made = RangeSet()
        made._starts, made._ends = self._starts[:], self._ends[:]
        return made

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
