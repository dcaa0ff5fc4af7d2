"""Segments in decoding order: the tiles of a level side by side, coarse levels first.

What a segment decodes to depends on the segments of its tile before it, and on what its parent tile knows of the same
bit-planes and of higher ones. So a tile takes all its segments in turn, while what they work on stays in the cache, and
tiles of a level know nothing of each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import zip_longest
from operator import itemgetter
from typing import NamedTuple

from ..entropy.tiles import Reading, Run, Tiles
from ..grid.layout import Layout
from ..parallel import threads

__all__ = ["Coded", "batch_length", "rounds_of"]

#: Bytes of segments that are worth a thread's while.
_WORTH = 1 << 12
#: Bytes of segments that one thread takes at once: more would stand in memory a second time.
_LITTLE = 1 << 16

_tile = itemgetter(0)


class Coded(NamedTuple):
    """A segment with its bytes: ``passes`` passes of a tile down from ``first``; ``offset`` is its place."""

    tile: int
    channel: int
    first: int
    passes: int
    data: bytes | memoryview
    offset: int


def batch_length(layout: Layout, segments: Sequence[Coded]) -> int:
    """Return the number of segments, at least 1, that may be decoded coarse levels first.

    A segment that follows a child whose planes depend on it begins the next batch: its bits must not be known before.
    None of our encoders writes one.
    """
    parents, channels = layout.parents.data, 1 + max((segment.channel for segment in segments), default=0)
    lowest: dict[int, int] = {}  # the lowest plane that was looked at, by the number of a unit
    for number, (tile, channel, first, passes, _, _) in enumerate(segments):
        seen = lowest.get(tile * channels + channel)
        if seen is not None and first >> 1 >= seen:
            return number
        parent, plane = parents[tile], (first - passes + 1) >> 1
        if parent >= 0:
            above = parent * channels + channel
            if plane < lowest.get(above, plane + 1):
                lowest[above] = plane
    return len(segments)


def rounds_of(channels: Sequence[Tiles], segments: Sequence[Coded]) -> list[list[Reading]]:
    """Return the rounds that decode a batch, one after another; the readings of a round may run at the same time."""
    runs: list[list[Run]] = [[] for _ in channels]
    for tile, channel, first, passes, data, _ in segments:
        runs[channel].append(Run(tile, first, first - passes + 1, data))
    channel_rounds = [
        list(_rounds(tiles, channel_runs)) for tiles, channel_runs in zip(channels, runs, strict=True) if channel_runs
    ]
    return [[reading for some in of for reading in some] for of in zip_longest(*channel_rounds, fillvalue=())]


def _rounds(tiles: Tiles, runs: list[Run]) -> Iterator[list[Reading]]:
    """Yield the rounds of a channel: one reading for all levels with few bytes, several for a level with more."""
    runs.sort(key=_tile)
    if sum([len(run.data) for run in runs]) <= (_LITTLE if threads() == 1 else _WORTH):
        yield tiles.readings(runs, [len(runs)])
        return
    level_of = tiles.table.level_of
    ends: list[list[int]] = [[]]
    begin = 0
    while begin < len(runs):
        level, end = level_of(runs[begin].tile), begin
        size, round_ends = 0, []
        while end < len(runs) and level_of(runs[end].tile) == level:
            if size >= _WORTH and runs[end].tile != runs[end - 1].tile:
                round_ends.append(end)
                size = 0
            size += len(runs[end].data)
            end += 1
        round_ends.append(end)
        if len(round_ends) == 1 and len(ends[-1]) < 2:
            ends[-1] = round_ends  # goes on with the reading of the levels below
        else:
            ends.append(round_ends)
        begin = end
    readings = iter(tiles.readings(runs, [end for round_ends in ends for end in round_ends]))
    for round_ends in ends:
        if round_ends:
            yield [next(readings) for _ in round_ends]
