"""Slices of a container whose index is known: which segments they complete, and which states those give."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import CorruptStreamError
from . import sections
from .frames import Frame, whole_section
from .model import Chunk, Index, Segment

__all__ = ["Slices", "State"]


class State(NamedTuple):
    """What a view is made of; its errors are those that the whole surface has in this state.

    ``all_layers`` says that no layer is missing: units that none names are known to have only zeros. ``whole_level`` is
    the level to which, counted from the coarsest, everything is there where levels come one after another, else -1.
    ``whole_near`` says that nothing but residual is missing in the region that comes first. ``channels`` are the errors
    of each channel, where these are known.
    """

    number: int
    level: int
    bytes: int
    rms: float
    max_error: float
    complete: bool
    all_layers: bool
    whole_level: int = -1
    whole_near: bool = False
    channels: tuple[tuple[float, float], ...] = ()


class Slices:
    """Collects bytes at their places and hands each segment and chunk of residual on once, when it is whole.

    Parameters
    ----------
    index : Index
    segments : sequence of Segment
        Those that are wanted, in file order.
    chunks : mapping of int to Chunk
        Those that are wanted, by their number.
    whole : bool
        They are all of the container.
    level : int or None
        The finest level of the segments that are wanted; None: full resolution. A layer that has finer ones is then no
        state.
    """

    def __init__(
        self,
        index: Index,
        segments: Sequence[Segment],
        chunks: Mapping[int, Chunk],
        whole: bool,
        level: int | None = None,
    ) -> None:
        self._index, self._whole = index, whole
        self._level = index.header.levels if level is None else level
        numbered = {chunk.range.offset: number for number, chunk in chunks.items()}
        self._numbers: Mapping[int, int] = numbered
        items: list[Segment | Chunk] = [*segments, *chunks.values()]
        self._items = sorted(items, key=lambda item: item.range.offset)
        self._starts = [item.range.offset for item in self._items]
        # What is not whole yet: runs of bytes by the place where each goes on, several where the order has changed.
        self._runs: dict[int, tuple[int, bytearray]] = {}
        self._run_start = 0
        self._run = bytearray()
        self._metadata = index.metadata
        self._has_metadata = False
        self._seen: set[int] = set()
        self._bytes = index.header.length
        self._in_file = False
        self._received = 0
        self._finest = 0
        self._near_tiles: NDArray[np.bool_] | None = None
        self._near: tuple[_Groups, ...] = ()
        self._reached: list[int] | None = None  # None while all comes in order
        self._segments, self._chunks = len(segments), len(chunks)
        self._corrected = 0
        self._wanted = segments
        self._level_of = index.header.layout.tile_levels.data
        self._levels = [self._level_of[s.tile] for s in segments]
        self._layer_level = _running_levels([s.layer for s in segments], self._levels, len(index.layers))
        self._by_layer = _Groups([s.layer for s in segments], len(index.layers))
        self._by_level = _Groups(self._levels, self._level + 1)

    def continue_file(self, position: int) -> None:
        """Begin where a file was read in order up to a section that ends at ``position``.

        All bytes of the surface count from there on, not only those of segments and chunks.
        """
        self._in_file, self._bytes = True, position
        for item in self._items[: bisect_left(self._starts, position)]:
            self._seen.add(item.range.offset)
            if isinstance(item, Chunk):
                self._corrected += 1
            else:
                self._count(item)

    def focus(self, tiles: NDArray[np.bool_] | None) -> None:
        """From now on, detect complete layers and levels in these tiles too; bool, (tile,); None: in no tiles."""
        self._near_tiles, self._near = tiles, ()
        if tiles is not None:
            missing = [
                (segment.layer, level)
                for segment, level in zip(self._wanted, self._levels, strict=True)
                if tiles[segment.tile] and segment.range.offset not in self._seen
            ]
            self._near = (
                _Groups([layer for layer, _ in missing], len(self._index.layers)),
                _Groups([level for _, level in missing], self._level + 1),
            )
        self._reached = self._groups_reached()

    def add(self, offset: int, data: bytes) -> None:
        """Add bytes; they are appended to the run of bytes that ends where they begin, if there is one."""
        if self._run_start + len(self._run) != offset:
            if self._run:
                self._runs[self._run_start + len(self._run)] = self._run_start, self._run
            self._run_start, self._run = self._runs.pop(offset, (offset, bytearray()))
        self._run += data
        if self._in_file:
            self._bytes += max(min(offset + len(data), self._index.surface_end) - offset, 0)

    def items(self) -> Iterator[tuple[Segment | Chunk, bytes]]:
        """Yield segments and chunks that are complete now, in the order of the file."""
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

    def number(self, chunk: Chunk) -> int:
        """Return the number of a chunk of residual."""
        return self._numbers[chunk.range.offset]

    def _drop(self, end: int) -> None:
        """Delete bytes of complete items."""
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
        """Return the metadata section once, when it is complete."""
        place = self._metadata
        start = place.offset - self._run_start
        if self._has_metadata or start < 0 or place.end > self._run_start + len(self._run):
            return None
        self._has_metadata = True
        return whole_section(bytes(self._run[start : start + place.length]), place.offset, sections.METADATA)

    def hold(self, segment: Segment) -> State | None:
        """Record a segment; return the state that it completes, if there is one."""
        if not self._in_file:
            self._bytes += segment.range.length
        self._count(segment)
        return self.state()

    def _count(self, segment: Segment) -> None:
        """Count a segment in its layer, its level, and the focus."""
        level = self._level_of[segment.tile]
        self._received += 1
        self._finest = max(self._finest, level)
        self._by_layer.hold(segment.layer)
        self._by_level.hold(level)
        if self._near_tiles is not None and self._near_tiles[segment.tile]:
            for groups, number in zip(self._near, (segment.layer, level), strict=True):
                groups.hold(number)

    def state(self) -> State | None:
        """Return the state that is complete now, if there is one; the first ones may need no segment at all."""
        risen = self._risen()
        layer, level = (groups.whole(self._received) for groups in (self._by_layer, self._by_level))
        ended = level == self._level < self._index.header.levels
        if layer is not None and self._index.layers[layer].level <= self._level and not ended:
            record = self._index.layers[layer]
            last = layer == len(self._index.layers) - 1
            if last and not self._chunks:
                return self._end(layer)
            size = record.end if self._in_file else self._bytes
            finest = self._layer_level[layer]
            known = record.errors
            return State(layer, finest, size, *known[:2], False, last, channels=known.channels)
        if level is not None and level < self._index.header.levels and not self._in_file:
            known = self._index.levels[level].errors
            return State(level, level, self._bytes, *known[:2], False, False, level, channels=known.channels)
        # Out of order, complete layers are mixed with parts of later ones.
        if not risen:
            return None
        whole_near = bool(self._near) and self._near[0].reached == len(self._index.layers) - 1
        return State(max(risen), self._finest, self._bytes, math.nan, math.nan, False, False, whole_near=whole_near)

    def _risen(self) -> list[int]:
        """Return the groups completed since the last call; none while everything arrives in order."""
        if self._reached is None:
            return []
        before, self._reached = self._reached, self._groups_reached()
        return [now for was, now in zip(before, self._reached, strict=True) if now > was]

    def _groups_reached(self) -> list[int]:
        """Return the last complete layer (and level, if not in file order), everywhere and in the focus."""
        kinds = 1 if self._in_file else 2
        return [groups.reached for pair in ((self._by_layer, self._by_level), self._near) for groups in pair[:kinds]]

    def _end(self, number: int) -> State:
        """Return the final state."""
        last = self._index.levels[-1]
        size = self._index.surface_end if self._in_file else self._bytes
        return State(number, last.level, size, last.rms, last.max_error, True, True, channels=last.channels)

    def hold_chunk(self, chunk: Chunk) -> State | None:
        """Record a chunk of residual; return the complete state, if everything has arrived.

        Raises
        ------
        CorruptStreamError
            If a segment is still missing: the residual refers to the complete lattice.
        """
        if self._received != self._segments:
            raise CorruptStreamError("expected all segments before residual, got fewer", chunk.range.offset)
        self._corrected += 1
        if not self._in_file:
            self._bytes += chunk.range.length
        if self._corrected < self._chunks:
            return None
        if self._whole and not self._in_file and self._index.residual is not None:
            # With the frame of the section.
            self._bytes += self._index.residual.length - sum(p.range.length for p in self._index.chunks)
        return self._end(len(self._index.layers))


def _running_levels(layers: Collection[int], levels: Collection[int], count: int) -> list[int]:
    """Return the finest level with a segment in each layer or before it."""
    finest = [0] * count
    for layer, level in zip(layers, levels, strict=True):
        finest[layer] = max(finest[layer], level)
    for layer in range(1, count):
        finest[layer] = max(finest[layer], finest[layer - 1])
    return finest


class _Groups:
    """Counts segments by layer, or by level: which first groups are complete, and whether nothing else was received."""

    def __init__(self, groups: list[int], count: int) -> None:
        self._missing = [0] * count
        for group in groups:
            self._missing[group] += 1
        total = 0
        self._ends = [total := total + missing for missing in self._missing]
        self._next = 0
        self._pass()

    def _pass(self) -> None:
        """Advance over complete groups."""
        while self._next < len(self._missing) and self._missing[self._next] == 0:
            self._next += 1

    def hold(self, group: int) -> None:
        """Count a segment of a group."""
        self._missing[group] -= 1
        self._pass()

    @property
    def reached(self) -> int:
        """The last of the groups that are whole with all before them, -1 if there is none."""
        return self._next - 1

    def whole(self, received: int) -> int | None:
        """Return the last complete group, if the groups up to it are all that was received."""
        last = self._next - 1
        return last if last >= 0 and self._ends[last] == received else None
