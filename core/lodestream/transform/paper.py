"""The optimal hierarchy as published: near-Toeplitz tridiagonal systems and their truncated solver.

K.-L. Chung, W.-M. Yan, J.-G. Wu, *Optimal Hierarchies for Quadrilateral Surfaces*. The next coarser level of a grid is
the one whose bilinear refinement is nearest to it in mean square. Its normal equations separate by axis into systems
with the matrix A_p = tridiag(1, 6, 1) and corners 5. Errata, proofs, and what this module adds (closed axes, every
length) are in ``docs/mathematics.md``. `lodestream.transform.least_squares` computes the same hierarchy as a filter;
the two are independent of each other, and the tests hold both against dense least squares.

Examples
--------
>>> from lodestream import paper
>>> paper.solve([6.0, 8.0, 8.0, 6.0]).round(3).tolist()
[1.0, 1.0, 1.0, 1.0]
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError, OptionError
from ..grid.axis import AxisStep, axis_step
from ..surface import Closed

__all__ = [
    "coarsen",
    "curve_right_hand_sides",
    "hierarchy",
    "solve",
    "solve_closed",
    "surface_right_hand_sides",
]

Floats = NDArray[np.float64]

#: Reciprocal of the constant pivot: the factors of A'_p have 1/alpha = 3 + 2 sqrt 2 on the diagonal.
_ALPHA = 3.0 - 2.0 * math.sqrt(2.0)
#: Root of c^2 + 6 c + 1 = 0 inside the unit circle; the inverse of A_p decays by it from one entry to the next.
_DECAY = -_ALPHA
#: Sums around a closed axis stop here: the next power of c is below 1e-36, out of reach of float64.
_CLOSED_TERMS = 48
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
    solution = _numbers(right_hand_sides).copy()
    _solve(solution, _positive(terms))
    return solution


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
    solution = _numbers(right_hand_sides).copy()
    _solve_closed(solution)
    return solution


def curve_right_hand_sides(points: ArrayLike, closed: bool = False) -> Floats:
    """Compute the right-hand sides of the systems of curves.

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
    return np.array(_right_hand_sides(values, axis_step(values.shape[0], bool(closed))))


def surface_right_hand_sides(points: ArrayLike, closed: Closed = (False, False)) -> Floats:
    """Compute the right-hand sides B of the systems A_m Z A_n = B of surfaces.

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
    sides = _right_hand_sides(values, axis_step(values.shape[0], flags[0]))
    sides = _right_hand_sides(sides.swapaxes(0, 1), axis_step(values.shape[1], flags[1])).swapaxes(0, 1)
    return np.array(sides, order="C")


def coarsen(points: ArrayLike, closed: Closed = (False, False), terms: int = 20) -> Floats:
    """Compute the next coarser level: the grid whose bilinear refinement is nearest in mean square.

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
    return _coarsen(values, flags, _positive(terms))


def hierarchy(points: ArrayLike, closed: Closed = (False, False), terms: int = 20) -> list[Floats]:
    """Compute every level, each the optimum for the next finer one.

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
    levels = [values]
    while (coarse := _coarsen(levels[-1], flags, terms)).shape != levels[-1].shape:
        levels.append(coarse)
    return levels[::-1]


def _coarsen(points: Floats, closed: Closed, terms: int) -> Floats:
    """Compute the next coarser level of checked points, (row, column) or (row, column, channel)."""
    rows, columns = axis_step(points.shape[0], closed[0]), axis_step(points.shape[1], closed[1])
    along_rows = _coarsen_axis(points, rows, terms)
    return _coarsen_axis(along_rows.swapaxes(0, 1), columns, terms).swapaxes(0, 1).copy()


def _coarsen_axis(points: Floats, step: AxisStep, terms: int) -> Floats:
    """Apply Lemma 1, then Lemma 2, along axis 0."""
    # The sweeps go along axis 0, so that its neighbours have to be whole rows in memory.
    sides = np.ascontiguousarray(_right_hand_sides(points, step))
    if step.wraps:
        _solve_closed(sides[: step.run])
    elif step.midpoints:
        _solve(sides[: step.run], terms)
    return sides


def _right_hand_sides(points: Floats, step: AxisStep) -> Floats:
    """Apply Lemma 1 along axis 0."""
    if not step.midpoints:
        return points
    midpoints = points[1 : 2 * step.midpoints : 2]
    sides = 4.0 * points[: 2 * step.run : 2]
    sides[: step.midpoints] += 2.0 * midpoints
    if step.wraps:
        sides += 2.0 * np.roll(midpoints, 1, axis=0)
    else:
        sides[1:] += 2.0 * midpoints
    return np.concatenate([sides, points[-1:]]) if step.tail else sides


def _solve(z: Floats, terms: int) -> None:
    """Apply Lemma 2 along axis 0 (p, ...), in place: both sweeps take all right-hand sides of a row at once."""
    size = z.shape[0]
    pivots = _pivots(size, terms)
    for i in range(1, size):
        z[i] -= pivots[i - 1] * z[i - 1]
    z[-1] *= pivots[-1]
    for i in range(size - 2, -1, -1):
        z[i] = pivots[i] * (z[i] - z[i + 1])
    if size < terms:
        return
    powers = (_DECAY ** np.arange(1, terms + 1)).reshape(-1, *[1] * (z.ndim - 1))
    first, last = z[0].copy(), (0.5 + math.sqrt(0.5)) * z[-1]
    z[:terms] -= powers * first
    z[size - terms :] -= powers[::-1] * last


def _solve_closed(z: Floats) -> None:
    """Solve the circulant systems along axis 0 (p, ...), in place."""
    size = z.shape[0]
    powers = _DECAY ** np.arange(1, min(size, _CLOSED_TERMS))
    around = 1.0 - _DECAY**size
    z[0] = (z[0] + np.tensordot(powers, z[: size - len(powers) - 1 : -1], axes=1)) / around
    for i in range(1, size):
        z[i] -= _ALPHA * z[i - 1]
    z[-1] = (z[-1] + np.tensordot(powers, z[: len(powers)], axes=1)) * _ALPHA / around
    for i in range(size - 2, -1, -1):
        z[i] = _ALPHA * (z[i] - z[i + 1])


def _pivots(size: int, terms: int) -> list[float]:
    """Return reciprocals of the pivots: all alpha where Lemma 2 applies, the exact ones of A_p where p < k."""
    if size >= terms:
        return [_ALPHA] * size
    pivots: list[float] = []
    for i in range(size):
        above = pivots[-1] if pivots else 0.0
        pivots.append(1.0 / (6.0 - (i == 0) - (i == size - 1) - above))
    return pivots


def _numbers(values: ArrayLike) -> Floats:
    """Return the values as C-contiguous float64; raise InputError for empty, non-numeric or too large ones."""
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
    """Return checked points of a surface, shape (row, column) or (row, column, channel)."""
    values = _numbers(points)
    if values.ndim not in (2, 3):
        raise InputError(f"expected an array of shape (H, W) or (H, W, C), got shape {values.shape}")
    return values


def _flags(closed: Closed) -> Closed:
    """Return the flags of both axes as bool; raise InputError for anything but a pair."""
    try:
        rows, columns = closed
    except (TypeError, ValueError):
        raise InputError(f"expected closed=(rows, columns), got {closed!r}") from None
    return bool(rows), bool(columns)


def _positive(terms: int) -> int:
    """Return ``terms``; raise OptionError unless it is a positive integer."""
    if isinstance(terms, bool) or not isinstance(terms, int | np.integer) or terms < 1:
        raise OptionError(f"expected a positive integer for terms, got {terms!r}")
    return int(terms)
