"""Slices of a container whose index is known: which segments they complete, and which states those make."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator

from ..errors import CorruptStreamError
from . import sections
from .frames import Frame, whole_section
from .model import Index, Segment

__all__ = ["Slices"]

#: number, level, bytes, rms, max_error, complete: what a view is made of.
State = tuple[int, int, int, float, float, bool]


class Slices:
    """Collects bytes at their places and hands each segment on once, when it is whole."""

    def __init__(self, index: Index) -> None:
        self._index = index
        self._segments = sorted(index.segments, key=lambda segment: segment.range.offset)
        self._starts = [segment.range.offset for segment in self._segments]
        self._run_start = 0
        self._run = bytearray()
        self._wanted = {place.offset: place for place in (index.exactness, index.metadata) if place}
        self._seen: set[int] = set()
        self._bytes = index.header.length
        self._held = 0
        self._corrected = False
        tiles = index.header.layout.tiles
        self._by_layer = _Groups([s.layer for s in index.segments], len(index.layers))
        self._by_level = _Groups([tiles[s.tile].level for s in index.segments], len(index.levels))

    def add(self, offset: int, data: bytes) -> None:
        """Take bytes; a run of them ends where the next do not follow."""
        if self._run_start + len(self._run) != offset:
            self._run_start, self._run = offset, bytearray()
        self._run += data

    def segments(self) -> Iterator[tuple[Segment, bytes]]:
        """Segments that are whole now, in the order of the file."""
        end = self._run_start + len(self._run)
        first = bisect_left(self._starts, self._run_start)
        last = bisect_right(self._starts, end)
        for number in range(first, last):
            segment = self._segments[number]
            if segment.range.end <= end and segment.range.offset not in self._seen:
                start = segment.range.offset - self._run_start
                self._seen.add(segment.range.offset)
                yield segment, bytes(self._run[start : start + segment.range.length])
        self._drop(end)

    def _drop(self, end: int) -> None:
        """Forget bytes that belong to whole segments only."""
        number = bisect_right(self._starts, end) - 1
        keep = end
        for place in self._wanted.values():
            if place.offset <= end < place.end:
                keep = min(keep, max(place.offset, self._run_start))
            elif self._run_start <= place.offset and place.end <= end:
                keep = min(keep, place.offset)
        if number >= 0 and self._segments[number].range.end > end:
            keep = min(keep, max(self._segments[number].range.offset, self._run_start))
        del self._run[: keep - self._run_start]
        self._run_start = keep

    def sections(self) -> Iterator[Frame]:
        """Exactness and metadata, when they are whole."""
        for place in list(self._wanted.values()):
            start = place.offset - self._run_start
            if start >= 0 and place.end <= self._run_start + len(self._run):
                del self._wanted[place.offset]
                kind = sections.METADATA if place == self._index.metadata else sections.EXACTNESS
                yield whole_section(bytes(self._run[start : start + place.length]), place.offset, kind)

    def hold(self, segment: Segment) -> State | None:
        """Note a segment; the state that it completes, if its errors are known."""
        self._held += 1
        self._bytes += segment.range.length
        self._by_layer.hold(segment.layer)
        self._by_level.hold(self._index.header.layout.tiles[segment.tile].level)
        return self.state()

    def state(self) -> State | None:
        """The state that is complete now, if its errors are known; the first ones may need no segment at all."""
        layer = self._by_layer.whole(self._held)
        if layer is not None:
            record = self._index.layers[layer]
            complete = layer == len(self._index.layers) - 1 and self._index.exactness is None
            return layer, record.level, self._bytes, record.rms, record.max_error, complete
        level = self._by_level.whole(self._held)
        if level is not None and level < self._index.header.levels:
            figures = self._index.levels[level]
            return level, level, self._bytes, figures.rms, figures.max_error, False
        return None

    def hold_exactness(self) -> State | None:
        """Note the exactness section; the complete state, if all segments are there."""
        if self._index.exactness is None or self._held != len(self._segments):
            raise CorruptStreamError("expected all segments before exactness, got fewer", self._run_start)
        self._bytes += self._index.exactness.length
        last = self._index.levels[-1]
        return len(self._index.layers), last.level, self._bytes, last.rms, last.max_error, True


class _Groups:
    """Segments by layer, or by level: when are the first groups whole, and nothing else held?"""

    def __init__(self, groups: list[int], count: int) -> None:
        self._missing = [0] * count
        for group in groups:
            self._missing[group] += 1
        total = 0
        self._ends = [total := total + missing for missing in self._missing]
        self._next = 0
        self._pass()

    def _pass(self) -> None:
        while self._next < len(self._missing) and self._missing[self._next] == 0:
            self._next += 1

    def hold(self, group: int) -> None:
        self._missing[group] -= 1
        self._pass()

    def whole(self, held: int) -> int | None:
        """The last of the groups that are whole, if these are all that is held."""
        last = self._next - 1
        return last if last >= 0 and self._ends[last] == held else None
