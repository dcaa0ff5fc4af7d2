"""What is decoded of a complete file after some of its layers is what a decoder shows after the same."""

from __future__ import annotations

import io
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.container.model import Header, Index
from lodestream.container.reader import read_index
from lodestream.decoding import pieces
from lodestream.decoding.level_grids import level_nodes
from lodestream.decoding.pieces import region_of_window
from lodestream.decoding.region import Region
from lodestream.decoding.segments import StoredSegments
from lodestream.decoding.view import View
from lodestream.grid.window import spanning
from lodestream.target import Region as Window
from tests.examples import examples

from .test_every_state import Case, cases, unnamed_interface, unnamed_tile


def stored(data: bytes, chosen: list[bool] | None = None) -> tuple[StoredSegments, Index, list[int]]:
    """Its segments, its index, and the offsets that are read from now on."""
    file, offsets = io.BytesIO(data), list[int]()

    def read(offset: int, length: int) -> bytes:
        offsets.append(offset)
        file.seek(offset)
        return file.read(length)

    index = read_index(read, len(data))
    offsets.clear()
    return StoredSegments(read, index, None if chosen is None else np.array(chosen)), index, offsets


def window_of(header: Header, level: int, rng: np.random.Generator) -> Window:
    """Rows and columns of the full grid, with nodes of a level of the only block."""
    nodes = level_nodes(header, level)[0]
    spans = [sorted(rng.choice(len(line) + 1, 2, replace=False).tolist()) for line in nodes]
    (top, bottom), (left, right) = spans
    return spanning(((top, bottom), (left, right)), header.shape, nodes)


def assert_as_shown(segments: StoredSegments, region: Region, layers: int | None, view: View) -> None:
    """All channels of a region, bit for bit those of the level that the view shows."""
    level = Region.whole(region.layout, region.level)
    corrected = view._corrected and region.level == segments.header.levels
    shown = view._queue.values(view._length, view._state, level, corrected)
    for block, found in segments.values(region, layers).items():
        for array, whole in zip(found.arrays, shown[block].arrays, strict=True):
            expected = region.of_block(whole)
            assert (array.dtype, array.shape) == (expected.dtype, expected.shape)
            assert array.tobytes() == expected.tobytes()


@examples(16)
@example(case=unnamed_tile(), seed=1, level=5, bands=False)
@example(case=unnamed_interface(), seed=1, level=3, bands=True)
@given(case=cases(), seed=st.integers(0, 2**32), level=st.integers(0, 9), bands=st.booleans())
def test_each_prefix_of_layers_gives_what_a_decoder_shows(case: Case, seed: int, level: int, bands: bool) -> None:
    segments, index, offsets = stored(case.data)
    header, rng = segments.header, np.random.default_rng(seed)
    views = ls.Decoder().feed(case.data)
    small = 0 if bands else pieces._ONE_CALL_VALUES
    shared = patch.object(pieces, "_SHARED_VALUES", min(small, pieces._SHARED_VALUES))
    with patch.object(pieces, "_ONE_CALL_VALUES", small), shared:
        for number in {level % (header.levels + 1), header.levels}:
            window = window_of(header, number, rng) if len(header.blocks) == 1 else None
            region = region_of_window(header, number, window)
            for view in views[: header.layer_count]:
                offsets.clear()
                assert_as_shown(segments, region, view.number + 1, view)
                assert all(offset < index.layers[view.number].end for offset in offsets)
            assert_as_shown(segments, region, None, views[-1])


@pytest.mark.parametrize("layers", [1, 3, None])
def test_only_chosen_channels_are_read(layers: int | None) -> None:
    """Of those that are, the values are the same."""
    heights = np.random.default_rng(5).normal(size=(90, 70)).cumsum(axis=0).astype(np.float32)
    data = ls.encode(ls.Surface(heights, attributes={"other": heights[::-1].copy()}))
    (segments, index, offsets), (every, _, _) = stored(data, [True, False]), stored(data)
    region = region_of_window(index.header, index.header.levels, ((10, 30), (20, 50)))
    found, expected = segments.values(region, layers)[0], every.values(region, layers)[0]
    assert found.arrays[0].tobytes() == expected.arrays[0].tobytes()
    assert not found.arrays[1].any()
    of_other = {segment.range.offset for segment in index.segments if segment.channel == 1}
    assert offsets
    assert of_other.isdisjoint(offsets)
