from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream.layout import Layout
from lodestream.lifting import CLAMP
from lodestream.predictors import COEFFICIENT_BITS, default_predictors, fitted_steps
from lodestream.transform import (
    allocate,
    forward,
    inverse,
    synthesis_norms,
)

from . import lifting_reference as reference
from .coding import effective, shapes_of
from .reference import dense_coarsen

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


def test_rows_do_not_lie_a_power_of_two_apart() -> None:
    values = allocate((4, 1024))
    assert values.shape == (4, 1024)
    assert not values.any()
    stride = values.strides[0]
    assert stride & (stride - 1)
