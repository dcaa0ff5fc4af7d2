from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.grid.layout import Layout
from lodestream.transform import fitting
from lodestream.transform.lifting import CLAMP, TAPS
from lodestream.transform.predictors import COEFFICIENT_BITS, default_predictors, fitted_steps
from lodestream.transform.pyramid import allocate, forward, inverse, synthesis_norms

from ..entropy.coding import effective, shapes_of
from . import reference_steps as reference
from .refinement import dense_coarsen

CLOSURES = [(False, False), (False, True), (True, False), (True, True)]
SHAPES = [(1, 2), (2, 1), (1, 40), (3, 3), (4, 9), (6, 5), (17, 17), (24, 31), (57, 1), (60, 52)]


def grid(shape: tuple[int, int], largest: int, seed: int = 0) -> NDArray[np.int64]:
    return np.random.default_rng(seed).integers(-largest, largest, shape, endpoint=True)


def smooth(shape: tuple[int, int], largest: int) -> NDArray[np.int64]:
    rows, columns = (np.linspace(0, 1, n) for n in shape)
    waves = largest * np.sin(3 * rows[:, None] + 1) * np.cos(4 * columns)
    return np.asarray(np.rint(waves), np.int64)


def load(values: NDArray[Any]) -> NDArray[np.int32]:
    array = allocate((values.shape[0], values.shape[1]))
    array[:] = values
    return array


@pytest.mark.parametrize("closed", CLOSURES)
def test_all_levels_are_those_of_the_reference(closed: tuple[bool, bool]) -> None:
    for shape, fit in itertools.product(SHAPES, (True, False)):
        for original in (grid(shape, 2**24), smooth(shape, 2**20)):
            layout, values = Layout.single(shape, closed, (7, 7)), load(original)
            predictors = forward([values], layout, fit)
            assert predictors.shape == (layout.levels, 3, 2)
            np.testing.assert_array_equal(
                values, reference.forward_grid(original, closed, effective(layout, predictors))
            )
            for level, (rows, columns) in enumerate(shapes_of(layout)):
                corner = load(values)
                inverse([corner], layout, predictors, level)
                expected = reference.inverse_grid(
                    values[:rows, :columns].astype(np.int64), closed, effective(layout, predictors)
                )
                np.testing.assert_array_equal(corner[:rows, :columns], expected)
            np.testing.assert_array_equal(corner, original)


@pytest.mark.parametrize("closed", CLOSURES)
def test_levels_are_within_four_steps_of_the_dense_optimum(closed: tuple[bool, bool]) -> None:
    """Whatever the surface up to 2**20 steps; beyond, noise also meets the rounding of the taps, which is relative."""
    for shape in SHAPES:
        signs = 2 * grid(shape, 1).clip(0, 1) - 1
        for original, bound in ((grid(shape, 2**20), 4.0), (signs * 2**20, 4.0), (signs * 2**24, 16.0)):
            layout, values, best = Layout.single(shape, closed, (7, 7)), load(original), original.astype(np.float64)
            predictors = forward([values], layout)
            for level in range(layout.levels - 1, -1, -1):
                best = dense_coarsen(best, closed)
                corner = load(values)
                inverse([corner], layout, predictors, level)
                assert shapes_of(layout)[level] == best.shape
                assert np.abs(corner[: best.shape[0], : best.shape[1]] - best).max() <= bound


