"""The optimal hierarchy as a lifting scheme on integers: forward and inverse, exactly.

One step along one axis turns samples x into nodes c and details e (the formulas and their proofs are in
``docs/mathematics.md``; Chung, Yan and Wu 2002 give the least-squares optimum that c is)::

    d_k = x_{2k+1} - floor((x_{2k} + x_{2k+2}) / 2)                        predict
    c_k = x_{2k} + floor(2^-24 sum_j h_j (d_{k+j} + d_{k-1-j}) + 3/8)      update: the optimum
    e_k = d_k - floor((v_k + 128) / 256)                                   predict again, from c
    v_k = a (-c_{k+2} + c_{k+1} + c_k - c_{k-1}) + b (-c_{k+3} + c_{k+1} + c_k - c_{k-2})

Every number is an integer that float64 holds exactly (below 2^53), so the order of operations does not matter and
every machine gets the same result. Samples, nodes and details are int32 throughout; the two sums are taken in int32
where their terms are so small that nothing can overflow (nearly always), and in float64 otherwise.

Samples of an axis are worked on in buffers of their own, in which neighbours along the axis stand ``gap`` apart: 1 for
a row, `_STRIP` for a strip of columns side by side. Nodes begin at 2 ``gap`` there and details at 10 ``gap``; ``wide``
is room for a buffer in float64. A closed run of even length has as many midpoints as nodes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .axis import AxisStep
from .numba_kernels import bare_kernel, inlined

__all__ = ["CLAMP", "FRACTION_BITS", "REACH", "TAPS", "forward_step", "inverse_step"]

#: The update's taps over 2^24: (1 - 1/sqrt 2)(2 sqrt 2 - 3)^j rounded so that they sum to 2^22.
TAPS = np.array([4913933, -843098, 144653, -24818, 4258, -731, 125, -21, 4, -1], np.float64)
REACH = len(TAPS)
#: Largest magnitude that the inverse hands on after each axis; a full decode never reaches it.
CLAMP = 2**27
#: Binary places between lattice steps in which reconstructions of incomplete levels are computed.
FRACTION_BITS = 3

_STRIP = 64  # columns worked on together
_i32 = np.int32
_CLAMP = _i32(CLAMP)
_DETAIL_CLAMP = _i32(2 * CLAMP)
_ANY = _i32(2**31 - 1)
_T0, _T1, _T2, _T3, _T4, _T5, _T6, _T7, _T8, _T9 = (float(tap) / 2**24 for tap in TAPS)
# h_j = 2048 high_j + low_j: the magnitudes of the halves sum to 2896 and 3500, so that neither weighted sum of details
# of at most 2^18 leaves int32 (2 * 3500 * 2^18 + 3/8 2^24 < 2^31).
_H0, _H1, _H2, _H3, _H4 = (_i32(round(tap / 2048)) for tap in TAPS[:5])
_L0, _L1, _L2, _L3, _L4 = (_i32(tap - 2048 * round(tap / 2048)) for tap in TAPS[:5])
_L5, _L6, _L7, _L8, _L9 = (_i32(tap) for tap in TAPS[5:])
_SMALL = 2**18
_BIAS = _i32(3 * 2**21)


@bare_kernel
def _magnitude(values: NDArray[np.int32]) -> int:
    """Something at least as large as every magnitude, and less than twice the largest."""
    bits = _i32(0)
    for i in range(values.size):
        bits = _i32(bits | values[i] ^ (values[i] >> 31))
    return int(bits) + 1


@bare_kernel
def _rise(nodes: NDArray[np.int32], gap: int) -> int:
    """Something at least as large as every difference of neighbours along the axis, see `_magnitude`."""
    bits = _i32(0)
    for i in range(nodes.size - gap):
        rise = _i32(nodes[i + gap] - nodes[i])
        bits = _i32(bits | rise ^ (rise >> 31))
    return int(bits) + 1


@bare_kernel
def _copy(source: NDArray[np.int32], target: NDArray[np.int32]) -> None:
    for i in range(target.size):
        target[i] = source[i]


@bare_kernel
def _clamp(values: NDArray[np.int32]) -> None:
    for i in range(values.size):
        values[i] = min(max(values[i], -_CLAMP), _CLAMP)


@bare_kernel
def _move(outside: NDArray[np.int32], inside: NDArray[np.int32], loads: bool) -> None:
    if loads:
        _copy(outside, inside)
    else:
        _copy(inside, outside)


@bare_kernel
def _extend(details: NDArray[np.int32], midpoints: int, table: NDArray[np.int64], gap: int) -> None:
    """Fill the ten places before and after the details."""
    for side in range(20):
        source, sign = (table[side, 0] + 10) * gap, table[side, 1]
        target = (side if side < 10 else midpoints + side) * gap
        for i in range(gap):
            details[target + i] = sign * details[source + i]


@bare_kernel
def _update(
    details: NDArray[np.int32], nodes: NDArray[np.int32], wide: NDArray[np.float64], run: int, sign: int, gap: int
) -> None:
    """Add ``sign`` times the update to the nodes."""
    count = run * gap
    d = details[: count + 19 * gap]
    c = nodes[2 * gap : count + 2 * gap]
    if _magnitude(d) <= _SMALL:
        for i in range(count):
            s0 = _i32(d[i + 10 * gap] + d[i + 9 * gap])
            s1 = _i32(d[i + 11 * gap] + d[i + 8 * gap])
            s2 = _i32(d[i + 12 * gap] + d[i + 7 * gap])
            s3 = _i32(d[i + 13 * gap] + d[i + 6 * gap])
            s4 = _i32(d[i + 14 * gap] + d[i + 5 * gap])
            s5 = _i32(d[i + 15 * gap] + d[i + 4 * gap])
            s6 = _i32(d[i + 16 * gap] + d[i + 3 * gap])
            s7 = _i32(d[i + 17 * gap] + d[i + 2 * gap])
            s8 = _i32(d[i + 18 * gap] + d[i + 1 * gap])
            s9 = _i32(d[i + 19 * gap] + d[i])
            high = _i32(_H0 * s0 + _H1 * s1 + _H2 * s2 + _H3 * s3 + _H4 * s4)
            low = _i32(_L0 * s0 + _L1 * s1 + _L2 * s2 + _L3 * s3 + _L4 * s4 + _L5 * s5 + _L6 * s6 + _L7 * s7)
            low = _i32(low + _L8 * s8 + _L9 * s9 + _BIAS)
            c[i] += sign * (_i32(high + (low >> 11)) >> 13)
    else:
        w = wide[: d.size]
        for i in range(d.size):
            w[i] = d[i]
        for i in range(count):
            total = (
                _T0 * (w[i + 10 * gap] + w[i + 9 * gap])
                + _T1 * (w[i + 11 * gap] + w[i + 8 * gap])
                + _T2 * (w[i + 12 * gap] + w[i + 7 * gap])
                + _T3 * (w[i + 13 * gap] + w[i + 6 * gap])
                + _T4 * (w[i + 14 * gap] + w[i + 5 * gap])
                + _T5 * (w[i + 15 * gap] + w[i + 4 * gap])
                + _T6 * (w[i + 16 * gap] + w[i + 3 * gap])
                + _T7 * (w[i + 17 * gap] + w[i + 2 * gap])
                + _T8 * (w[i + 18 * gap] + w[i + 1 * gap])
                + _T9 * (w[i + 19 * gap] + w[i])
            )
            c[i] += sign * _i32(np.floor(total + 0.375))


@bare_kernel
def _surround(nodes: NDArray[np.int32] | NDArray[np.float64], run: int, wraps: bool, gap: int) -> None:
    """Fill the two places before and the three after the nodes of a run."""
    first, last = 2 * gap, (run + 1) * gap
    for i in range(gap):
        p, q = first + i, last + i
        if wraps:
            nodes[p - gap] = nodes[q]
            nodes[p - 2 * gap] = nodes[q - gap]
            nodes[q + gap] = nodes[p]
            nodes[q + 2 * gap] = nodes[p + gap]
            nodes[q + 3 * gap] = nodes[p + 2 * gap]
        else:
            nodes[p - gap] = 3 * nodes[p] - 3 * nodes[p + gap] + nodes[p + 2 * gap]
            nodes[p - 2 * gap] = 3 * nodes[p - gap] - 3 * nodes[p] + nodes[p + gap]
            nodes[q + gap] = 3 * nodes[q] - 3 * nodes[q - gap] + nodes[q - 2 * gap]
            nodes[q + 2 * gap] = 3 * nodes[q + gap] - 3 * nodes[q] + nodes[q - gap]


@bare_kernel
def _surplus(
    nodes: NDArray[np.int32],
    details: NDArray[np.int32],
    wide: NDArray[np.float64],
    midpoints: int,
    run: int,
    a: int,
    b: int,
    sign: int,
    gap: int,
) -> None:
    """Add ``sign`` times what the third step predicts to the details; where that undoes it, clamp them."""
    count = midpoints * gap
    n = nodes[: (run + 5) * gap]
    d = details[10 * gap : count + 10 * gap]
    a32, b32, sign32 = _i32(a), _i32(b), _i32(sign)
    highest = _DETAIL_CLAMP if sign > 0 else _ANY
    lowest = _i32(-highest)
    _surround(n, run, midpoints == run, gap)
    # Sums modulo 2**32 are right where v fits int32: two rises make up an inner sum, four an outer. A rise beyond an
    # end is at most five times as large as those inside, so that none has left int32 where all are below 2**28.
    if _rise(n[: count + 5 * gap], gap) * max(2 * abs(a) + 4 * abs(b), 8) < 2**31 - 128:
        for i in range(count):
            near = _i32(n[i + 2 * gap] + n[i + 3 * gap])
            inner = _i32(near - n[i + gap] - n[i + 4 * gap])
            outer = _i32(near - n[i] - n[i + 5 * gap])
            v = _i32(a32 * inner + b32 * outer + 128)
            e = _i32(d[i] + sign32 * (v >> 8))
            d[i] = min(max(e, lowest), highest)
    else:
        w = wide[: n.size]
        for i in range(n.size):
            w[i] = n[i]
        _surround(w, run, midpoints == run, gap)
        for i in range(count):
            near = w[i + 2 * gap] + w[i + 3 * gap]
            v = a * (near - w[i + gap] - w[i + 4 * gap]) + b * (near - w[i] - w[i + 5 * gap])
            f = d[i] + sign * np.floor((v + 128.0) * 0.00390625)
            d[i] = _i32(min(max(f, float(lowest)), float(highest)))


@bare_kernel
def _predict(
    nodes: NDArray[np.int32], details: NDArray[np.int32], midpoints: int, run: int, sign: int, gap: int
) -> None:
    """Add ``sign`` times the means of neighbouring nodes to the details; where that undoes it, clamp both."""
    count = midpoints * gap
    n = nodes[2 * gap : (run + 3) * gap]
    d = details[10 * gap : count + 10 * gap]
    if midpoints == run:
        _copy(n[:gap], n[run * gap : (run + 1) * gap])
    if sign < 0:
        for i in range(count):
            d[i] -= _i32(n[i] + n[i + gap]) >> 1
    else:
        for i in range(count):
            d[i] += _i32(n[i] + n[i + gap]) >> 1
        _clamp(d)
        _clamp(n[: run * gap])


@bare_kernel
def _lift(
    nodes: NDArray[np.int32],
    details: NDArray[np.int32],
    wide: NDArray[np.float64],
    midpoints: int,
    run: int,
    table: NDArray[np.int64],
    a: int,
    b: int,
    inverse: bool,
    gap: int,
) -> None:
    """The three steps on samples that are in the buffers, or all of them undone."""
    for turn in range(3):
        step = 2 - turn if inverse else turn
        if step == 0:
            _predict(nodes, details, midpoints, run, 1 if inverse else -1, gap)
        elif step == 1:
            _extend(details, midpoints, table, gap)
            _update(details, nodes, wide, run, -1 if inverse else 1, gap)
        elif run >= 3 and (a != 0 or b != 0):
            _surplus(nodes, details, wide, midpoints, run, a, b, 1 if inverse else -1, gap)


@bare_kernel
def _step_columns(
    x: NDArray[np.int32],
    pitch: int,
    columns: int,
    length: int,
    midpoints: int,
    run: int,
    table: NDArray[np.int64],
    a: int,
    b: int,
    inverse: bool,
    nodes: NDArray[np.int32],
    details: NDArray[np.int32],
    wide: NDArray[np.float64],
    tail: NDArray[np.int32],
) -> None:
    """Step along columns in place: nodes to the first rows, details to those after, or back.

    The last four are room to work in, see `_step`.
    """
    coarse = length - midpoints
    for start in range(0, columns, _STRIP):
        width = min(_STRIP, columns - start)
        for loads in (True, False):
            split = loads == inverse
            last = start + ((coarse if split else length) - 1) * pitch
            if run < coarse:
                _move(x[last : last + width], tail[:width], loads)
            for k in range(run):
                at, p = start + (k if split else 2 * k) * pitch, (k + 2) * _STRIP
                _move(x[at : at + width], nodes[p : p + width], loads)
            for k in range(midpoints):
                at, p = start + (coarse + k if split else 2 * k + 1) * pitch, (k + 10) * _STRIP
                _move(x[at : at + width], details[p : p + width], loads)
            if loads:
                _lift(nodes, details, wide, midpoints, run, table, a, b, inverse, _STRIP)
                if inverse:
                    _clamp(tail)


@inlined
def _nothing(line: NDArray[np.int32]) -> bool:
    """Whether a row holds zeros only."""
    found = line[0]
    if found == 0:
        for k in range(line.size):
            found |= line[k]
    return bool(found == 0)


@bare_kernel
def _step_rows(
    x: NDArray[np.int32],
    pitch: int,
    rows: int,
    length: int,
    midpoints: int,
    run: int,
    table: NDArray[np.int64],
    a: int,
    b: int,
    inverse: bool,
    nodes: NDArray[np.int32],
    details: NDArray[np.int32],
    wide: NDArray[np.float64],
    tail: NDArray[np.int32],
) -> None:
    """Step along rows in place, see `_step_columns`."""
    coarse = length - midpoints
    n, d = nodes[2 : run + 2], details[10 : midpoints + 10]
    for row in range(rows):
        line = x[row * pitch : row * pitch + length]
        if _nothing(line):
            continue  # and so are zeros: of a picture on its way, many rows of details
        tail[0] = line[(coarse if inverse else length) - 1]
        if inverse:
            _clamp(tail)
            _copy(line[:run], n)
            _copy(line[coarse:], d)
        else:
            for k in range(midpoints):
                n[k] = line[2 * k]
                d[k] = line[2 * k + 1]
            n[run - 1] = line[2 * run - 2]
        _lift(nodes, details, wide, midpoints, run, table, a, b, inverse, 1)
        if inverse:
            for k in range(midpoints):
                line[2 * k] = n[k]
                line[2 * k + 1] = d[k]
            line[2 * run - 2] = n[run - 1]
        else:
            _copy(n, line[:run])
            _copy(d, line[coarse:])
        if run < coarse:
            line[(length if inverse else coarse) - 1] = tail[0]


def forward_step(values: NDArray[np.int32], axis: int, step: AxisStep, predictor: tuple[int, int]) -> None:
    """One step along one axis, in place.

    Parameters
    ----------
    values : int32 array, shape (H, W)
        Samples in; the coarser level's nodes first and the details after them out, along ``axis``.
    axis : 0 or 1
    step : AxisStep
        Of an axis of ``values.shape[axis]`` samples; nothing happens where it has stopped.
    predictor : (int, int)
        The third step's (a, b), at most 127 in magnitude; (0, 0) leaves the paper's bare details.
    """
    _step(values, axis, step, predictor, False)


def inverse_step(values: NDArray[np.int32], axis: int, step: AxisStep, predictor: tuple[int, int]) -> None:
    """Undo `forward_step` in place; what comes out is within +-`CLAMP`, for any magnitudes below 2^29."""
    _step(values, axis, step, predictor, True)


def _step(values: NDArray[np.int32], axis: int, step: AxisStep, predictor: tuple[int, int], inverse: bool) -> None:
    if not step.midpoints:
        return
    rows, columns = values.shape
    if axis == 0 and columns < _STRIP // 4:
        # Too few columns to fill a strip: each is a row of its own.
        lines = values.T.copy(order="C")
        _step(lines, 1, step, predictor, inverse)
        values[...] = lines.T
        return
    if values.strides[1] != values.itemsize or values.strides[0] < 0:
        packed = values.copy(order="C")
        _step(packed, axis, step, predictor, inverse)
        values[...] = packed
        return
    pitch = values.strides[0] // values.itemsize
    flat = values.reshape(-1) if pitch == columns else _from_first_to_last(values, (rows - 1) * pitch + columns)
    kernel_of_axis, across, gap = (_step_columns, columns, _STRIP) if axis == 0 else (_step_rows, rows, 1)
    nodes, details = (np.zeros(count * gap, np.int32) for count in (step.run + 5, step.midpoints + 20))
    wide, tail = np.empty(max(nodes.size, details.size), np.float64), np.zeros(gap, np.int32)
    numbers = step.length, step.midpoints, step.run
    table = step.extension(REACH)
    kernel_of_axis(flat, pitch, across, *numbers, table, *predictor, inverse, nodes, details, wide, tail)


def _from_first_to_last(values: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """All from the first value of an array to the last, what lies between its rows included."""
    around = values.base
    if isinstance(around, np.ndarray) and around.flags.c_contiguous and around.dtype == values.dtype:
        # A window of a larger array, as nearly always: ten times as fast as what serves any array.
        first, start = (array.__array_interface__["data"][0] for array in (values, around))
        place = (first - start) // values.itemsize
        found: NDArray[np.int32] = around.reshape(-1)[place : place + count]
        return found
    return np.lib.stride_tricks.as_strided(values, (count,), (values.itemsize,))
