"""The paper's solver against its own bound and against dense least squares."""

from __future__ import annotations

import math
from itertools import pairwise, product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from lodestream import InputError, OptionError
from lodestream.transform import paper

from .refinement import dense_coarsen, refine, refinement_matrix, surface_refinement_matrix

Floats = NDArray[np.float64]

CLOSED = list(product([False, True], repeat=2))
C = 2 * math.sqrt(2) - 3


def near_toeplitz(size: int) -> Floats:
    """A_p; A_1 is the matrix of a node without neighbours."""
    matrix = 6 * np.eye(size) + np.eye(size, k=1) + np.eye(size, k=-1)
    matrix[0, 0] -= 1
    matrix[-1, -1] -= 1
    return matrix


def near_toeplitz_inverse(size: int) -> Floats:
    """A_p^-1 by LAPACK's banded Cholesky factors, which are quick enough for every p."""
    bands = np.array([np.ones(size), np.full(size, 6.0)])
    bands[1, [0, -1]] = 5
    return np.asarray(solveh_banded(bands, np.eye(size)), np.float64)


def circulant(size: int) -> Floats:
    return 6 * np.eye(size) + np.roll(np.eye(size), 1, axis=0) + np.roll(np.eye(size), -1, axis=0)


def bound(terms: int) -> float:
    return (3 + math.sqrt(2)) / 32 * abs(C) ** terms


@pytest.mark.parametrize("sizes", [range(5, 200), range(200, 501, 20)], ids=str)
def test_solve_meets_the_bound_of_lemma_2_for_every_right_hand_side(sizes: range) -> None:
    # The error is linear in b: its largest row sum, over the unit right-hand sides, is the worst that any b with
    # entries in [-1, 1] can do, and the signs of that row are the b that does it.
    generator = np.random.default_rng(len(sizes))
    rounding = 1e-15
    for size in sizes:
        inverse = near_toeplitz_inverse(size)
        some = generator.uniform(-1, 1, (size, 3))
        for terms in (5, 10, 15):
            if size < terms:
                continue
            error = paper.solve(np.eye(size), terms) - inverse
            sums = np.abs(error).sum(axis=1)
            assert sums.max() <= bound(terms) + rounding, (size, terms)
            worst = np.where(error[sums.argmax()] < 0, -1.0, 1.0)
            sides = np.column_stack([worst, some])
            difference = np.abs(paper.solve(sides, terms) - inverse @ sides).max(axis=0)
            assert (difference <= (bound(terms) + rounding) * np.abs(sides).max(axis=0)).all(), (size, terms)
            assert difference[0] >= sums.max() - rounding, (size, terms)


def test_the_inverse_that_the_bound_is_held_against_is_the_dense_one() -> None:
    for size in (2, 5, 30, 301):
        inverse = np.linalg.inv(near_toeplitz(size))
        np.testing.assert_allclose(near_toeplitz_inverse(size), inverse, rtol=0, atol=1e-16)


def test_the_bound_at_ten_terms_is_the_corrected_figure() -> None:
    assert f"{bound(10):.2e}" == "3.05e-09"


def test_the_bound_is_within_a_factor_of_four_of_the_worst_case() -> None:
    error = paper.solve(np.eye(36), 15) - np.linalg.inv(near_toeplitz(36))
    assert np.abs(error).sum(axis=1).max() > bound(15) / 4


@pytest.mark.parametrize("terms", [1, 2, 5, 20, 40])
@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 19, 20, 21, 39, 100])
def test_solve_is_exact_below_k_unknowns_and_within_the_bound_above(size: int, terms: int) -> None:
    sides = np.random.default_rng(size).uniform(-1, 1, (size, 4))
    exact = np.linalg.solve(near_toeplitz(size), sides)
    allowed = 1e-15 + (0 if size < terms else bound(terms))
    np.testing.assert_allclose(paper.solve(sides, terms), exact, rtol=0, atol=allowed)


