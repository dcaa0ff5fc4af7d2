from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.container.limits import LAYERS
from lodestream.encoding.allocation import PassOrder, layer_ends, pass_order
from lodestream.encoding.curves import Curves, Worth
from lodestream.encoding.effort import FOR_ONE_ERROR, FewLayers
from lodestream.grid.layout import Layout

from .tile_curves import TileCurve, joined


def curves_for(layout: Layout, channels: int, seed: int) -> list[TileCurve]:
    rng = np.random.default_rng(seed)
    curves = []
    for tile in range(len(layout.tiles)):
        for channel in range(channels):
            planes = int(rng.integers(0, 12))
            if planes:
                bits = rng.random(planes) * 10 ** rng.uniform(0, 4, planes)
                gains = rng.normal(size=planes) * 10 ** rng.uniform(-200, 200) * 4.0 ** np.arange(planes)
                curves.append(TileCurve(tile, channel, bits, gains))
    return curves


def states_of(curves: Curves, layout: Layout, channels: int, few: FewLayers | None = None) -> list[NDArray[np.int8]]:
    """The state after each layer."""
    order = pass_order(curves, layout, channels)
    return list(order.states(layer_ends(order, LAYERS, few)))


def ends_of(
    sizes: NDArray[np.float64], gains: NDArray[np.float64], last: NDArray[np.bool_], few: FewLayers | None = None
) -> NDArray[np.int64]:
    """The ends of layers of passes of one unit whose bytes and gains add up to these."""
    nothing = np.zeros(sizes.size, np.int64)
    order = PassOrder(np.zeros((1, 1), np.int8), nothing, nothing.astype(np.int8), sizes, gains, last)
    return np.array(layer_ends(order, LAYERS, few), np.int64)


def saving(bits: float) -> Worth:
    """So many bits whatever the slope."""
    return Worth(np.zeros(1), np.full(1, np.inf), 1.0, bits)


layouts = st.builds(
    Layout.single,
    st.tuples(st.integers(1, 80), st.integers(1, 80)),
    st.tuples(st.booleans(), st.booleans()),
    st.tuples(st.integers(2, 5), st.integers(2, 5)),
)


@given(layouts, st.integers(1, 3), st.integers(0, 2**32))
def test_layers_add_every_plane_once_and_parents_never_after_children(layout: Layout, channels: int, seed: int) -> None:
    curves = curves_for(layout, channels, seed)
    states = states_of(joined(curves), layout, channels)
    assert states
    top = np.zeros(states[0].shape, np.int8)
    for curve in curves:
        top[curve.tile, curve.channel] = len(curve.bits)
    before = top
    for state in states:
        assert (state <= before).all()
        assert (state >= 0).all()
        for number, tile in enumerate(layout.tiles):
            if tile.parent >= 0:
                known, above = state[number], state[tile.parent]
                # Planes at least as high as any that the child has must be known of the parent, as far as it has them.
                expected = np.minimum(known, top[tile.parent])
                assert (above <= np.where(known < top[number], expected, top[tile.parent])).all()
        before = state
    assert not states[-1].any()


