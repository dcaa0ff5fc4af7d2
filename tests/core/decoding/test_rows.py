"""Some rows in any state: the rows of the whole in that state."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from lodestream.decoding.reconstruction import reconstruct_channel
from lodestream.decoding.rows import RowsGeometry, RowsReconstructor, known_state
from lodestream.entropy.dequantize import UNANNOUNCED
from lodestream.entropy.part_table import Part, flat_span, part_of
from lodestream.entropy.tiles import Tiles, TileTable
from lodestream.grid.layout import Grid, Layout
from lodestream.transform.predictors import default_predictors

lengths = st.integers(1, 70) | st.integers(1, 300)


def _part(tiles: Tiles, geometry: RowsGeometry) -> Tiles:
    """The same tiles as far as the geometry needs them."""
    part: Part = part_of(tiles.table, geometry.tiles)
    own = Tiles(part.table)
    for run, span in part.spans:
        whole = flat_span(tiles.table, run)
        for mine, every in ((own.known, tiles.known), (own.sign, tiles.sign), (own.early, tiles.early)):
            mine[span] = every[whole]
    return own


def _span(ends: list[float], length: int) -> tuple[int, int]:
    start, stop = sorted(int(end * length) for end in ends)
    start = min(start, length - 1)
    return start, max(stop, start + 1)


@settings(deadline=None)
@given(
    st.tuples(lengths, lengths),
    st.tuples(st.booleans(), st.booleans()),
    st.tuples(st.integers(1, 4), st.integers(1, 4)),
    st.lists(st.floats(0, 1), min_size=4, max_size=4),
    st.integers(0, 12),
    st.integers(0, 2**32 - 1),
)
@example((250, 9), (True, True), (2, 2), [0.0, 0.1, 0.0, 1.0], 0, 0)
@example((251, 9), (True, True), (2, 2), [0.9, 1.0, 0.0, 1.0], 0, 0)
@example((298, 9), (True, False), (2, 2), [0.0, 0.03, 0.2, 0.7], 2, 1)
@example((284, 9), (True, False), (2, 2), [0.97, 1.0, 0.2, 0.7], 0, 2)
@example((160, 9), (True, False), (2, 2), [0.0, 1.0, 0.0, 1.0], 0, 3)
def test_windows_are_those_of_the_whole(
    shape: tuple[int, int],
    closed: tuple[bool, bool],
    tile: tuple[int, int],
    ends: list[float],
    core: int,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    layout = Layout.single(shape, closed, tile)
    tiles = Tiles(TileTable.of(layout))
    tiles.known[:] = rng.integers(0, 2**12, tiles.known.size)
    tiles.sign[:] = np.where(tiles.known, rng.choice([-1, 1], tiles.sign.size), 0)
    tiles.early[:] = rng.integers(0, 13, tiles.early.size)
    predictors = default_predictors(layout)
    predictors[...] = rng.integers(-20, 30, predictors.shape)
    header: Any = SimpleNamespace(layout=layout, predictors=[predictors], geometric=1)
    rows, columns = _span(ends[:2], shape[0]), _span(ends[2:], shape[1])
    core = min(core, layout.levels)
    every, some = RowsGeometry(layout, rows, core), RowsGeometry(layout, rows, core, columns)
    assert every.tiles == some.tiles
    part = _part(tiles, every)
    made = [
        (RowsReconstructor(geometry, predictors, own), own, geometry.columns)
        for geometry in (every, some)
        for own in (tiles, part)
    ]
    state = np.full(len(layout.tiles), UNANNOUNCED, np.int8)
    for _ in range(4):
        changed = rng.random(state.shape) < 0.5
        changed[: layout.tiles_of(int(rng.integers(0, layout.levels + 1))).start] = False
        state = np.where(changed, rng.choice([0, 0, 0, 1, 4, 7, UNANNOUNCED], state.shape), state).astype(np.int8)
        (whole,), fraction = reconstruct_channel(header, 0, tiles, state, layout.levels)
        for reconstructor, own, taken in made:
            known = known_state(own.table, state)
            found = reconstructor.reconstruct(known)
            assert found[1] == fraction
            np.testing.assert_array_equal(found[0], whole[slice(*rows), slice(*taken)])
            assert reconstructor.is_shown(known)


def test_several_grids_are_refused() -> None:
    with pytest.raises(ValueError, match="one grid, got 2"):
        RowsGeometry(Layout([Grid((9, 9)), Grid((9, 9))], (3, 3)), (0, 3), 0)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("length", [4000, 4001, 4002, 4004, 4006, 8010, 1 << 12])
def test_some_rows_need_some_more_of_each_level(length: int, closed: bool) -> None:
    layout = Layout.single((length, 9), (closed, False), (2, 2))
    for start in (0, 1, 1000, length - 150):
        stop = min(start + 200, length)
        geometry = RowsGeometry(layout, (start, stop), 3)
        for step, tiles in zip(geometry.steps, geometry.levels[1:], strict=True):
            wanted = (stop - start) / 2 ** (layout.levels - step.level)
            assert step.shape[0] <= min(wanted + 120, layout.shape(0, step.level)[0])
            # Nodes and details of tiles of four rows, which the rows may begin and end within.
            assert sum(map(len, tiles)) <= 2 * (step.shape[0] // 8 + 6)