@pytest.mark.parametrize("size", [*range(1, 30), 47, 48, 49, 200])
def test_closed_systems_are_solved_exactly(size: int) -> None:
    sides = np.random.default_rng(size).uniform(-1, 1, (size, 3))
    exact = np.linalg.solve(circulant(size), sides)
    np.testing.assert_allclose(paper.solve_closed(sides), exact, rtol=0, atol=1e-15)


@pytest.mark.parametrize("solve", [paper.solve, paper.solve_closed])
@pytest.mark.parametrize("shape", [(50,), (50, 1), (50, 7), (50, 3, 5), (2049, 70), (40, 5000), (20_000, 40)], ids=str)
def test_many_right_hand_sides_are_solved_as_one_by_one(solve: Any, shape: tuple[int, ...]) -> None:
    sides = np.random.default_rng(0).uniform(-1, 1, shape)
    before = sides.copy()
    together = solve(sides)
    assert together.shape == shape
    assert together.dtype == np.float64
    np.testing.assert_array_equal(sides, before)
    for column in np.ndindex(shape[1:]) if sides.size < 1000 else [(0,) * (len(shape) - 1), (-1,) * (len(shape) - 1)]:
        one = (slice(None), *column)
        np.testing.assert_allclose(together[one], solve(sides[one]), rtol=0, atol=1e-16)


def test_solve_takes_integers_and_strided_arrays() -> None:
    sides = np.arange(600, dtype=np.int16).reshape(20, 30)
    np.testing.assert_array_equal(paper.solve(sides.T[::2]), paper.solve(sides.T[::2].astype(float).copy()))


