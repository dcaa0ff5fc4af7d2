"""A source of bytes that counts what is read of it."""

from __future__ import annotations

from lodestream.opening.byte_sources import MemorySource
from lodestream.planning.byte_ranges import RangeSet

__all__ = ["Counting"]


class Counting(MemorySource):
    """A container in memory.

    Attributes
    ----------
    reads : int
        How often something was read.
    taken : int
        Bytes that were read, as often as they were.
    ranges : RangeSet
        What was read.
    """

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self.forget()

    def forget(self) -> None:
        """Begin to count."""
        self.reads = self.taken = 0
        self.ranges = RangeSet()

    def read(self, offset: int, length: int) -> bytes:
        data = super().read(offset, length)
        self.reads += 1
        self.taken += len(data)
        self.ranges.add(offset, len(data))
        return data