def test_adversarial_surfaces_stay_within_28_bits() -> None:
    for shape, closed in itertools.product([(33, 33), (64, 50), (129, 20)], CLOSURES):
        layout = Layout.single(shape, closed, (7, 7))
        i, j = np.indices(shape)
        for signs in ((i + j) % 2, i // 2 % 2 ^ j % 2, i % 2, (i // 2 + j // 2) % 2, i < shape[0] // 2):
            original = np.where(signs, 2**24, -(2**24))
            values = load(original)
            predictors = forward([values], layout, fit=False)
            assert np.abs(values).max() < 2**COEFFICIENT_BITS
            inverse([values], layout, predictors, layout.levels)
            np.testing.assert_array_equal(values, original)


@pytest.mark.parametrize("closed", CLOSURES)
def test_hostile_coefficients_are_those_of_exact_integers(closed: tuple[bool, bool]) -> None:
    extreme = 2**COEFFICIENT_BITS - 1
    for shape in [(5, 3), (9, 6), (13, 22), (26, 25)]:
        layout = Layout.single(shape, closed, (7, 7))
        for seed, predictor in enumerate([(127, -127), (127, 127), (-127, 127), (16, 0)]):
            hostile = np.where(grid(shape, 1, seed) > 0, extreme, -extreme)
            predictors = np.full((layout.levels, 2, 2), predictor, np.int8)
            values = load(hostile)
            inverse([values], layout, predictors, layout.levels)
            expected = reference.inverse_grid(hostile.astype(object), closed, effective(layout, predictors))
            np.testing.assert_array_equal(values.astype(object), expected)
            assert np.abs(values).max() <= CLAMP


def test_the_fit_makes_details_smaller_than_the_fixed_rules() -> None:
    original = smooth((65, 80), 2**20)
    layout = Layout.single((65, 80), (False, False), (7, 7))
    sizes = []
    for fit in (True, False):
        values = load(original)
        predictors = forward([values], layout, fit)
        sizes.append(np.log2(1 + np.abs(values.astype(np.float64))).sum())
    assert not predictors[layout.levels - 1].any()
    assert sizes[0] < 0.7 * sizes[1]


Ints = NDArray[np.int32]


def factors_of(nodes: Ints, details: Ints) -> tuple[list[Ints], int]:
    kept = [np.empty(details.size, np.int32) for _ in range(3)]
    return kept, kernels.predictor_factors(nodes, details, *kept)


@given(rows=st.integers(1, 9), columns=st.integers(1, 9), bits=st.integers(1, 27), seed=st.integers(0, 2**32))
def test_factors_are_what_the_third_step_multiplies(rows: int, columns: int, bits: int, seed: int) -> None:
    nodes = grid((rows + 5, columns), 2**bits - 1, seed).astype(np.int32)
    details = grid((rows, columns + 3), 2**bits - 1, seed).astype(np.int32)[:, 1:-2]
    (first, second, kept), largest = factors_of(nodes, details)
    inner, outer = (nodes[2:-3] + nodes[3:-2] - nodes[1:-4] - nodes[4:-1]), (nodes[2:-3] + nodes[3:-2])
    outer = outer - nodes[:-5] - nodes[5:]
    np.testing.assert_array_equal(first, inner.ravel())
    np.testing.assert_array_equal(second, outer.ravel())
    np.testing.assert_array_equal(kept, details.ravel())
    assert max(np.abs(inner).max(), np.abs(outer).max()) <= largest <= 2**31


@given(
    count=st.integers(0, 1200),
    bits=st.integers(0, 27),
    a=st.integers(-127, 127),
    b=st.integers(-127, 127),
    seed=st.integers(0, 2**32),
)
def test_bits_and_moments_are_those_of_numpy(count: int, bits: int, a: int, b: int, seed: int) -> None:
    first, second, details = grid((3, count), 2**bits, seed).astype(np.int32)
    u, w, d = (x.astype(np.float64) for x in (first, second, details))
    total = np.array([5.0])
    kernels.predictor_bits(first, second, details, 2**bits, a, b, total)
    e = d - np.floor((a * u + b * w + 128) / 256)
    assert total[0] == pytest.approx(5.0 + np.log2(1 + np.abs(e)).sum(), abs=1e-9 + 3e-6 * (32 + count / 16))
    for weighted in (0, 1):
        moments, weight = np.full(5, 0.25), 1 / (1 + weighted * np.abs(d - (a * u + b * w) / 256))
        kernels.predictor_moments(first, second, details, a, b, weighted, moments)
        patches = [weight * x for x in (u * u, u * w, w * w, u * d, w * d)]
        for moment, patch in zip(moments, patches, strict=True):
            assert moment == pytest.approx(0.25 + patch.sum(), abs=1e-12 * (1 + np.abs(patch).sum()))


def test_a_sample_in_patches_is_the_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    values = [smooth((80, 60), 2**20), grid((300, 200), 2**10), smooth((60, 500), 2**24) + grid((60, 500), 9)]
    fits = []
    for at_once in (1 << 22, 1000):
        monkeypatch.setattr(fitting, "_VALUES_PER_CALL", at_once)
        for one in values:
            layout = Layout.single((one.shape[0], one.shape[1]), (False, True), (7, 7))
            fits.append(forward([load(one)], layout))
    for whole, patches in zip(fits[:3], fits[3:], strict=True):
        np.testing.assert_array_equal(whole, patches)


def test_samples_that_do_not_fit_are_refused() -> None:
    nodes, details, flat = np.zeros((9, 3), np.int32), np.zeros((4, 3), np.int32), np.zeros(12, np.int32)
    assert kernels.predictor_factors(nodes, details, flat, flat.copy(), flat.copy()) == 1
    short = flat[1:]
    for refused in (
        (nodes[1:], details, flat, flat, flat),
        (nodes[:, 1:], details, flat, flat, flat),
        (nodes[:5], details[:0], flat, flat, flat),
        (nodes, details, short, flat, flat),
        (nodes, details, flat, short, flat),
        (nodes, details, flat, flat, short),
    ):
        with pytest.raises(ValueError, match="do not fit"):
            kernels.predictor_factors(*refused)
    for arrays in ((short, flat, flat), (flat, short, flat), (flat, flat, short)):
        with pytest.raises(ValueError, match="do not fit"):
            kernels.predictor_moments(*arrays, 0.0, 0.0, 1, np.zeros(5))
        with pytest.raises(ValueError, match="do not fit"):
            kernels.predictor_bits(*arrays, 1, 0, 0, np.zeros(1))
    with pytest.raises(ValueError, match="do not fit"):
        kernels.predictor_moments(flat, flat, flat, 0.0, 0.0, 1, np.zeros(4))
    for largest, a, b, count in ((-1, 0, 0, 1), (2**31 + 1, 0, 0, 1), (1, 128, 0, 1), (1, 0, -128, 1), (1, 0, 0, 2)):
        with pytest.raises(ValueError, match="do not fit"):
            kernels.predictor_bits(flat, flat, flat, largest, a, b, np.zeros(count))


@given(seed=st.integers(0, 2**32))
def test_any_int32_has_bits(seed: int) -> None:
    nodes, details = (grid((rows, 40), 2**31 - 1, seed).astype(np.int32) for rows in (45, 40))
    kept, largest = factors_of(nodes, details)
    total = np.zeros(1)
    for a, b in ((127, 127), (-127, 127), (0, 0)):
        kernels.predictor_bits(*kept, largest, a, b, total)
    assert 0 < total[0] < 3 * 33 * details.size


def test_only_long_axes_have_predictors_of_their_own() -> None:
    layout = Layout.single((200, 9), (False, True), (7, 7))
    own, others = set(fitted_steps(layout)), effective(layout, default_predictors(layout))
    assert own == {(level, 0) for level in range(layout.levels) if shapes_of(layout)[level][0] >= 24}
    for level, axis in itertools.product(range(layout.levels), (0, 1)):
        assert tuple(others[level, axis]) == ((0, 0) if (level, axis) in own else (16, 0))


def test_synthesis_norms_are_what_a_coefficient_adds() -> None:
    layout = Layout.single((129, 129), (True, True), (7, 7))
    predictors = default_predictors(layout)
    predictors[:] = 16, 0
    norms = synthesis_norms(layout, predictors)
    unit = 2**16
    for level in range(layout.levels - 2, layout.levels + 1):
        shape, coarse = shapes_of(layout)[level], shapes_of(layout)[level - 1]
        for kind in itertools.product((0, 1), repeat=2):
            if kind == (0, 0):
                continue
            place = tuple(
                n + (m - n) // 2 if detail else n // 2 for n, m, detail in zip(coarse, shape, kind, strict=True)
            )
            values = allocate((129, 129))
            values[place] = unit
            inverse([values], layout, predictors, layout.levels)
            measured = float((values.astype(np.float64) ** 2).sum()) / unit**2
            assert norms[level, kind[0], kind[1]] == pytest.approx(measured, rel=0.02)


def step_without_rounding(nodes: list[float], surplus: list[float], a: int, b: int) -> list[float]:
    """One inverse step of a closed line, from the formulas."""
    n, taps = len(nodes), [float(tap) / 2**24 for tap in TAPS]
    details = []
    for k in range(n):
        near = nodes[k] + nodes[(k + 1) % n]
        inner, outer = near - nodes[(k + 2) % n] - nodes[k - 1], near - nodes[(k + 3) % n] - nodes[k - 2]
        details.append(surplus[k] + (a * inner + b * outer) / 256)
    even = [
        nodes[k] - sum(h * (details[(k + j) % n] + details[k - 1 - j]) for j, h in enumerate(taps)) for k in range(n)
    ]
    return [x for k in range(n) for x in (even[k], details[k] + (even[k] + even[(k + 1) % n]) / 2)]


def test_synthesis_norms_are_those_of_the_formulas() -> None:
    layout = Layout.single((1, 1600), (True, True), (7, 7))
    predictors = default_predictors(layout)
    predictors[:, 1] = np.random.default_rng(1).integers(-30, 31, (layout.levels, 2))
    norms = synthesis_norms(layout, predictors)
    for level, kind in itertools.product(range(1, layout.levels + 1), (0, 1)):
        line, details, grown = [0.0] * 16, [0.0] * 16, 1.0
        (details if kind else line)[8] = 1.0
        for finer in range(level, layout.levels + 1):
            if len(line) == 16 * 2**6:
                grown *= 2
                continue
            line = step_without_rounding(line, details, *(int(x) for x in effective(layout, predictors)[finer - 1, 1]))
            details = [0.0] * len(line)
        assert norms[level, 0, kind] == pytest.approx(grown * sum(x * x for x in line), rel=1e-12)


def test_rows_do_not_lie_a_power_of_two_apart() -> None:
    values = allocate((4, 1024))
    assert values.shape == (4, 1024)
    assert not values.any()
    stride = values.strides[0]
    assert stride & (stride - 1)
