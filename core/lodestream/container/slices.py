"""Slices of a container whose index is known: which segments they complete, and which states those make."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterator, Mapping, Sequence

from ..errors import CorruptStreamError
from . import sections
from .frames import Frame, whole_section
from .model import Index, Piece, Segment

__all__ = ["Slices"]

#: number, level, bytes, rms, max_error, complete: what a view is made of; and the level that is whole, or -1.
State = tuple[int, int, int, float, float, bool, int]


class Slices:
    """Collects bytes at their places and hands each segment and piece of exactness on once, when it is whole.

    Parameters
    ----------
    index : Index
    segments : sequence of Segment
        Those that are wanted, in file order.
    pieces : mapping of int to Piece
        Those that are wanted, by their number.
    partial : bool
        They are not the whole surface: the errors of states on the way are not known (NaN).
    whole : bool
        They are all of the container.
    """

    def __init__(
        self, index: Index, segments: Sequence[Segment], pieces: Mapping[int, Piece], partial: bool, whole: bool
    ) -> None:
        self._index, self._partial, self._whole = index, partial, whole
        numbered = {piece.range.offset: number for number, piece in pieces.items()}
        self._numbers: Mapping[int, int] = numbered
        items: list[Segment | Piece] = [*segments, *pieces.values()]
        self._items = sorted(items, key=lambda item: item.range.offset)
        self._starts = [item.range.offset for item in self._items]
        self._run_start = 0
        self._run = bytearray()
        self._metadata = index.metadata
        self._has_metadata = False
        self._seen: set[int] = set()
        self._bytes = index.header.length
        self._held = 0
        self._segments, self._pieces = len(segments), len(pieces)
        self._corrected = 0
        tiles = index.header.layout.tiles
        self._levels = [tiles[s.tile].level for s in segments]
        self._layer_level = _running_levels([s.layer for s in segments], self._levels, len(index.layers))
        self._by_layer = _Groups([s.layer for s in segments], len(index.layers))
        self._by_level = _Groups(self._levels, len(index.levels))

    def add(self, offset: int, data: bytes) -> None:
        """Take bytes; a run of them ends where the next do not follow."""
        if self._run_start + len(self._run) != offset:
            self._run_start, self._run = offset, bytearray()
        self._run += data

    def items(self) -> Iterator[tuple[Segment | Piece, bytes]]:
        """Segments and pieces that are whole now, in the order of the file."""
        end = self._run_start + len(self._run)
        first = bisect_left(self._starts, self._run_start)
        last = bisect_right(self._starts, end)
        for number in range(first, last):
            item = self._items[number]
            if item.range.end <= end and item.range.offset not in self._seen:
                start = item.range.offset - self._run_start
                self._seen.add(item.range.offset)
                yield item, bytes(self._run[start : start + item.range.length])
        self._drop(end)

    def number(self, piece: Piece) -> int:
        """The number of a piece of exactness."""
        return self._numbers[piece.range.offset]

    def _drop(self, end: int) -> None:
        """Forget bytes that belong to whole items only."""
        keep = end
        place = self._metadata
        if not self._has_metadata:
            if place.offset <= end < place.end:
                keep = min(keep, max(place.offset, self._run_start))
            elif self._run_start <= place.offset and place.end <= end:
                keep = min(keep, place.offset)
        number = bisect_right(self._starts, end) - 1
        if number >= 0 and self._items[number].range.end > end:
            keep = min(keep, max(self._items[number].range.offset, self._run_start))
        del self._run[: keep - self._run_start]
        self._run_start = keep

    def metadata(self) -> Frame | None:
        """The metadata, once, when they are whole."""
        place = self._metadata
        start = place.offset - self._run_start
        if self._has_metadata or start < 0 or place.end > self._run_start + len(self._run):
            return None
        self._has_metadata = True
        return whole_section(bytes(self._run[start : start + place.length]), place.offset, sections.METADATA)

    def hold(self, segment: Segment) -> State | None:
        """Note a segment; the state that it completes, if there is one."""
        self._held += 1
        self._bytes += segment.range.length
        self._by_layer.hold(segment.layer)
        self._by_level.hold(self._index.header.layout.tiles[segment.tile].level)
        return self.state()

    def state(self) -> State | None:
        """The state that is complete now, if it is one; the first ones may need no segment at all."""
        layer = self._by_layer.whole(self._held)
        if layer is not None:
            record = self._index.layers[layer]
            last = layer == len(self._index.layers) - 1
            if last and not self._pieces:
                return self._end(layer)
            return layer, self._layer_level[layer], self._bytes, *self._figures(record.rms, record.max_error), False, -1
        level = self._by_level.whole(self._held)
        if level is not None and level < self._index.header.levels:
            figures = self._index.levels[level]
            return level, level, self._bytes, *self._figures(figures.rms, figures.max_error), False, level
        return None

    def _figures(self, rms: float, max_error: float) -> tuple[float, float]:
        return (math.nan, math.nan) if self._partial else (rms, max_error)

    def _end(self, number: int) -> State:
        last = self._index.levels[-1]
        return number, last.level, self._bytes, last.rms, last.max_error, True, -1

    def hold_piece(self, piece: Piece) -> State | None:
        """Note a piece of exactness; the complete state, if everything is there."""
        if self._held != self._segments:
            raise CorruptStreamError("expected all segments before exactness, got fewer", piece.range.offset)
        self._corrected += 1
        self._bytes += piece.range.length
        if self._corrected < self._pieces:
            return None
        if self._whole and self._index.exactness is not None:
            # With the frame of the section.
            self._bytes += self._index.exactness.length - sum(p.range.length for p in self._index.pieces)
        return self._end(len(self._index.layers))


def _running_levels(layers: Collection[int], levels: Collection[int], count: int) -> list[int]:
    """The finest level with a segment in each layer or before it."""
    finest = [0] * count
    for layer, level in zip(layers, levels, strict=True):
        finest[layer] = max(finest[layer], level)
    for layer in range(1, count):
        finest[layer] = max(finest[layer], finest[layer - 1])
    return finest


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
