"""The hierarchy in floating point: every coarser level the least-squares best grid of its size.

The same filter as `lifting`, without rounding and with all of its taps that matter; it agrees with the dense optimum to
1e-12 of the scale. The paper's own solver is in `paper`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .axis import axis_step
from .errors import InputError
from .kernels import bare_kernel, kernel
from .surface import Closed

__all__ = ["coarsen", "hierarchy"]

# sum_j h_j (d_{k+j} + d_{k-1-j}) = _GAIN (w_k + w_{k-1}), where w is d run through 1 / ((1 - r z)(1 - r / z)).
_RATIO = 2.0 * np.sqrt(2.0) - 3.0
_GAIN = (1.0 - 1.0 / np.sqrt(2.0)) * (1.0 - _RATIO)
# Along rows the series is a product, 1 / (1 - r z) = (1 + r z)(1 + r^2 z^2)(1 + r^4 z^4) ..., and each factor times its
# mirror image is 1 + r^2n times 1 + p (z^n + z^-n).
_P1, _P2, _P4, _P8, _P16 = (_RATIO**n / (1.0 + _RATIO ** (2 * n)) for n in (1, 2, 4, 8, 16))
_ROW_GAIN = _GAIN * float(np.prod([1.0 + _RATIO ** (2 * n) for n in (1, 2, 4, 8, 16)]))
_REACH = 32
_STRIP = 128  # columns worked on together


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
        Of an open axis of N >= 3 samples (N + 1) // 2 remain where N is odd, N // 2 + 1 where it is even; of a closed
        one of N >= 5, (N + 1) // 2; shorter axes stay as they are (always a new array).

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
    array = _as_floats(points)
    return _checked(array, _coarsen(array, closed))


def hierarchy(points: ArrayLike, closed: Closed = (False, False)) -> list[NDArray[np.float64]]:
    """Every level of a surface, coarsest first, the input (as float64) last; see `coarsen`."""
    levels = [_as_floats(points)]
    while (coarser := _coarsen(levels[-1], closed)).shape != levels[-1].shape:
        levels.append(coarser)
    _checked(levels[0], levels[min(1, len(levels) - 1)])
    return levels[::-1]


def _as_floats(points: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(points)
    if array.ndim not in (2, 3) or array.size == 0 or array.dtype.kind not in "iuf":
        raise InputError(
            f"expected real numbers of shape (H, W) or (H, W, C), got {array.dtype} of shape {array.shape}"
        )
    return np.ascontiguousarray(array, np.float64)


def _checked(points: NDArray[np.float64], coarser: NDArray[np.float64]) -> NDArray[np.float64]:
    # Whatever is not finite in the input leaves its mark on the coarser level, which takes less time to look through.
    if not np.isfinite(coarser).all() and not np.isfinite(points).all():
        raise InputError(f"expected finite values, got {int((~np.isfinite(points)).sum())} that are not")
    return coarser


def _coarsen(points: NDArray[np.float64], closed: Closed) -> NDArray[np.float64]:
    rows, columns = (axis_step(n, c) for n, c in zip(points.shape[:2], closed, strict=True))
    channels = points.shape[2] if points.ndim == 3 else 1
    # Channels lie next to each other, so that along axis 0 they are only more columns.
    lines = points.reshape(points.shape[0], -1)
    if columns.midpoints:
        fine, lines = lines, np.empty((lines.shape[0], columns.coarse * channels))
        table = columns.extension(_REACH)
        _coarsen_rows(fine, lines, channels, columns.midpoints, columns.run, columns.wraps, table)
    if rows.midpoints:
        fine, lines = lines, np.empty((rows.coarse, lines.shape[1]))
        room = np.zeros((rows.midpoints + 2 * _REACH, _STRIP)), np.zeros(_STRIP), np.zeros(_STRIP)
        _coarsen_columns(fine, lines, rows.midpoints, rows.run, rows.wraps, rows.extension(_REACH), *room)
    if not (rows.midpoints or columns.midpoints):
        lines = lines.copy()
    return lines.reshape(rows.coarse, columns.coarse, *points.shape[2:])


@bare_kernel
def _detail(
    x: NDArray[np.float64], k: int, wraps: bool, midpoints: int, start: int, stop: int, out: NDArray[np.float64]
) -> None:
    """Detail k of the columns of a strip."""
    right = 0 if wraps and k == midpoints - 1 else 2 * k + 2
    before, middle, after = x[2 * k, start:stop], x[2 * k + 1, start:stop], x[right, start:stop]
    for i in range(middle.size):
        out[i] = middle[i] - 0.5 * (before[i] + after[i])


@bare_kernel
def _coarsen_columns(
    x: NDArray[np.float64],
    out: NDArray[np.float64],
    midpoints: int,
    run: int,
    wraps: bool,
    table: NDArray[np.int64],
    causal: NDArray[np.float64],
    detail: NDArray[np.float64],
    state: NDArray[np.float64],
) -> None:
    """Nodes of the least-squares optimum along axis 0, strip by strip.

    w is one recursion down the details and one back up, both started 32 details outside, where what is left out weighs
    less than 1e-24. The last three are room to work in.
    """
    length, columns = x.shape
    for start in range(0, columns, _STRIP):
        stop = min(start + _STRIP, columns)
        state[:] = 0.0
        for place in range(midpoints + 2 * _REACH):
            k, sign = place - _REACH, 1.0
            if k < 0 or k >= midpoints:
                side = place if k < 0 else place - midpoints
                k, sign = table[side, 0], float(table[side, 1])
            _detail(x, k, wraps, midpoints, start, stop, detail)
            w = causal[place]
            for i in range(_STRIP):
                state[i] = sign * detail[i] + _RATIO * state[i]
                w[i] = state[i]
        state[:] = 0.0
        for place in range(run + 2 * _REACH - 2, _REACH - 2, -1):
            # state: w_k of the node k = place - _REACH + 1
            w = causal[place]
            node = place - _REACH + 1
            if node < run:
                fine, coarse = x[2 * node, start:stop], out[node, start:stop]
                for i in range(fine.size):
                    coarse[i] = fine[i] + _GAIN * (w[i] + (1.0 + _RATIO) * state[i])
            for i in range(_STRIP):
                state[i] = w[i] + _RATIO * state[i]
        if run < out.shape[0]:
            for j in range(start, stop):
                out[run, j] = x[length - 1, j]


@bare_kernel
def _spread_sum(source: NDArray[np.float64], target: NDArray[np.float64], reach: int, weight: float) -> None:
    """Add the neighbours on both sides, weighted; what is within ``reach`` of an end is left alone."""
    inner = source.size - 2 * reach
    before, middle, after = source[:inner], source[reach : reach + inner], source[2 * reach :]
    out = target[reach : reach + inner]
    for i in range(inner):
        out[i] = middle[i] + weight * (before[i] + after[i])


@kernel
def _coarsen_rows(
    x: NDArray[np.float64],
    out: NDArray[np.float64],
    channels: int,
    midpoints: int,
    run: int,
    wraps: bool,
    table: NDArray[np.int64],
) -> None:
    """Nodes of the least-squares optimum along axis 1, row by row; samples of a channel stand ``channels`` apart."""
    outside = _REACH * channels
    details = np.zeros(midpoints * channels + 2 * outside)
    other = np.zeros(details.size)
    for row in range(x.shape[0]):
        samples, coarse = x[row], out[row]
        inner = details[outside : outside + midpoints * channels]
        if channels == 1:
            for k in range(midpoints - 1):
                inner[k] = samples[2 * k + 1] - 0.5 * (samples[2 * k] + samples[2 * k + 2])
        first = midpoints - 1 if channels == 1 else 0
        for k in range(first, midpoints):
            right = 0 if wraps and k == midpoints - 1 else 2 * k + 2
            for c in range(channels):
                ends = samples[2 * k * channels + c] + samples[right * channels + c]
                inner[k * channels + c] = samples[(2 * k + 1) * channels + c] - 0.5 * ends
        for side in range(2 * _REACH):
            source, sign = table[side, 0] + _REACH, float(table[side, 1])
            target = side if side < _REACH else midpoints + side
            for c in range(channels):
                details[target * channels + c] = sign * details[source * channels + c]
        _spread_sum(details, other, channels, _P1)
        _spread_sum(other, details, 2 * channels, _P2)
        _spread_sum(details, other, 4 * channels, _P4)
        _spread_sum(other, details, 8 * channels, _P8)
        _spread_sum(details, other, 16 * channels, _P16)
        before, after = other[outside - channels :], other[outside:]
        if channels == 1:
            for k in range(run):
                coarse[k] = samples[2 * k] + _ROW_GAIN * (before[k] + after[k])
        else:
            for k in range(run):
                for c in range(channels):
                    i = k * channels + c
                    coarse[i] = samples[2 * k * channels + c] + _ROW_GAIN * (before[i] + after[i])
        for i in range(run * channels, coarse.size):
            coarse[i] = samples[samples.size - coarse.size + i]