@given(st.integers(1, 28), st.floats(0, 100), st.integers(0, 2**32))
def test_slopes_fall_towards_lower_planes_and_keep_the_sum(planes: int, worth: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    curve = TileCurve(0, 0, 100 * rng.random(planes) + 0.01, rng.normal(size=planes))
    slopes = joined([curve]).slopes(saving(worth))
    assert slopes.shape == (planes,)
    assert (np.diff(slopes[::-1]) <= 1e-12).all()
    assert np.isclose((slopes * curve.bits).sum(), curve.gains.clip(0).sum())


def test_passes_are_one_step_where_two_would_save_less_than_a_segment_takes() -> None:
    # Of 100 bits each, the first worth 3 a bit and the second 1: where both come together, two steps save
    # 100 * 100 * (3 - 1) / (3 * 100 + 1 * 100) = 50 bits.
    curve = TileCurve(0, 0, np.array([100.0, 100.0]), np.array([100.0, 300.0]))
    curves = joined([curve])
    assert curves.slopes(saving(49.0)).tolist() == [1.0, 3.0]
    assert curves.slopes(saving(51.0)).tolist() == [2.0, 2.0]


def many_tiles(tiles: int = 500, passes: int = 16) -> tuple[Layout, list[TileCurve]]:
    """Passes of 100 bytes in so many tiles, each worth a quarter of the one before."""
    layout = Layout.single((tiles, tiles), (False, False), (5, 5))
    rng = np.random.default_rng(0)
    steps: NDArray[np.float64] = 4.0 ** np.arange(float(passes))
    return layout, [
        TileCurve(tile, 0, np.full(passes, 800.0), steps * rng.uniform(1, 4)) for tile in range(len(layout.tiles))
    ]


def test_layers_above_4_kb_are_at_most_16_per_cent_of_the_bytes_apart() -> None:
    layout, curves = many_tiles()
    sizes = np.array([100.0 * (16 - state).sum() for state in states_of(joined(curves), layout, 1)])
    growth = sizes[1:] / sizes[:-1]
    assert growth[sizes[:-1] > 4096].max() <= 1.16
    assert growth[sizes[:-1] > 4096].min() >= 1.1
    assert growth[sizes[:-1] < 4096].max() <= 2


def test_a_layer_that_is_longer_adds_a_single_pass() -> None:
    layout = Layout.single((129, 129), (False, False), (5, 5))
    rng = np.random.default_rng(1)
    curves = [
        TileCurve(tile, 0, rng.uniform(2000, 40_000, 10), rng.uniform(1, 4) * 4.0 ** np.arange(10.0))
        for tile in range(len(layout.tiles))
    ]
    states = states_of(joined(curves), layout, 1)
    sizes = np.array([sum(curve.bits[state[curve.tile, 0] :].sum() / 8 for curve in curves) for state in states])
    longer = (sizes[1:] > 1.16 * sizes[:-1]) & (sizes[:-1] > 4096)
    added = np.array([(before - after).sum() for before, after in itertools.pairwise(states)])
    assert longer.any()
    assert (added[longer] == 1).all()


def test_a_tile_has_few_segments() -> None:
    layout, curves = many_tiles()
    states = np.array(states_of(joined(curves), layout, 1))
    segments = (np.diff(states[:, :, 0], axis=0) < 0).sum()
    # In a tile of 16 passes each of which is worth a quarter of the last, two go together towards the end.
    assert segments < 12 * len(layout.tiles)


def test_a_layer_ends_where_the_error_has_just_fallen() -> None:
    # The error falls as a power of the bytes, faster in the first fifth of each step of 1.02 in the bytes.
    sizes: NDArray[np.float64] = 20.0 * np.arange(1.0, 20_001.0)
    step = np.log(sizes) / np.log(1.02) % 1
    left: NDArray[np.float64] = sizes**-1.5 * np.exp(-0.5 * np.where(step < 0.2, step / 0.2, (1 - step) / 0.8))
    last = np.ones(sizes.size, np.bool_)
    ends = ends_of(sizes, left[0] - left, last)
    inner = ends[(sizes[ends - 1] > 20_000) & (ends < 15_000)]
    assert len(inner) > 10
    assert np.abs(step[inner - 1] - 0.2).max() < 0.05


def test_a_layer_ends_with_a_step_where_one_ends_in_its_range() -> None:
    sizes: NDArray[np.float64] = 20.0 * np.arange(1.0, 20_001.0)
    rng = np.random.default_rng(3)
    last = rng.random(sizes.size) < 0.1
    last[-1] = True
    ends = ends_of(sizes, np.sqrt(sizes), last)
    assert last[ends[sizes[ends - 1] > 50_000] - 1].all()


@given(st.integers(1, 300), st.sampled_from([None, FOR_ONE_ERROR, FewLayers(3, 50)]), st.integers(0, 2**32))
def test_layers_end_one_after_another_and_with_the_last_pass(passes: int, few: FewLayers | None, seed: int) -> None:
    rng = np.random.default_rng(seed)
    sizes = np.cumsum(rng.random(passes) * 10 ** rng.uniform(-3, 4, passes))
    ends = ends_of(sizes, np.cumsum(rng.normal(size=passes)), rng.random(passes) < 0.5, few)
    assert ends[-1] == passes
    assert (np.diff([0, *ends]) > 0).all()


def test_streams_for_one_error_have_few_layers() -> None:
    layout, curves = many_tiles()
    total = 1600 * len(curves)
    assert len(states_of(joined(curves), layout, 1, few=FOR_ONE_ERROR)) <= total / 12_000 + 2
    assert len(states_of(joined(curves[:4]), layout, 1, few=FOR_ONE_ERROR)) == 3
    assert len(states_of(joined([TileCurve(0, 0, np.full(4, 100.0), np.ones(4))]), layout, 1, few=FOR_ONE_ERROR)) == 1


def test_nothing_to_send_is_one_layer() -> None:
    layout = Layout.single((5, 5), (False, False), (7, 7))
    states = states_of(joined([]), layout, 3)
    assert len(states) == 1
    assert states[0].shape == (len(layout.tiles), 3)
    assert not states[0].any()
