"""A region of any kind, at any level and in any state, is the part of what is made of the whole surface."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.decoding.reconstructor import Reconstructor, known_state
from lodestream.decoding.region import Region
from lodestream.entropy.dequantize import UNANNOUNCED
from lodestream.entropy.part_table import part_of
from lodestream.entropy.tiles import Tiles, TileTable, gather
from lodestream.grid.layout import Layout
from lodestream.transform.lifting import FRACTION_BITS
from lodestream.transform.pyramid import allocate, forward, grids, inverse
from tests.examples import examples

closures = st.tuples(st.booleans(), st.booleans())


def known_surface(layout: Layout, rng: np.random.Generator) -> tuple[Tiles, NDArray[np.int8]]:
    """All that can be known of random values of one grid, and the predictors."""
    values = allocate(layout.grids[0].shape)
    values[...] = rng.integers(-(2**20), 2**20, values.shape)
    predictors = forward([values], layout)
    tiles = Tiles(TileTable.of(layout))
    flat = gather(tiles.table, [values])
    tiles.known[:], tiles.sign[:] = np.abs(flat), np.sign(flat)
    return tiles, predictors


def any_state(layout: Layout, rng: np.random.Generator) -> NDArray[np.int8]:
    """All tiles known, those of the coarse levels, or anything."""
    state = np.zeros(len(layout.tiles), np.int8)
    kind = rng.integers(3)
    if kind == 0:
        state[layout.tiles_of(int(rng.integers(0, layout.levels + 1))).start :] = UNANNOUNCED
    elif kind == 1:
        state[:] = rng.choice([0, 1, 2, 7, 16, 31, UNANNOUNCED], state.size)
    return state


def whole(
    layout: Layout, tiles: Tiles, predictors: NDArray[np.int8], state: NDArray[np.int8], level: int
) -> tuple[NDArray[np.int32], int]:
    """The only grid at a level, made step by step: what `Reconstructor` does in few calls of a kernel."""
    unknown = [k for k in range(1, level + 1) if state[layout.tiles_of(k).start : layout.tiles_of(k).stop].any()]
    known = unknown[0] - 1 if unknown else level
    arrays = [allocate(layout.shape(0, level))]
    tiles.spread_levels(level, state, tiles.stacks(arrays), known)
    inverse(arrays, layout, predictors, level, known)
    return arrays[0], FRACTION_BITS if known < level else 0


def any_span(length: int, closed: bool, rng: np.random.Generator) -> tuple[int, int]:
    start = int(rng.integers(length))
    return start, int(rng.integers(start + 1, length + (start if closed else 0) + 1))


@examples(50)
@given(
    shape=st.tuples(st.integers(1, 150), st.integers(1, 130)), closed=closures, part=st.booleans(), seed=st.integers(0)
)
def test_any_window_of_any_level_is_that_of_the_whole(
    shape: tuple[int, int], closed: tuple[bool, bool], part: bool, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    layout = Layout.single(shape, closed, (3, 3))
    tiles, predictors = known_surface(layout, rng)
    level = int(rng.integers(layout.levels + 1))
    height, width = layout.shape(0, level)
    spans = any_span(height, closed[0], rng), any_span(width, closed[1], rng)
    core = [None, int(rng.integers(level + 1))][int(rng.integers(2))]
    region = Region.window(layout, level, *spans, core=core)
    assert region.shapes == [tuple(stop - start for start, stop in spans)]
    used = tiles
    if part:
        table = part_of(tiles.table, region.tiles).table
        used = Tiles(table)
        for local, tile in enumerate(np.asarray(table.members).tolist()):
            here = slice(int(table.starts[local]), int(table.starts[local + 1]))
            there = slice(int(tiles.table.starts[tile]), int(tiles.table.starts[tile + 1]))
            used.known[here], used.sign[here] = tiles.known[there], tiles.sign[there]
    memory = [None, np.full(region.size, 12345, np.int32)][int(rng.integers(2))]
    reconstructor = Reconstructor(region, predictors, used, memory=memory)
    coded = {tile for run in region.coded_tiles for tile in run}
    assert {layout.parents[tile] for tile in coded} <= {*coded, -1}
    state = np.zeros(len(layout.tiles), np.int8)
    for changes in (0, 1, 0, 1, 1, len(state), 1, len(state)):
        # Nothing is left, or one tile changes, in the window or beside it, and a level is no longer known whole.
        chosen = rng.permutation(len(state))[:changes]
        state = state.copy() if changes else np.zeros_like(state)
        state[chosen] = any_state(layout, rng)[chosen]
        expected, fraction = whole(layout, tiles, predictors, state, level)
        (array,), made = reconstructor.reconstruct(known_state(used.table, state, level))
        assert made == fraction
        rows, columns = (np.arange(*span) for span in spans)
        assert np.array_equal(array, expected.take(rows, 0, mode="wrap").take(columns, 1, mode="wrap"))


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("length", [1000, 1001, 1002, 1004, 1005, 1006])
def test_windows_across_the_seam_of_a_long_axis(length: int, axis: int) -> None:
    """On one side of the seam, on the other one or on both; some levels have a gap there, others have none."""
    rng = np.random.default_rng(length)
    shape, closed = ((length, 9), (True, False)) if axis == 0 else ((9, length), (False, True))
    layout = Layout.single(shape, closed, (3, 3))
    tiles, predictors = known_surface(layout, rng)
    for start, stop in ((length - 8, length + 5), (length - 1, length + 1), (length - 3, length), (0, 4)):
        spans = ((start, stop), (0, 9)) if axis == 0 else ((0, 9), (start, stop))
        for core in (0, 2, 4):
            state = any_state(layout, rng)
            expected, _ = whole(layout, tiles, predictors, state, layout.levels)
            region = Region.window(layout, layout.levels, *spans, core=core)
            (array,), _ = Reconstructor(region, predictors, tiles).reconstruct(
                known_state(tiles.table, state, layout.levels)
            )
            assert np.array_equal(array, expected.take(np.arange(start, stop), axis, mode="wrap"))


@pytest.mark.parametrize(
    ("shape", "tile", "spans"),
    [((4, 41), (3, 1), ((1, 4), (28, 41))), ((612, 49), (1, 4), ((175, 178), (14, 30)))],
)
def test_parents_of_coded_tiles_are_coded_where_the_level_below_needs_none_of_them(
    shape: tuple[int, int], tile: tuple[int, int], spans: tuple[tuple[int, int], tuple[int, int]]
) -> None:
    layout = Layout.single(shape, (False, False), tile)
    region = Region.window(layout, layout.levels, *spans, core=2)
    coded = [number for run in region.coded_tiles for number in run]
    needed = {number for run in region.tiles for number in run}
    parents = {layout.parents[number] for number in coded}
    assert parents <= {*coded, -1}
    assert not parents <= {*needed, -1}


@examples(30)
@given(shape=st.tuples(st.integers(1, 90), st.integers(1, 90)), closed=closures, seed=st.integers(0))
def test_rows_above_a_level_that_is_made_already(shape: tuple[int, int], closed: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    layout = Layout.single(shape, closed, (3, 3))
    tiles, predictors = known_surface(layout, rng)
    level = int(rng.integers(layout.levels + 1))
    core = max(level - 1, 0)
    state = any_state(layout, rng)
    below = whole(layout, tiles, predictors, state, core)
    expected, fraction = whole(layout, tiles, predictors, state, level)
    if level == core:
        return
    known = known_state(tiles.table, state, level)
    rows = any_span(len(expected), False, rng)
    region = Region.window(layout, level, rows, (0, expected.shape[1]), core)
    (array,), made = Reconstructor(region, predictors, tiles, below=below).reconstruct(known)
    assert made == fraction
    assert np.array_equal(array, expected[slice(*rows)])


def test_all_grids_of_a_level() -> None:
    rng = np.random.default_rng(3)
    layout = Layout.single((70, 50), (False, True), (3, 3))
    tiles, predictors = known_surface(layout, rng)
    for level in range(layout.levels + 1):
        state = any_state(layout, rng)
        expected, fraction = whole(layout, tiles, predictors, state, level)
        region = Region.whole(layout, level)
        (array,), made = Reconstructor(region, predictors, tiles).reconstruct(known_state(tiles.table, state, level))
        assert made == fraction
        assert np.array_equal(array, expected)
        assert len(grids(layout, level)) == len(region.grids) == 1
