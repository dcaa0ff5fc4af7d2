"""The optimal hierarchy as a lifting scheme on integers: forward and inverse, exactly.

One step along one axis turns samples x into nodes c and details e (the formulas and their proofs are in
``docs/mathematics.md``; Chung, Yan and Wu 2002 give the least-squares optimum that c is)::

    d_k = x_{2k+1} - floor((x_{2k} + x_{2k+2}) / 2)                        predict
    c_k = x_{2k} + floor(2^-24 sum_j h_j (d_{k+j} + d_{k-1-j}) + 3/8)      update: the optimum
    e_k = d_k - floor((v_k + 128) / 256)                                   predict again, from c
    v_k = a (-c_{k+2} + c_{k+1} + c_k - c_{k-1}) + b (-c_{k+3} + c_{k+1} + c_k - c_{k-2})

Every number is an integer that float64 holds exactly (below 2^53), so the order of operations does not matter and
every machine gets the same result.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .axis import AxisStep
from .kernels import kernel

__all__ = ["CLAMP", "REACH", "TAPS", "forward_step", "inverse_step"]

#: The update's taps over 2^24: (1 - 1/sqrt 2)(2 sqrt 2 - 3)^j rounded so that they sum to 2^22.
TAPS = np.array([4913933, -843098, 144653, -24818, 4258, -731, 125, -21, 4, -1], np.float64)
REACH = len(TAPS)
#: Largest magnitude that the inverse hands on after each axis; a full decode never reaches it.
CLAMP = 2**27

_STRIP = 64  # columns worked on together: their details and nodes stay in the cache
_T0, _T1, _T2, _T3, _T4, _T5, _T6, _T7, _T8, _T9 = (float(tap) / 2**24 for tap in TAPS)
_CLAMP = float(CLAMP)
_DETAIL_CLAMP = float(2 * CLAMP)


@kernel
def _extend(rows: NDArray[np.float64], midpoints: int, table: NDArray[np.int64], width: int) -> None:
    """Fill the ten rows before and after the details, which stand from row 10 on."""
    for side in range(20):
        source, sign = table[side, 0] + 10, float(table[side, 1])
        target = side if side < 10 else midpoints + side
        for i in range(width):
            rows[target, i] = sign * rows[source, i]


@kernel
def _update(rows: NDArray[np.float64], k: int, out: NDArray[np.float64], width: int) -> None:
    """Update of node k, from details that stand from row 10 on."""
    m, p = k + 9, k + 10
    for i in range(width):
        out[i] = np.floor(
            _T0 * (rows[p, i] + rows[m, i])
            + _T1 * (rows[p + 1, i] + rows[m - 1, i])
            + _T2 * (rows[p + 2, i] + rows[m - 2, i])
            + _T3 * (rows[p + 3, i] + rows[m - 3, i])
            + _T4 * (rows[p + 4, i] + rows[m - 4, i])
            + _T5 * (rows[p + 5, i] + rows[m - 5, i])
            + _T6 * (rows[p + 6, i] + rows[m - 6, i])
            + _T7 * (rows[p + 7, i] + rows[m - 7, i])
            + _T8 * (rows[p + 8, i] + rows[m - 8, i])
            + _T9 * (rows[p + 9, i] + rows[m - 9, i])
            + 0.375
        )


@kernel
def _surround(nodes: NDArray[np.float64], run: int, wraps: bool, width: int) -> None:
    """Fill the two rows before and the three after the nodes of a run, which stand from row 2 on."""
    first, last = 2, run + 1
    for i in range(width):
        if wraps:
            nodes[1, i] = nodes[last, i]
            nodes[0, i] = nodes[last - 1, i]
            nodes[last + 1, i] = nodes[first, i]
            nodes[last + 2, i] = nodes[first + 1, i]
            nodes[last + 3, i] = nodes[first + 2, i]
        else:
            nodes[1, i] = 3.0 * nodes[first, i] - 3.0 * nodes[first + 1, i] + nodes[first + 2, i]
            nodes[0, i] = 3.0 * nodes[1, i] - 3.0 * nodes[first, i] + nodes[first + 1, i]
            nodes[last + 1, i] = 3.0 * nodes[last, i] - 3.0 * nodes[last - 1, i] + nodes[last - 2, i]
            nodes[last + 2, i] = 3.0 * nodes[last + 1, i] - 3.0 * nodes[last, i] + nodes[last - 1, i]


@kernel
def _surplus(nodes: NDArray[np.float64], k: int, a: float, b: float, out: NDArray[np.float64], width: int) -> None:
    """What the third step predicts of detail k, from nodes that stand from row 2 on."""
    j = k + 2
    for i in range(width):
        near = nodes[j, i] + nodes[j + 1, i]
        out[i] = np.floor(
            (a * (near - nodes[j - 1, i] - nodes[j + 2, i]) + b * (near - nodes[j - 2, i] - nodes[j + 3, i]) + 128.0)
            * 0.00390625
        )


@kernel
def _forward_columns(
    x: NDArray[np.int32], midpoints: int, run: int, wraps: bool, table: NDArray[np.int64], a: int, b: int
) -> None:
    """Step along axis 0 in place: nodes to the first rows, details to those after."""
    length, columns = x.shape
    coarse = length - midpoints
    predicts = run >= 3 and (a != 0 or b != 0)
    details = np.empty((midpoints + 20, _STRIP), np.float64)
    nodes = np.empty((run + 5, _STRIP), np.float64)
    work = np.empty(_STRIP, np.float64)
    tail = np.empty(_STRIP, np.int32)
    for start in range(0, columns, _STRIP):
        width = min(_STRIP, columns - start)
        for k in range(run):
            for i in range(width):
                nodes[k + 2, i] = x[2 * k, start + i]
        for k in range(midpoints):
            right = 2 if wraps and k == midpoints - 1 else k + 3
            for i in range(width):
                details[k + 10, i] = x[2 * k + 1, start + i] - np.floor((nodes[k + 2, i] + nodes[right, i]) * 0.5)
        for i in range(width):
            tail[i] = x[length - 1, start + i]
        _extend(details, midpoints, table, width)
        for k in range(run):
            _update(details, k, work, width)
            for i in range(width):
                nodes[k + 2, i] += work[i]
                x[k, start + i] = np.int32(nodes[k + 2, i])
        if run < coarse:
            for i in range(width):
                x[coarse - 1, start + i] = tail[i]
        if predicts:
            _surround(nodes, run, wraps, width)
        for k in range(midpoints):
            if predicts:
                _surplus(nodes, k, float(a), float(b), work, width)
                for i in range(width):
                    x[coarse + k, start + i] = np.int32(details[k + 10, i] - work[i])
            else:
                for i in range(width):
                    x[coarse + k, start + i] = np.int32(details[k + 10, i])


@kernel
def _inverse_columns(
    x: NDArray[np.int32], midpoints: int, run: int, wraps: bool, table: NDArray[np.int64], a: int, b: int
) -> None:
    """Undo `_forward_columns` in place."""
    length, columns = x.shape
    coarse = length - midpoints
    predicts = run >= 3 and (a != 0 or b != 0)
    details = np.empty((midpoints + 20, _STRIP), np.float64)
    nodes = np.empty((run + 5, _STRIP), np.float64)
    work = np.empty(_STRIP, np.float64)
    tail = np.empty(_STRIP, np.int32)
    for start in range(0, columns, _STRIP):
        width = min(_STRIP, columns - start)
        for k in range(run):
            for i in range(width):
                nodes[k + 2, i] = x[k, start + i]
        for i in range(width):
            tail[i] = x[coarse - 1, start + i]
        if predicts:
            _surround(nodes, run, wraps, width)
        for k in range(midpoints):
            if predicts:
                _surplus(nodes, k, float(a), float(b), work, width)
                for i in range(width):
                    detail = x[coarse + k, start + i] + work[i]
                    details[k + 10, i] = min(max(detail, -_DETAIL_CLAMP), _DETAIL_CLAMP)
            else:
                for i in range(width):
                    details[k + 10, i] = x[coarse + k, start + i]
        _extend(details, midpoints, table, width)
        for k in range(run):
            _update(details, k, work, width)
            for i in range(width):
                nodes[k + 2, i] -= work[i]
                x[2 * k, start + i] = np.int32(min(max(nodes[k + 2, i], -_CLAMP), _CLAMP))
        for k in range(midpoints):
            right = 2 if wraps and k == midpoints - 1 else k + 3
            for i in range(width):
                odd = details[k + 10, i] + np.floor((nodes[k + 2, i] + nodes[right, i]) * 0.5)
                x[2 * k + 1, start + i] = np.int32(min(max(odd, -_CLAMP), _CLAMP))
        if run < coarse:
            for i in range(width):
                x[length - 1, start + i] = np.int32(min(max(float(tail[i]), -_CLAMP), _CLAMP))


def forward_step(values: NDArray[np.int32], axis: int, step: AxisStep, predictor: tuple[int, int]) -> None:
    """One step along one axis, in place.

    Parameters
    ----------
    values : int32 array, shape (H, W), any strides
        Samples in; the coarser level's nodes first and the details after them out, along ``axis``.
    axis : 0 or 1
    step : AxisStep
        Of an axis of ``values.shape[axis]`` samples; nothing happens where it has stopped.
    predictor : (int, int)
        The third step's (a, b), at most 127 in magnitude; (0, 0) leaves the paper's bare details.
    """
    if step.midpoints:
        columns = values if axis == 0 else values.T
        _forward_columns(columns, step.midpoints, step.run, step.wraps, step.extension(REACH), *predictor)


def inverse_step(values: NDArray[np.int32], axis: int, step: AxisStep, predictor: tuple[int, int]) -> None:
    """Undo `forward_step` in place; what comes out is within +-`CLAMP`, whatever goes in."""
    if step.midpoints:
        columns = values if axis == 0 else values.T
        _inverse_columns(columns, step.midpoints, step.run, step.wraps, step.extension(REACH), *predictor)
