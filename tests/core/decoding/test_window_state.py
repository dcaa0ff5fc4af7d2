"""What a receiver of a window takes for known of the tiles that it does not get."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import lodestream as ls
from lodestream.container.slices import State
from lodestream.decoding.window_state import WindowState
from lodestream.entropy.dequantize import UNANNOUNCED
from lodestream.planning.selection import Selection

from ..surfaces import index_of


def test_a_level_of_which_passes_are_left_is_never_known() -> None:
    """Where a tile outside the window stays without its last passes, not even the last layer makes its level known."""
    heights = np.random.default_rng(5).normal(size=(150, 140)).cumsum(axis=0).astype(np.float32)
    index, selection = index_of(ls.encode(heights)), Selection(((0, 9), (0, 9)))
    header = index.header
    inside = selection.tiles(header)
    last = next(segment for segment in reversed(index.segments) if not inside[segment.tile])
    others = tuple(segment for segment in index.segments if segment is not last)
    level = header.layout.tile_levels == header.layout.level_of(last.tile)
    made = State(header.layer_count - 1, header.levels, 0, 1.0, 1.0, complete=False, all_layers=True)
    for segments, expected in ((index.segments, 0), (others, UNANNOUNCED)):
        window = WindowState(header, selection)
        window.follow(replace(index, segments=segments))
        state = np.full((len(inside), header.channels), UNANNOUNCED, np.int8)
        window.put_outside(made, state)
        assert (state[level & ~inside, last.channel] == expected).all()
