"""Arrays of many small grids are filled by one call of a kernel for those of one width."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.entropy.tiles import Tiles, TileTable
from lodestream.grid.layout import Grid, Layout
from lodestream.quantization.band_steps import Quantiser
from lodestream.transform.pyramid import allocate, grids

SHAPES = [(9, 1), (17, 1), (17, 17), (17, 17), (17, 9), (17, 17), (9, 17)]


def filled(layout: Layout) -> Tiles:
    tiles = Tiles(TileTable.of(layout), Quantiser(1))
    random = np.random.default_rng(0)
    tiles.known[:] = random.integers(0, 99, tiles.known.shape)
    tiles.sign[:] = np.sign(random.integers(-9, 9, tiles.sign.shape))
    return tiles


@pytest.mark.parametrize("passed_over", [(), (0, 1), (3,)])
def test_arrays_in_one_piece_hold_what_each_one_would(
    passed_over: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = Layout([Grid(shape, (False, False)) for shape in SHAPES], (3, 3))
    tiles = filled(layout)
    state = np.random.default_rng(1).choice([0, 3, kernels.CLASSES], len(layout.tiles)).astype(np.int8)
    calls: list[tuple[int, ...]] = []
    spread = kernels.spread

    def counted(*values: Any) -> int:
        calls.append(values[9].shape)
        return spread(*values)

    monkeypatch.setattr(kernels, "spread", counted)
    results: list[list[NDArray[np.int32]]] = []
    counts = []
    for together in (True, False):
        made = grids(layout, layout.levels) if together else [allocate(shape) for shape in SHAPES]
        for array in made:
            array[...] = 7
        arrays = [None if number in passed_over else array for number, array in enumerate(made)]
        calls.clear()
        tiles.spread_levels(layout.levels, state, tiles.stacks(arrays), 1)
        results.append(made)
        counts.append(len(calls))
    for array, alone in zip(*results, strict=True):
        np.testing.assert_array_equal(array, alone)
    assert counts[1] == len(SHAPES) - len(passed_over)
    assert counts[0] <= counts[1] - 2
