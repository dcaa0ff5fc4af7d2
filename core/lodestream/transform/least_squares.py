"""The hierarchy in floating point: every coarser level is the least-squares optimum for the next finer one.

It is the filter of `lifting` without rounding and with all significant taps, as operations on whole arrays. It agrees
with a dense least-squares solution to 1e-12 of the scale. The paper's own solver is in `paper`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..grid.axis import AxisStep, axis_step
from ..surface import Closed

__all__ = ["coarsen", "hierarchy"]

# The optimum is x_2k + _GAIN (w_k + w_{k-1}), where w is the details d run through 1 / ((1 - r z)(1 - r / z)). That
# series is a product, 1 / (1 - r z) = (1 + r z)(1 + r^2 z^2)(1 + r^4 z^4) ..., and each factor times its mirror image
# is 1 + r^2n times 1 + p (z^n + z^-n). What the five factors leave out weighs less than 1e-24.
_RATIO = 2.0 * np.sqrt(2.0) - 3.0
_SPANS = (1, 2, 4, 8, 16)
_WEIGHTS = tuple(float(_RATIO**n / (1.0 + _RATIO ** (2 * n))) for n in _SPANS)
_GAIN = (1.0 - 1.0 / np.sqrt(2.0)) * (1.0 - _RATIO) * float(np.prod([1.0 + _RATIO ** (2 * n) for n in _SPANS]))
_REACH = 1 + sum(_SPANS)


def coarsen(points: ArrayLike, closed: Closed = (False, False)) -> NDArray[np.float64]:
    """Compute the next coarser level: the grid whose bilinear refinement is closest to the points in mean square.

    Parameters
    ----------
    points : array, shape (row, column) or (row, column, channel)
        Real numbers; not changed.
    closed : (bool, bool)
        Whether rows (axis 0) and columns (axis 1) are closed.

    Returns
    -------
    float64 array
        A new array. An open axis of N >= 3 samples keeps (N + 1) // 2 if N is odd, N // 2 + 1 if N is even. A closed
        axis of N >= 5 keeps (N + 1) // 2. Shorter axes keep their length.

    Raises
    ------
    InputError
        If the array has another shape, or contains NaN or infinities.

    Notes
    -----
    Chung, Yan and Wu 2002, equations (1) to (6); their two-step solution is the filter of ``docs/mathematics.md``.

    Examples
    --------
    >>> coarsen([[0.0], [1.0], [2.0], [3.0], [4.0]]).ravel()
    array([0., 2., 4.])
    """
    array = _as_floats(points)
    return _checked(array, _coarsen(array, closed))


def hierarchy(points: ArrayLike, closed: Closed = (False, False)) -> list[NDArray[np.float64]]:
    """Compute all levels of a surface, shape (H, W) or (H, W, C), from the coarsest to the input (as float64).

    See `coarsen`.

    Examples
    --------
    >>> import lodestream, numpy
    >>> [level.shape for level in lodestream.hierarchy(numpy.zeros((9, 17)))]
    [(2, 2), (2, 3), (3, 5), (5, 9), (9, 17)]
    """
    levels = [_as_floats(points)]
    while (coarser := _coarsen(levels[-1], closed)).shape != levels[-1].shape:
        levels.append(coarser)
    _checked(levels[0], levels[min(1, len(levels) - 1)])
    return levels[::-1]


def _as_floats(points: ArrayLike) -> NDArray[np.float64]:
    """Return the points as a C-contiguous float64 array; raise InputError for other shapes and types."""
    array = np.asarray(points)
    if array.ndim not in (2, 3) or array.size == 0 or array.dtype.kind not in "iuf":
        raise InputError(
            f"expected real numbers of shape (H, W) or (H, W, C), got {array.dtype} of shape {array.shape}"
        )
    return np.ascontiguousarray(array, np.float64)


def _checked(points: NDArray[np.float64], coarser: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the coarser level; raise InputError if the points are not finite."""
    # A value that is not finite spreads to the coarser level, which is faster to search than the input.
    if not np.isfinite(coarser).all() and not np.isfinite(points).all():
        raise InputError(f"expected finite values, got {int((~np.isfinite(points)).sum())} that are not")
    return coarser


def _coarsen(points: NDArray[np.float64], closed: Closed) -> NDArray[np.float64]:
    """Compute the next coarser level of points, shape (row, column, ...), without checks."""
    rows, columns = (axis_step(n, c) for n, c in zip(points.shape[:2], closed, strict=True))
    with np.errstate(over="ignore", invalid="ignore"):  # `_checked` looks for what is not finite
        coarse = _coarsen_rows(points, rows)
        coarse = _coarsen_rows(coarse.swapaxes(0, 1), columns).swapaxes(0, 1)
    return np.array(coarse, order="C")


def _coarsen_rows(points: NDArray[np.float64], step: AxisStep) -> NDArray[np.float64]:
    """Coarsen along axis 0, for all positions along the other axes at once."""
    if not step.midpoints:
        return points
    nodes, middles = points[: 2 * step.run : 2], points[1 : 2 * step.midpoints : 2]
    after = np.roll(nodes, -1, axis=0) if step.wraps else nodes[1:]
    details = middles - 0.5 * (nodes[: step.midpoints] + after)
    beyond = step.extension(_REACH)
    outside = details[beyond[:, 0]] * beyond[:, 1].reshape(-1, *[1] * (points.ndim - 1))
    series = np.concatenate([outside[:_REACH], details, outside[_REACH:]])
    for span, weight in zip(_SPANS, _WEIGHTS, strict=True):
        series = series[span:-span] + weight * (series[: -2 * span] + series[2 * span :])
    coarse = nodes + _GAIN * (series[: step.run] + series[1 : step.run + 1])
    return np.concatenate([coarse, points[-1:]]) if step.tail else coarse
