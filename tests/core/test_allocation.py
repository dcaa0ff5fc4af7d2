from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.allocation import MOST_LAYERS, TileCurve, _layer_ends, assign_layers, hull_slopes
from lodestream.layout import Layout


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


layouts = st.builds(
    Layout.single,
    st.tuples(st.integers(1, 80), st.integers(1, 80)),
    st.tuples(st.booleans(), st.booleans()),
    st.tuples(st.integers(2, 5), st.integers(2, 5)),
)


@given(layouts, st.integers(1, 3), st.integers(0, 2**32))
def test_layers_add_every_plane_once_and_parents_never_after_children(layout: Layout, channels: int, seed: int) -> None:
    curves = curves_for(layout, channels, seed)
    states = assign_layers(curves, layout, channels)
    assert 1 <= len(states) <= MOST_LAYERS
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


@given(st.integers(1, 28), st.integers(0, 2**32))
def test_slopes_never_rise_towards_lower_planes_and_keep_the_sum(planes: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    curve = TileCurve(0, 0, rng.random(planes) + 0.01, rng.normal(size=planes))
    slopes = hull_slopes(curve)
    assert slopes.shape == (planes,)
    assert (np.diff(slopes[::-1]) <= 1e-12).all()
    assert np.isclose((slopes * curve.bits).sum(), curve.gains.clip(0).sum())


def test_layers_are_spaced_in_the_logarithm_of_their_bytes() -> None:
    layout = Layout.single((500, 500), (False, False), (5, 5))
    rng = np.random.default_rng(0)
    curves = [
        TileCurve(tile, 0, np.full(16, 800.0), rng.uniform(1, 4) * 4.0 ** np.arange(16.0))
        for tile in range(len(layout.tiles))
    ]
    states = assign_layers(curves, layout, 1)
    sizes = np.array([100.0 * (16 - state).sum() for state in states])
    assert len(states) > MOST_LAYERS / 2
    # The last one but one stands near the end, however the others are spaced; these have their shares of the bytes or
    # a place in the neighbourhood.
    assert 0.9 <= sizes[-2] / sizes[-1] <= 0.95
    inner = np.log(sizes[:-1][sizes[:-1] > 10_000])
    even = np.linspace(inner[0], inner[-1], len(inner))
    assert np.abs(inner - even).max() < np.diff(even).mean()


def test_a_layer_ends_where_the_error_has_just_fallen() -> None:
    # The error falls as a power of the bytes, faster in the first fifth of each step of 1.4 in the bytes.
    sizes: NDArray[np.float64] = 20.0 * np.arange(1.0, 20_001.0)
    step = np.log(sizes) / np.log(1.4) % 1
    left: NDArray[np.float64] = sizes**-1.5 * np.exp(-0.5 * np.where(step < 0.2, step / 0.2, (1 - step) / 0.8))
    ends = np.array(_layer_ends(sizes, left[0] - left, False), np.int64)
    inner = ends[(ends > 100) & (ends < 15_000)]
    assert len(inner) > 10
    assert np.abs(step[inner - 1] - 0.2).max() < 0.03


def test_nothing_to_send_is_one_layer() -> None:
    layout = Layout.single((5, 5), (False, False), (7, 7))
    states = assign_layers([], layout, 3)
    assert len(states) == 1
    assert states[0].shape == (len(layout.tiles), 3)
    assert not states[0].any()
