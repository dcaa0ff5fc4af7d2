"""The optimal hierarchy as published: near-Toeplitz tridiagonal systems and their truncated solver.

K.-L. Chung, W.-M. Yan, J.-G. Wu, *Optimal Hierarchies for Quadrilateral Surfaces*. The next coarser level of a grid is
the one whose bilinear refinement is nearest to it in mean square. Its normal equations separate by axis into systems
with the matrix A_p = tridiag(1, 6, 1) and corners 5. Errata, proofs, and what this module adds (closed axes, every
length) are in ``docs/mathematics.md``. `lodestream.levels` computes the same hierarchy as a filter; the two are
independent of each other, and the tests hold both against dense least squares.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .axis import AxisStep, axis_step
from .errors import InputError, OptionError
from .paper_kernels import ALPHA, combine, solve_columns, solve_rows
from .surface import Closed

__all__ = [
    "coarsen",
    "curve_right_hand_sides",
    "hierarchy",
    "solve",
    "solve_closed",
    "surface_right_hand_sides",
]

Floats = NDArray[np.float64]

#: Sixteen times a value, the centre of the stencil of Lemma 1, must not overflow, nor its sums; this leaves ample room.
_LARGEST = 2.0**1000


def solve(right_hand_sides: ArrayLike, terms: int = 20) -> Floats:
    """Solve A_p x = b, A_p = tridiag(1, 6, 1) with corners 5, for many b at once.

    Parameters
    ----------
    right_hand_sides : array of real numbers, shape (p, ...), p > 0
        The systems' axis first; every other axis counts right-hand sides. Not changed.
    terms : int greater than 0
        k, the length of the correction at either end. Below k unknowns there is no room for it, and the elimination
        runs with the exact pivots instead; A_1 is (4), the matrix of a node without neighbours.

    Returns
    -------
    float64 array, shape (p, ...)
        Within (3 + sqrt 2)/32 abs(c)^k of the exact solution, c = 2 sqrt 2 - 3, relative to the largest absolute value
        of b, and rounding: 3.1e-9 for k = 10, below rounding for k = 20.

    Raises
    ------
    InputError
        When the array is empty, is not of real numbers, or holds NaN, infinities or magnitudes above 2^1000.
    OptionError
        When ``terms`` is not a positive integer.

    Notes
    -----
    Lemma 2, errata corrected. A'_p, equal to A_p but for 3 + 2 sqrt 2 and 6 in its corners, is the product of two
    bidiagonal Toeplitz matrices, so that A'_p z = b costs 4p operations and no division::

        w_1 = b_1,          w_i = b_i - alpha w_{i-1}             alpha = 3 - 2 sqrt 2 = -c
        z_p = alpha w_p,    z_i = alpha (w_i - z_{i+1})
        y   = z - z_1 u - (1/2)(1 + sqrt 2) z_p v,                u_i = c^i, v_i = c^{p+1-i}, k terms of each

    Examples
    --------
    >>> solve([6.0, 8.0, 8.0, 6.0])
    array([1., 1., 1., 1.])
    """
    values, terms = _numbers(right_hand_sides), _positive(terms)
    solution = values.reshape(values.shape[0], -1).copy()
    solve_columns(solution, _pivots(values.shape[0], terms, False), terms, False)
    return solution.reshape(values.shape)


def solve_closed(right_hand_sides: ArrayLike) -> Floats:
    """Solve the circulant systems of closed axes: tridiag(1, 6, 1), with the last unknown next to the first.

    Parameters
    ----------
    right_hand_sides : array of real numbers, shape (p, ...), p > 0
        The systems' axis first; every other axis counts right-hand sides. Not changed.

    Returns
    -------
    float64 array, shape (p, ...)
        Exact to rounding, at 4p operations and a constant for each system.

    Raises
    ------
    InputError
        As in `solve`.

    Notes
    -----
    The paper mentions these systems and leaves them out. The circulant matrix is the product of the two circulant
    bidiagonal matrices with the same alpha as in Lemma 2; where each sweep starts follows from summing the geometric
    series around the axis, sum over j < p of c^j b_{-j}, divided by 1 - c^p. For p = 2 both neighbours are the other
    unknown (entries 6 and 2), for p = 1 the unknown itself (entry 8).
    """
    values = _numbers(right_hand_sides)
    solution = values.reshape(values.shape[0], -1).copy()
    solve_columns(solution, _pivots(values.shape[0], 1, True), 1, True)
    return solution.reshape(values.shape)


def curve_right_hand_sides(points: ArrayLike, closed: bool = False) -> Floats:
    """Right-hand sides of the systems of curves.

    Parameters
    ----------
    points : array of real numbers, shape (N, ...)
        Points of a curve in order, any number of curves or coordinates on the other axes.
    closed : bool
        The last point is followed by the first.

    Returns
    -------
    float64 array, shape (M, ...)
        ``4 x[2k] + 2 x[2k-1] + 2 x[2k+1]``, leaving out neighbours beyond a free end. A point beyond a gap (last one of
        an even open length) and the points of an axis that has stopped are nodes outside any system: returned as they
        are.

    Raises
    ------
    InputError
        As in `solve`.

    Notes
    -----
    Lemma 1 for curves. Half the gradient of sum_k (x_{2k} - z_k)^2 + sum_k (x_{2k+1} - (z_k + z_{k+1})/2)^2, times 4.
    """
    values = _numbers(points)
    grid = values.reshape(values.shape[0], 1, -1)
    sides = _right_hand_sides(grid, axis_step(grid.shape[0], bool(closed)), axis_step(1))
    return sides.reshape(sides.shape[0], *values.shape[1:])


def surface_right_hand_sides(points: ArrayLike, closed: Closed = (False, False)) -> Floats:
    """Right-hand sides B of the systems A_m Z A_n = B of surfaces.

    Parameters
    ----------
    points : array of real numbers, shape (H, W) or (H, W, C)
        Rows, columns, channels.
    closed : (bool, bool)
        Whether rows (axis 0) and columns (axis 1) wrap.

    Returns
    -------
    float64 array, shape (m, n) or (m, n, C)
        The stencil ``4 2 1`` squared: 16 times a node's own point, 8 times its neighbours along an axis, 4 times its
        diagonal neighbours, leaving out those beyond a free end; along an axis where a node is outside any system (see
        `curve_right_hand_sides`) the plain value.

    Raises
    ------
    InputError
        As in `coarsen`.

    Notes
    -----
    Lemma 1 for surfaces: half the gradient of the squared distance over nodes, edge midpoints and face midpoints,
    times 16.
    """
    values, flags = _surface(points), _flags(closed)
    grid = values.reshape(*values.shape[:2], -1)
    sides = _right_hand_sides(grid, axis_step(grid.shape[0], flags[0]), axis_step(grid.shape[1], flags[1]))
    return sides.reshape(*sides.shape[:2], *values.shape[2:])


def coarsen(points: ArrayLike, closed: Closed = (False, False), terms: int = 20) -> Floats:
    """Next coarser level: the grid whose bilinear refinement is nearest in mean square.

    Parameters
    ----------
    points : array of real numbers, shape (H, W) or (H, W, C)
        Rows, columns, channels; a curve is (N, 1) or (N, 1, C). Not changed.
    closed : (bool, bool)
        Whether rows (axis 0) and columns (axis 1) wrap.
    terms : int greater than 0
        See `solve`.

    Returns
    -------
    float64 array, shape (m, n) or (m, n, C), a new one
        An open axis of N >= 3 points keeps N//2 + 1, a closed one of N >= 5 keeps (N + 1)//2; a shorter axis has
        stopped and is left alone. With the default ``terms`` the optimum to 1e-12 of the largest magnitude.

    Raises
    ------
    InputError
        When the array has another shape, is empty, is not of real numbers, or holds NaN, infinities or magnitudes
        above 2^1000.
    OptionError
        When ``terms`` is not a positive integer.

    Notes
    -----
    Theorem 1: Lemma 1, then the systems along axis 0, then those along axis 1.
    """
    values, flags = _surface(points), _flags(closed)
    coarse = _coarsen(values.reshape(*values.shape[:2], -1), flags, _positive(terms))
    return coarse.reshape(*coarse.shape[:2], *values.shape[2:])


def hierarchy(points: ArrayLike, closed: Closed = (False, False), terms: int = 20) -> list[Floats]:
    """Every level, each the optimum for the next finer one.

    Parameters
    ----------
    points : array of real numbers, shape (H, W) or (H, W, C)
        Rows, columns, channels; a curve is (N, 1) or (N, 1, C).
    closed : (bool, bool)
        Whether rows (axis 0) and columns (axis 1) wrap.
    terms : int greater than 0
        See `solve`.

    Returns
    -------
    list of float64 arrays
        Coarsest first, the input last: the array itself where it is C-contiguous float64 already, otherwise a copy.
        Levels go on until both axes have stopped.

    Raises
    ------
    InputError, OptionError
        As in `coarsen`.

    Notes
    -----
    Theorem 2. The optimum is nested: level by level, not of every level against the input.
    """
    values, flags, terms = _surface(points), _flags(closed), _positive(terms)
    levels, grid = [values], values.reshape(*values.shape[:2], -1)
    while (coarse := _coarsen(grid, flags, terms)).shape != grid.shape:
        levels.append(coarse.reshape(*coarse.shape[:2], *values.shape[2:]))
        grid = coarse
    return levels[::-1]


def _coarsen(grid: Floats, closed: Closed, terms: int) -> Floats:
    steps = axis_step(grid.shape[0], closed[0]), axis_step(grid.shape[1], closed[1])
    values = _right_hand_sides(grid, *steps)
    rows, columns = steps
    if rows.midpoints:
        flat = values.reshape(values.shape[0], -1)
        solve_columns(flat, _pivots(rows.run, terms, rows.wraps), terms, rows.wraps)
    if columns.midpoints:
        solve_rows(values, _pivots(columns.run, terms, columns.wraps), terms, columns.wraps)
    return values


def _right_hand_sides(grid: Floats, rows: AxisStep, columns: AxisStep) -> Floats:
    sides = np.empty((rows.coarse, columns.coarse, grid.shape[2]))
    combine(grid, sides, rows.run, rows.midpoints, rows.wraps, columns.run, columns.midpoints, columns.wraps)
    return sides


def _pivots(size: int, terms: int, closed: bool) -> Floats:
    """Reciprocals of the pivots: all alpha where Lemma 2 applies, the exact ones of A_p where p < k."""
    pivots = np.full(size, ALPHA)
    if size < terms and not closed:
        above = 0.0
        for i in range(size):
            above = pivots[i] = 1.0 / (6.0 - (i == 0) - (i == size - 1) - above)
    return pivots


def _numbers(values: ArrayLike) -> Floats:
    array: NDArray[Any] = np.asarray(values)
    if array.dtype.kind not in "iuf":
        raise InputError(f"expected real numbers, got {array.dtype}")
    if array.ndim == 0 or array.size == 0:
        raise InputError(f"expected at least one value along every axis, got shape {array.shape}")
    array = np.ascontiguousarray(array, np.float64)
    # NaN and infinities reach the extremes, so that two reductions without a temporary array find everything.
    if not (array.min() >= -_LARGEST and array.max() <= _LARGEST):
        place = np.unravel_index(int((~(np.abs(array) <= _LARGEST)).argmax()), array.shape)
        where = tuple(int(i) for i in place)
        raise InputError(f"expected finite values of at most 2^1000 in magnitude, got {array[where]} at index {where}")
    return array


def _surface(points: ArrayLike) -> Floats:
    values = _numbers(points)
    if values.ndim not in (2, 3):
        raise InputError(f"expected an array of shape (H, W) or (H, W, C), got shape {values.shape}")
    return values


def _flags(closed: Closed) -> Closed:
    try:
        rows, columns = closed
    except (TypeError, ValueError):
        raise InputError(f"expected closed=(rows, columns), got {closed!r}") from None
    return bool(rows), bool(columns)


def _positive(terms: int) -> int:
    if isinstance(terms, bool) or not isinstance(terms, int | np.integer) or terms < 1:
        raise OptionError(f"expected a positive integer for terms, got {terms!r}")
    return int(terms)