@pytest.mark.parametrize("closed", [False, True])
def test_right_hand_sides_of_curves_are_those_of_the_normal_equations(closed: bool) -> None:
    for length in range(1, 30):
        matrix = refinement_matrix(length, closed)
        points = np.random.default_rng(length).uniform(-1, 1, (length, 2))
        normal, sides = matrix.T @ matrix, matrix.T @ points
        # Nodes outside any system keep their value: their equation is not multiplied by 4.
        outside = normal[np.diag_indices_from(normal)] == 1
        expected = np.where(outside[:, np.newaxis], 1, 4) * sides
        np.testing.assert_allclose(paper.curve_right_hand_sides(points, closed), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("closed", CLOSED, ids=str)
def test_right_hand_sides_of_surfaces_are_those_of_the_normal_equations(closed: tuple[bool, bool]) -> None:
    for shape in [(5, 7), (6, 8), (9, 6), (6, 9), (3, 1), (1, 12), (4, 4), (2, 5)]:
        points = np.random.default_rng(shape[0]).uniform(-1, 1, (*shape, 2))
        along_rows = paper.curve_right_hand_sides(points, closed[0])
        both = paper.curve_right_hand_sides(along_rows.swapaxes(0, 1), closed[1]).swapaxes(0, 1)
        found = paper.surface_right_hand_sides(points, closed)
        np.testing.assert_allclose(found, both, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(found[..., 1], paper.surface_right_hand_sides(points[..., 1], closed))


def test_the_two_dimensional_system_separates() -> None:
    points = np.random.default_rng(1).uniform(-1, 1, (9, 13))
    level, sides = paper.coarsen(points), paper.surface_right_hand_sides(points)
    np.testing.assert_allclose(near_toeplitz(5) @ level @ near_toeplitz(7), sides, rtol=0, atol=1e-13)


@pytest.mark.parametrize("closed", CLOSED, ids=str)
def test_coarsen_is_the_dense_optimum_for_every_pair_of_sizes(closed: tuple[bool, bool]) -> None:
    generator = np.random.default_rng(2)
    for shape in product(range(1, 25), repeat=2):
        points = generator.uniform(-1, 1, shape)
        np.testing.assert_allclose(
            paper.coarsen(points, closed), dense_coarsen(points, closed), rtol=0, atol=1e-12, err_msg=str(shape)
        )


@pytest.mark.parametrize("closed", CLOSED, ids=str)
@pytest.mark.parametrize("shape", [(2, 3), (5, 5), (6, 8), (9, 4), (7, 1), (5, 12), (11, 10)], ids=str)
def test_coarsen_is_the_optimum_of_the_whole_grid(shape: tuple[int, int], closed: tuple[bool, bool]) -> None:
    points = np.random.default_rng(3).uniform(-1, 1, shape)
    matrix = surface_refinement_matrix(*shape, closed)
    optimum, *_ = np.linalg.lstsq(matrix, points.ravel())
    np.testing.assert_allclose(paper.coarsen(points, closed).ravel(), optimum, rtol=0, atol=1e-12)
    np.testing.assert_allclose(dense_coarsen(points, closed).ravel(), optimum, rtol=0, atol=1e-12)


@pytest.mark.parametrize("closed", CLOSED, ids=str)
@pytest.mark.parametrize("shape", [(301, 40), (40, 301), (130, 90), (33, 1), (1, 64)], ids=str)
def test_coarsen_of_longer_axes_and_many_panels(shape: tuple[int, int], closed: tuple[bool, bool]) -> None:
    points = np.random.default_rng(4).uniform(-1, 1, shape)
    np.testing.assert_allclose(paper.coarsen(points, closed), dense_coarsen(points, closed), rtol=0, atol=1e-12)


@pytest.mark.parametrize("channels", [1, 2, 3, 5, 40])
def test_channels_are_independent(channels: int) -> None:
    points = np.random.default_rng(5).uniform(-1, 1, (21, 26, channels))
    level = paper.coarsen(points, (False, True))
    assert level.shape == (11, 13, channels)
    for channel in range(channels):
        alone = paper.coarsen(points[..., channel], (False, True))
        np.testing.assert_allclose(level[..., channel], alone, rtol=0, atol=1e-15)


def test_few_terms_are_a_coarser_answer_within_their_bound() -> None:
    points = np.random.default_rng(6).uniform(-1, 1, (65, 1))
    error = np.abs(paper.coarsen(points, terms=3) - dense_coarsen(points)).max()
    assert 1e-9 < error <= 8 * bound(3)


@pytest.mark.parametrize("closed", CLOSED, ids=str)
@pytest.mark.parametrize("shape", [(1, 1), (17, 33), (24, 7), (19, 1), (12, 13, 3)], ids=str)
def test_hierarchy_coarsens_until_both_axes_have_stopped(shape: tuple[int, ...], closed: tuple[bool, bool]) -> None:
    points = np.random.default_rng(7).uniform(-1, 1, shape)
    levels = paper.hierarchy(points, closed)
    np.testing.assert_array_equal(levels[-1], points)
    for coarse, fine in pairwise(levels):
        assert coarse.shape[0] * coarse.shape[1] < fine.shape[0] * fine.shape[1]
        np.testing.assert_allclose(coarse, dense_coarsen(fine, closed), rtol=0, atol=1e-12)
    for length, wraps in zip(levels[0].shape[:2], closed, strict=True):
        assert length <= (4 if wraps else 2)
    assert {level.shape[2:] for level in levels} == {shape[2:]}


def test_hierarchy_of_the_paper_halves_the_intervals() -> None:
    assert [level.shape for level in paper.hierarchy(np.zeros((17, 9)))] == [(2, 2), (3, 2), (5, 3), (9, 5), (17, 9)]


def test_hierarchy_ends_with_a_float64_copy_of_integers() -> None:
    points = np.arange(15, dtype=np.uint8).reshape(5, 3)
    levels = paper.hierarchy(points)
    assert {level.dtype for level in levels} == {np.dtype(np.float64)}
    np.testing.assert_array_equal(levels[-1], points)


sizes = st.integers(1, 40)


@given(sizes, sizes, st.booleans(), st.booleans(), st.integers(0, 2**32 - 1))
def test_residuals_are_orthogonal_to_every_bilinear_surface(
    height: int, width: int, rows: bool, columns: bool, seed: int
) -> None:
    generator = np.random.default_rng(seed)
    points = generator.uniform(-1, 1, (height, width))
    level = paper.coarsen(points, (rows, columns))
    residual = points - refine(level, (height, width), (rows, columns))
    other = refine(generator.uniform(-1, 1, level.shape), (height, width), (rows, columns))
    assert abs((residual * other).mean()) < 1e-13


@given(sizes, sizes, st.booleans(), st.booleans(), st.integers(0, 2**32 - 1))
def test_a_refined_surface_is_coarsened_to_where_it_came_from(
    height: int, width: int, rows: bool, columns: bool, seed: int
) -> None:
    shape = paper.coarsen(np.zeros((height, width)), (rows, columns)).shape
    level = np.random.default_rng(seed).uniform(-1, 1, shape)
    again = paper.coarsen(refine(level, (height, width), (rows, columns)), (rows, columns))
    np.testing.assert_allclose(again, level, rtol=0, atol=1e-14)


@given(st.integers(-990, 990), sizes)
def test_scale_does_not_matter(exponent: int, length: int) -> None:
    points = np.random.default_rng(length).uniform(-1, 1, (length, 3))
    scale = 2.0**exponent
    np.testing.assert_array_equal(paper.coarsen(points * scale), paper.coarsen(points) * scale)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e305])
