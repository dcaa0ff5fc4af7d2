"""Segments are decoded tile by tile and by several threads: to what they decode to in the order of the file."""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container.model import ByteRange, Header
from lodestream.container.reader import read_index
from lodestream.decoding import batches
from lodestream.decoding.batches import Coded, batch_length, rounds_of
from lodestream.decoding.region import Region
from lodestream.decoding.segments import StoredSegments
from lodestream.entropy.bitplanes import pass_count
from lodestream.entropy.tiles import Tiles, TileTable
from lodestream.parallel import VARIABLE, spread
from tests.examples import examples


def rough(shape: tuple[int, int], seed: int) -> NDArray[np.int16]:
    walk = np.random.default_rng(seed).integers(-9, 10, shape).cumsum(0).cumsum(1)
    return (walk // 4).astype(np.int16)


def segments_of(container: bytes) -> tuple[Header, list[Coded]]:
    decoder = ls.Decoder()
    decoder.feed(container)
    assert decoder.header is not None
    return decoder.header, list(decoder._queue._waiting.values())


def decoded(header: Header, segments: list[Coded], at_once: bool) -> list[Tiles]:
    """Channels after all segments, taken in as few batches as may be or one by one."""
    tiles = [Tiles(TileTable.of(header.layout), None, header.large) for _ in range(header.channels)]
    done = 0
    while done < len(segments):
        count = batch_length(header.layout, segments[done:]) if at_once else 1
        for readings in rounds_of(tiles, segments[done : done + count]):
            spread(lambda reading: reading.run(), readings)
        done += count
    return tiles


def assert_same(ours: list[Tiles], expected: list[Tiles]) -> None:
    for one, other in zip(ours, expected, strict=True):
        for name in ("known", "sign", "flags", "early", "models"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)


@pytest.mark.parametrize("count", ["1", "3"])
def test_a_file_of_ours_is_one_batch(count: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, count)
    header, segments = segments_of(ls.encode(ls.Surface(rough((330, 420), 3))))
    assert batch_length(header.layout, segments) == len(segments)
    with patch.object(batches, "_LITTLE", 0):
        assert any(len(readings) > 3 for readings in rounds_of(decoded(header, [], True), segments))
        assert_same(decoded(header, segments, True), decoded(header, segments, False))
    assert_same(decoded(header, segments, True), decoded(header, segments, False))


def test_one_thread_takes_little_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "1")
    header, segments = segments_of(ls.encode(ls.Surface(rough((99, 120), 3))))
    assert [len(readings) for readings in rounds_of(decoded(header, [], True), segments)] == [1]


@examples(12)
@given(seed=st.integers(0, 2**32), swaps=st.integers(1, 400), late=st.booleans())
def test_what_comes_after_its_children_has_not_been_seen_by_them(seed: int, swaps: int, late: bool) -> None:
    """Segments in another order, but for those of one tile: no writer of ours, yet such a file has one meaning."""
    header, segments = segments_of(ls.encode(ls.Surface(rough((130, 260), seed % 5))))
    rng = np.random.default_rng(seed)
    for place in rng.integers(0, len(segments) - 1, swaps).tolist():
        one, other = segments[place : place + 2]
        if one.tile != other.tile:
            segments[place : place + 2] = other, one
    if late:
        tile = segments[int(rng.integers(len(segments)))].tile
        segments = [s for s in segments if s.tile != tile] + [s for s in segments if s.tile == tile]
    assert_same(decoded(header, segments, True), decoded(header, segments, False))


def test_a_parent_after_its_child_begins_a_batch() -> None:
    header, segments = segments_of(ls.encode(ls.Surface(rough((130, 260), 1))))
    tiles = header.layout.tiles
    last = max(range(len(segments)), key=lambda number: tiles[segments[number].tile].level)
    parent = tiles[segments[last].tile].parent
    late = [s for s in segments if s.tile != parent] + [s for s in segments if s.tile == parent]
    assert batch_length(header.layout, late) == len([s for s in segments if s.tile != parent])


def test_stored_segments_are_decoded_in_the_order_of_the_file() -> None:
    """A parent at the end of the file has not been seen by its children, whichever tile is read first."""
    container = ls.encode(ls.Surface(rough((130, 260), 1)))
    index = read_index(lambda offset, length: container[offset : offset + length], len(container))
    tiles = index.header.layout.tiles
    parent = tiles[max(index.segments, key=lambda segment: tiles[segment.tile].level).tile].parent
    late = [s for s in index.segments if s.tile != parent] + [s for s in index.segments if s.tile == parent]
    data = b"".join([container[s.range.offset : s.range.offset + s.range.length] for s in late])
    places = accumulate((s.range.length for s in late), initial=0)
    moved = [s._replace(range=ByteRange(place, s.range.length)) for s, place in zip(late, places, strict=False)]

    remaining: dict[int, int] = {}
    one_by_one = []
    for s in moved:
        first = remaining.get(s.tile, pass_count(s.top))
        remaining[s.tile] = first - s.passes
        end = s.range.offset + s.range.length
        one_by_one.append(Coded(s.tile, s.channel, first - 1, s.passes, data[s.range.offset : end], s.range.offset))
    assert batch_length(index.header.layout, one_by_one) < len(one_by_one)

    stored = StoredSegments(
        lambda offset, length: data[offset : offset + length], replace(index, segments=tuple(moved))
    )
    whole = Region.whole(index.header.layout, index.header.levels)
    assert_same(stored.channels(whole), decoded(index.header, one_by_one, False))


def test_views_are_the_same_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    container = ls.encode(ls.Surface(rough((500, 420), 7)))
    shown = []
    for count in ("1", "2", "5"):
        monkeypatch.setenv(VARIABLE, count)
        decoder = ls.Decoder()
        views = []
        for start in range(0, len(container), 5000):
            views += decoder.feed(container[start : start + 5000])
        shown.append([view.points for view in (*views[:: max(1, len(views) // 6)], decoder.view())])
    for other in shown[1:]:
        for ours, expected in zip(other, shown[0], strict=True):
            np.testing.assert_array_equal(ours, expected)
