from __future__ import annotations

import itertools

import numpy as np
import pytest

import lodestream as ls
from lodestream import InputError

from .refinement import dense_coarsen, refine, surface_refinement_matrix

CLOSURES = [(False, False), (False, True), (True, False), (True, True)]
#: The filter leaves out less than 1e-18; the rest is rounding, of the filter and of the dense solve.
TOLERANCE = 1e-9


@pytest.mark.parametrize("closed", CLOSURES)
def test_coarsen_is_the_dense_least_squares_solution_for_every_pair_of_sizes(closed: tuple[bool, bool]) -> None:
    for shape in itertools.product(range(1, 25), repeat=2):
        points = np.random.default_rng(shape).normal(size=(*shape, 2))
        best = dense_coarsen(points, closed)
        ours = ls.coarsen(points, closed)
        assert ours.shape == best.shape
        assert np.abs(ours - best).max() <= TOLERANCE, f"{shape[0]} x {shape[1]}"


@pytest.mark.parametrize("closed", CLOSURES)
def test_coarsen_solves_the_normal_equations_of_the_whole_grid(closed: tuple[bool, bool]) -> None:
    """By a solve that does not know that the axes separate."""
    for shape in [(3, 3), (4, 7), (8, 5), (9, 6), (1, 12), (11, 2)]:
        points = np.random.default_rng(shape).normal(size=shape)
        matrix = surface_refinement_matrix(*shape, closed)
        best = np.linalg.lstsq(matrix, points.ravel(), rcond=None)[0]
        np.testing.assert_allclose(ls.coarsen(points, closed).ravel(), best, atol=TOLERANCE)


@pytest.mark.parametrize("closed", CLOSURES)
@pytest.mark.parametrize("shape", [(2, 2), (1, 30), (24, 17), (23, 18, 3), (12, 5, 1)])
def test_hierarchy_is_one_best_level_after_another(shape: tuple[int, ...], closed: tuple[bool, bool]) -> None:
    points = np.random.default_rng(1).normal(size=shape)
    levels = ls.hierarchy(points, closed)
    np.testing.assert_array_equal(levels[-1], points)
    for coarse, fine in itertools.pairwise(levels):
        np.testing.assert_allclose(coarse, dense_coarsen(fine, closed), atol=TOLERANCE)
    assert ls.coarsen(levels[0], closed).shape == levels[0].shape


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1.0, 1e30, 1e290])
def test_the_error_is_relative_to_the_scale(scale: float) -> None:
    points = np.random.default_rng(2).normal(size=(40, 33))
    ours = ls.coarsen(points * scale) / scale
    assert np.abs(ours - dense_coarsen(points)).max() <= 1e-12 * np.abs(points).max()


def test_a_refined_level_is_its_own_optimum() -> None:
    for closed in CLOSURES:
        for shape in [(17, 33), (16, 20), (15, 6)]:
            coarse = np.random.default_rng(3).normal(size=ls.coarsen(np.zeros(shape), closed).shape)
            np.testing.assert_allclose(ls.coarsen(refine(coarse, shape, closed), closed), coarse, atol=1e-12)


def test_long_lines_and_many_columns_go_through_the_same_filter() -> None:
    points = np.random.default_rng(4).normal(size=(401, 130))
    np.testing.assert_allclose(ls.coarsen(points), dense_coarsen(points), atol=TOLERANCE)
    np.testing.assert_allclose(ls.coarsen(points), ls.coarsen(points.T).T, atol=1e-12)


@pytest.mark.parametrize("dtype", ["int8", "uint16", "int64", "float32", "float64"])
def test_any_real_numbers_are_taken_and_left_as_they_are(dtype: str) -> None:
    points = np.arange(35).reshape(5, 7).astype(dtype)
    before = points.copy()
    ours = ls.coarsen(points)
    assert ours.dtype == np.float64
    np.testing.assert_array_equal(points, before)
    np.testing.assert_allclose(ours, points[::2, ::2], atol=1e-12)
    assert not np.shares_memory(ls.coarsen(np.ones((2, 2))), points)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros(5),
        np.zeros((2, 2, 2, 2)),
        np.zeros((0, 4)),
        np.array([["a", "b"]]),
        np.zeros((3, 3), complex),
        np.full((3, 3), np.nan),
        np.array([[1.0, np.inf]]),
    ],
)
def test_what_is_no_grid_of_finite_numbers_is_refused(
    points: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
) -> None:
    with pytest.raises(InputError, match="expected"):
        ls.coarsen(points)
    with pytest.raises(InputError, match="expected"):
        ls.hierarchy(points)