@pytest.mark.parametrize(
    "function",
    [
        paper.solve,
        paper.solve_closed,
        paper.coarsen,
        paper.hierarchy,
        paper.curve_right_hand_sides,
        paper.surface_right_hand_sides,
    ],
)
def test_holes_and_magnitudes_that_would_overflow_are_refused_with_their_place(function: Any, value: float) -> None:
    points = np.zeros((6, 7))
    points[4, 2] = value
    with pytest.raises(InputError, match=r"finite values of at most 2\^1000.* at index \(4, 2\)"):
        function(points)


def test_holes_are_value_errors() -> None:
    with pytest.raises(ValueError, match="nan"):
        paper.coarsen([[1.0, math.nan]])


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.zeros(5), r"\(H, W\) or \(H, W, C\), got shape \(5,\)"),
        (np.zeros((2, 2, 2, 2)), r"got shape \(2, 2, 2, 2\)"),
        (np.zeros((0, 4)), r"at least one value along every axis, got shape \(0, 4\)"),
        (np.zeros((4, 3, 0)), r"got shape \(4, 3, 0\)"),
        (np.zeros((3, 3), complex), "real numbers, got complex128"),
        (np.full((3, 3), "1"), "real numbers, got <U1"),
        (np.zeros((3, 3), bool), "real numbers, got bool"),
        ([[None]], "real numbers, got object"),
    ],
)
def test_arrays_that_are_not_surfaces_are_refused(points: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        paper.coarsen(points)
    with pytest.raises(InputError, match=message):
        paper.hierarchy(points)


@pytest.mark.parametrize("closed", [True, (True,), (False, False, False)], ids=str)
def test_closed_must_be_a_pair(closed: Any) -> None:
    with pytest.raises(InputError, match=r"closed=\(rows, columns\)"):
        paper.coarsen(np.zeros((5, 5)), closed)


@pytest.mark.parametrize("terms", [0, -1, 2.5, True, "20"])
def test_terms_must_be_a_positive_integer(terms: Any) -> None:
    for function in (paper.solve, paper.coarsen, paper.hierarchy):
        with pytest.raises(OptionError, match="positive integer"):
            function(np.zeros((5, 5)), terms=terms)


def test_a_single_number_is_no_system() -> None:
    with pytest.raises(InputError, match=r"got shape \(\)"):
        paper.solve(3.0)
