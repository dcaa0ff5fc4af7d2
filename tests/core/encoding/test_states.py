"""States reconstructed one after another: what each holds by itself, whatever came before it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.decoding.reconstructor import Reconstructor, known_state
from lodestream.decoding.region import Region
from lodestream.entropy.dequantize import UNANNOUNCED
from lodestream.entropy.tiles import Tiles, TileTable
from lodestream.grid.layout import Grid, Layout, Source
from lodestream.parallel import VARIABLE
from lodestream.transform.predictors import default_predictors
from tests.examples import examples

from ..surfaces import terrain, torus


def patches_beside_an_interface(rows: int, columns: int) -> Layout:
    """Two patches whose inner columns are those of one interface, backwards for one of them."""
    interface = Grid((rows, 1), clamped=(True, True, False, False), interface=True)
    left = Grid((rows, columns), sources=(None, None, None, Source(0, False)), clamped=(True,) * 4)
    right = Grid((rows, columns), sources=(None, None, Source(0, True), None), clamped=(True,) * 4)
    return Layout([interface, left, right], (3, 3))


layouts = st.one_of(
    st.builds(
        lambda shape, closed: Layout.single(shape, closed, (3, 3)),
        st.tuples(st.integers(1, 70), st.integers(1, 90)),
        st.tuples(st.booleans(), st.booleans()),
    ),
    st.builds(patches_beside_an_interface, st.integers(2, 40), st.integers(2, 50)),
)


@examples(30)
@given(layout=layouts, seed=st.integers(0, 2**32 - 1))
def test_every_state_is_what_it_is_by_itself(layout: Layout, seed: int) -> None:
    rng = np.random.default_rng(seed)
    channels = [Tiles(TileTable.of(layout, coordinate)) for coordinate in (True, True, False)]
    for tiles in channels:
        tiles.known[:] = rng.integers(0, 2**12, tiles.known.size)
        tiles.sign[:] = np.where(tiles.known, rng.choice([-1, 1], tiles.sign.size), 0)
        tiles.early[:] = rng.integers(0, 13, tiles.early.size)
    predictors = default_predictors(layout)
    predictors[...] = rng.integers(-20, 30, predictors.shape)
    region = Region.whole(layout, layout.levels)
    reconstructors = [Reconstructor(region, predictors, tiles, channel < 2) for channel, tiles in enumerate(channels)]
    interfaces = sum(grid.interface for grid in layout.grids)
    state = np.full((len(layout.tiles), 3), UNANNOUNCED, np.int8)
    for _ in range(6):
        first = layout.tiles_of(int(rng.integers(0, layout.levels + 1))).start
        changed = rng.random(state.shape) < 0.5
        changed[:first] = False
        state = np.where(changed, rng.choice([0, 0, 0, 1, 4, 7, UNANNOUNCED], state.shape), state).astype(np.int8)
        for channel, tiles in enumerate(channels):
            known = known_state(tiles.table, state[:, channel], layout.levels)
            grids, fraction = reconstructors[channel].reconstruct(known)
            expected = Reconstructor(region, predictors, tiles, channel < 2).reconstruct(known)
            assert fraction == expected[1]
            first_grid = interfaces if channel == 2 else 0  # interfaces mean nothing to what is no coordinate
            frames = reconstructors[channel].frames
            for grid, frame, alone in zip(
                grids[first_grid:], frames[first_grid:], expected[0][first_grid:], strict=True
            ):
                np.testing.assert_array_equal(grid, alone)
                np.testing.assert_array_equal(frame[:, : alone.shape[1]], alone)
                assert frame.flags.c_contiguous


def _surfaces() -> dict[str, tuple[ls.Surface, dict[str, Any]]]:
    heights = np.rint(20 * terrain((150, 170))).astype(np.int16)
    points = torus(90, 70)
    halves = [ls.Block(np.ascontiguousarray(points[:, :40])), ls.Block(np.ascontiguousarray(points[:, 39:]))]
    colours: NDArray[np.uint8] = np.random.default_rng(1).integers(0, 9, (150, 170, 3)).astype(np.uint8)
    mask = np.hypot(*np.mgrid[-75:75, -85:85]) < 70
    colours[~mask] = 0
    return {
        "heights": (ls.Surface(heights), {}),
        "float32": (ls.Surface(terrain((300, 260)).astype(np.float32)), {}),
        "blocks": (ls.Surface(blocks=halves), {"precision": "0.001%"}),
        "attributes": (ls.Surface(heights, mask=mask, attributes={"colour": colours}), {}),
        "one error": (ls.Surface(terrain((120, 140))), {"rms": "0.1%"}),
    }


@pytest.mark.parametrize("name", _surfaces())
def test_any_number_of_threads_makes_the_same_bytes(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    surface, options = _surfaces()[name]
    containers = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv(VARIABLE, threads)
        containers.append(ls.encode(surface, **options))
    assert containers[1:] == containers[:1] * 2
