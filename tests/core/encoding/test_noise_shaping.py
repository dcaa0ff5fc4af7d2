"""How errors of a band add up in the surface: the filters against inner products of synthesis functions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.encoding.noise_shaping import FILTERS, feedback_rules
from lodestream.entropy.tiles import TileTable
from lodestream.grid.layout import Layout
from lodestream.quantization.band_steps import Quantiser
from lodestream.transform.predictors import default_predictors
from lodestream.transform.pyramid import allocate, inverse, inverse_level
from tests.examples import examples


def gram(detail: bool, count: int) -> NDArray[np.float64]:
    """Inner products of a synthesis function and those of its neighbours, along a long closed axis."""
    layout = Layout.single((1, 2048), (False, True), (7, 7))
    unit, first = 2**16, layout.levels - count
    line = allocate((1, 2048))
    line[0, 7 + (layout.shape(0, first)[1] if detail else 0)] = unit
    for level in range(first + 1, layout.levels + 1):
        inverse_level(line, layout, default_predictors(layout), 0, level)
    return np.array([float(line[0].astype(float) @ np.roll(line[0], k << count)) / unit**2 for k in range(4)])


@pytest.mark.parametrize("detail", [False, True])
@pytest.mark.parametrize("count", range(1, FILTERS.shape[1]))
def test_filters_are_factors_of_the_inner_products(detail: bool, count: int) -> None:
    first, second, gain = FILTERS[int(detail), count].tolist()
    taps = [1.0, first, second, 0.0]
    for distance, expected in enumerate(gram(detail, count)):
        product = sum(a * b for a, b in zip(taps, taps[distance:], strict=False))
        assert gain * product == pytest.approx(expected, abs=0.03 * gain)
    roots = np.roots([1.0, first, second])
    assert (np.abs(roots) < 1).all()  # the filter can be undone
    # No other choice of the two taps tells more of the error.
    assert gain == pytest.approx(math.exp(np.log(spectrum(detail, count)).mean()), rel=1e-3)


def spectrum(detail: bool, count: int) -> NDArray[np.float64]:
    products = gram(detail, count)
    angles = np.arange(256) * np.pi / 256 + np.pi / 512
    found: NDArray[np.float64] = products[0] + 2 * sum(products[k] * np.cos(k * angles) for k in range(1, 4))
    return found


@pytest.mark.parametrize("kind", [(False, True), (True, False), (True, True)])
@pytest.mark.parametrize("count", [1, 2])
def test_errors_of_a_band_add_up_as_the_rules_say(kind: tuple[bool, bool], count: int) -> None:
    layout = Layout.single((512, 768), (True, True), (7, 7))
    table, quantiser = TileTable.of(layout), Quantiser(1 << 12)
    level = layout.levels - count + 1
    rules, steps = feedback_rules(table, quantiser), table.steps(quantiser)
    number = table.first[layout.tiles_of(level)[0]] + [(False, True), (True, False), (True, True)].index(kind)
    half, weight, *taps = rules[number].tolist()
    rng = np.random.default_rng(count)
    # Errors that go with each other, as those that are fed back do.
    errors = rng.normal(size=(20, 30))
    errors += 0.5 * np.roll(errors, 1, 0) - 0.4 * np.roll(errors, 1, 1)
    work = allocate((512, 768))
    top, left = (int(n) for n in table.origins[number, 1:])
    step = int(steps[number])
    work[top + 20 : top + 40, left + 20 : left + 50] = np.rint(errors * step)
    inverse([work], layout, default_predictors(layout), layout.levels)
    padded = np.pad(errors, 4)
    filtered = fed(fed(padded, taps[:2], 0), taps[2:], 1)
    assert half == pytest.approx((step + 1) // 2 / step)
    expected = float((work.astype(np.float64) ** 2).sum()) / quantiser.base**2
    assert weight * float((filtered**2).sum()) == pytest.approx(expected, rel=0.02)


def fed(errors: NDArray[np.float64], taps: Sequence[float], axis: int) -> NDArray[np.float64]:
    return np.asarray(errors + taps[0] * np.roll(errors, 1, axis) + taps[1] * np.roll(errors, 2, axis))


@examples(8)
@given(
    shape=st.tuples(st.integers(20, 60), st.integers(20, 60)),
    roughness=st.floats(0, 1),
    wanted=st.sampled_from([3e-2, 1e-2, 1e-3]),
    seed=st.integers(0, 2**32),
)
def test_shaping_never_costs_much(shape: tuple[int, int], roughness: float, wanted: float, seed: int) -> None:
    """Against the same stream in an open loop, where every band's errors count by themselves."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[: shape[0], : shape[1]]
    heights = np.sin(x / 9 + seed % 7) * np.cos(y / 7) + roughness * 0.2 * rng.normal(size=shape)
    made = ls.encode(heights, rms=ls.Tolerance(wanted, relative=True))
    with pytest.MonkeyPatch.context() as patch:
        flat = FILTERS.copy()
        flat[:, :, :2] = 0
        patch.setattr("lodestream.encoding.noise_shaping.FILTERS", flat)
        alone = ls.encode(heights, rms=ls.Tolerance(wanted, relative=True))
    assert len(made) <= 1.1 * len(alone) + 40
