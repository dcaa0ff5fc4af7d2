"""The hierarchy in floating point: every coarser level the least-squares best grid of its size.

The same filter as `lifting`, with 24 taps and without rounding; it agrees with the dense optimum to 1e-12 of the scale.
The paper's own solver is in `paper`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .axis import AxisStep, axis_step
from .errors import InputError
from .kernels import kernel
from .surface import Closed

__all__ = ["coarsen", "hierarchy"]

_RATIO = 2.0 * np.sqrt(2.0) - 3.0
_FIRST_TAP = 1.0 - 1.0 / np.sqrt(2.0)
_REACH = 24
_STRIP = 64


def coarsen(points: ArrayLike, closed: Closed = (False, False)) -> NDArray[np.float64]:
    """One least-squares level: the grid whose bilinear refinement is nearest to the points in mean square.

    Parameters
    ----------
    points : array, shape (row, column) or (row, column, channel)
        Any real numbers; not changed.
    closed : (bool, bool)
        Whether the rows and the columns wrap.

    Returns
    -------
    float64 array
        Of an open axis of N >= 3 samples (N + 1) // 2 remain where N is odd, N // 2 + 1 where it is even; of a closed one
        of N >= 5, (N + 1) // 2; shorter axes stay as they are (always a new array).

    Raises
    ------
    InputError
        When the array is not of such a shape, or holds NaN or infinities.

    Notes
    -----
    Chung, Yan and Wu 2002, equations (1) to (6); their two-step solution is the filter of ``docs/mathematics.md``.

    Examples
    --------
    >>> coarsen([[0.0], [1.0], [2.0], [3.0], [4.0]]).ravel()
    array([0., 2., 4.])
    """
    return _coarsen(_checked(points), closed)


def hierarchy(points: ArrayLike, closed: Closed = (False, False)) -> list[NDArray[np.float64]]:
    """Every level of a surface, coarsest first, the input (as float64) last; see `coarsen`."""
    levels = [_checked(points)]
    while (coarser := _coarsen(levels[-1], closed)).shape != levels[-1].shape:
        levels.append(coarser)
    return levels[::-1]


def _checked(points: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(points)
    if array.ndim not in (2, 3) or array.size == 0 or array.dtype.kind not in "iuf":
        raise InputError(
            f"expected real numbers of shape (H, W) or (H, W, C), got {array.dtype} of shape {array.shape}"
        )
    array = np.ascontiguousarray(array, np.float64)
    if not np.isfinite(array).all():
        raise InputError(f"expected finite values, got {int((~np.isfinite(array)).sum())} that are not")
    return array


def _coarsen(points: NDArray[np.float64], closed: Closed) -> NDArray[np.float64]:
    rows, columns = (axis_step(n, c) for n, c in zip(points.shape[:2], closed, strict=True))
    planes = points.reshape(*points.shape[:2], -1)
    width, channels = planes.shape[1], planes.shape[2]
    # Channels lie next to each other, so that along axis 0 they are only more columns.
    half = _along(planes.reshape(planes.shape[0], width * channels), rows)
    coarse = np.empty((rows.coarse, columns.coarse, channels))
    for channel in range(channels):
        plane = half.reshape(rows.coarse, width, channels)[..., channel]
        coarse[..., channel] = _along(plane.T, columns).T
    return coarse.reshape(*coarse.shape[:2], *points.shape[2:])


def _along(lines: NDArray[np.float64], step: AxisStep) -> NDArray[np.float64]:
    """Coarsen axis 0; the result has the strides of a C-contiguous array transposed like the input."""
    if not step.midpoints:
        return lines.copy(order="K")
    shape = (step.coarse, lines.shape[1])
    transposed = abs(lines.strides[0]) < abs(lines.strides[1])
    out = np.empty(shape[::-1]).T if transposed else np.empty(shape)
    _coarsen_columns(lines, out, step.midpoints, step.run, step.wraps, step.extension(_REACH))
    return out


@kernel
def _coarsen_columns(
    x: NDArray[np.float64],
    out: NDArray[np.float64],
    midpoints: int,
    run: int,
    wraps: bool,
    table: NDArray[np.int64],
) -> None:
    """Nodes of the least-squares optimum along axis 0, strip by strip.

    The filter's two halves are geometric series: each is one recursion over the details, started 24 details outside,
    where what is left out weighs less than 1e-18.
    """
    length, columns = x.shape
    details = np.empty((midpoints + 2 * _REACH, _STRIP))
    after = np.empty((run, _STRIP))
    state = np.empty(_STRIP)
    for start in range(0, columns, _STRIP):
        width = min(_STRIP, columns - start)
        for k in range(midpoints):
            right = 0 if wraps and k == midpoints - 1 else 2 * k + 2
            for i in range(width):
                details[k + _REACH, i] = x[2 * k + 1, start + i] - 0.5 * (x[2 * k, start + i] + x[right, start + i])
        for side in range(2 * _REACH):
            source, sign = table[side, 0] + _REACH, float(table[side, 1])
            target = side if side < _REACH else midpoints + side
            for i in range(width):
                details[target, i] = sign * details[source, i]
        state[:] = 0.0
        for k in range(midpoints + 2 * _REACH - 1, _REACH - 1, -1):
            for i in range(width):
                state[i] = _FIRST_TAP * details[k, i] + _RATIO * state[i]
            if k - _REACH < run:
                for i in range(width):
                    after[k - _REACH, i] = state[i]
        state[:] = 0.0
        for k in range(run + _REACH):
            # state: the series of d_{k-1}, d_{k-2}, ... for node k
            if k >= _REACH:
                node = k - _REACH
                for i in range(width):
                    out[node, start + i] = x[2 * node, start + i] + after[node, i] + state[i]
            for i in range(width):
                state[i] = _FIRST_TAP * details[k, i] + _RATIO * state[i]
        if run < out.shape[0]:
            for i in range(width):
                out[run, start + i] = x[length - 1, start + i]
