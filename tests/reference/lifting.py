"""Lifting steps along an axis, forward and inverse: section 8 of docs/format.md."""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .levels import Axis

Lines = NDArray[np.int64]

H = (4913933, -843098, 144653, -24818, 4258, -731, 125, -21, 4, -1)
REACH = len(H)
LIMIT = 1 << 28


def _periodic(axis: Axis) -> bool:
    return axis.closed and axis.samples % 2 == 0


@lru_cache(maxsize=256)
def _beyond(axis: Axis) -> tuple[Lines, Lines]:
    """Give index and sign of d_{-10} ... d_{M+9}; int64 (M + 20,) each, the sign 0 where d is 0."""
    count = axis.midpoints
    index = np.arange(-REACH, count + REACH)
    if _periodic(axis):
        return index % count, np.ones_like(index)
    # An odd sequence about both ends has a period. Free ends have a zero one place outside; clamped ends lie between.
    first = axis.clamped[0] and not axis.closed
    last = axis.clamped[1] and not axis.closed and not axis.extra
    sign = np.ones_like(index)
    while True:
        before, after = index < 0, index >= count
        if not (before | after).any():
            return index, sign
        if not first:
            sign[index == -1] = 0
        if not last:
            sign[index == count] = 0
        index = np.where(
            before, (-1 if first else -2) - index, np.where(after, 2 * count - (1 if last else 0) - index, index)
        )
        sign = np.where(before | after, -sign, sign)
        index[sign == 0] = 0


def _predicted(nodes: Lines, axis: Axis, pair: tuple[int, int]) -> Lines | int:
    """Give floor((v + 128) / 256) of the nodes c_0 ... c_{R-1}; int64 (M, lines), or 0 where nothing is predicted."""
    a, b = pair
    run, count = axis.run, axis.midpoints
    if run < 3 or (a, b) == (0, 0):
        return 0
    if _periodic(axis):
        c = nodes[np.arange(-2, run + 3) % run]
    else:
        c = np.empty((run + 5, *nodes.shape[1:]), np.int64)
        c[2 : run + 2] = nodes
        for near, step in ((1, 1), (0, 1), (run + 2, -1), (run + 3, -1), (run + 4, -1)):
            c[near] = 3 * c[near + step] - 3 * c[near + 2 * step] + c[near + 3 * step]
    at = [c[shift : shift + count] for shift in range(6)]
    v = a * (at[3] + at[2] - at[4] - at[1]) + b * (at[3] + at[2] - at[5] - at[0])
    return (v + 128) >> 8


def _update(d: Lines, axis: Axis) -> Lines:
    """Give floor((s_k + 3 2^21) / 2^24) of the details before prediction; int64 (R, lines)."""
    run = axis.run
    index, sign = _beyond(axis)
    wide = d[index] * sign[:, None]
    s = np.full((run, *d.shape[1:]), 3 << 21, np.int64)
    for j, h in enumerate(H):
        s += h * (wide[REACH + j : REACH + j + run] + wide[REACH - 1 - j : REACH - 1 - j + run])
    return s >> 24


def _right(x: Lines, axis: Axis) -> Lines:
    """Give the node to the right of each midpoint; int64 (M, lines)."""
    count = axis.midpoints
    return np.concatenate([x[1:], x[:1]]) if _periodic(axis) else x[1 : count + 1]


def inverse(values: Lines, axis: Axis, pair: tuple[int, int]) -> Lines:
    """Compute samples from nodes and details.

    `values` (int64 (samples, lines)): nodes and then details along the first axis; `axis` (Axis): the axis at the finer
    level; `pair` ((int, int)): the step's (a, b). Returns int64 (samples, lines): the samples, clamped.
    """
    run, count = axis.run, axis.midpoints
    c = values[:run]
    d = np.clip(values[axis.nodes :] + _predicted(c, axis, pair), -LIMIT, LIMIT)
    even = c - _update(d, axis)
    x = np.empty_like(values)
    x[0 : 2 * run : 2] = even
    x[1 : 2 * count : 2] = d + ((even[:count] + _right(even, axis)) >> 1)
    if axis.extra:
        x[-1] = values[run]
    return np.clip(x, -LIMIT // 2, LIMIT // 2)


def forward(samples: Lines, axis: Axis, pair: tuple[int, int]) -> Lines:
    """Compute nodes and then details along the first axis; undoes `inverse`. int64 (samples, lines)."""
    nodes, d = _forward(samples, axis)
    extra = samples[-1:] if axis.extra else samples[:0]
    return np.concatenate([nodes, extra, d - _predicted(nodes, axis, pair)])


def details(samples: Lines, axis: Axis, pair: tuple[int, int]) -> Lines:
    """Compute the details of the forward step; int64 (samples, lines) to int64 (M, lines)."""
    nodes, d = _forward(samples, axis)
    return d - _predicted(nodes, axis, pair)


def _forward(samples: Lines, axis: Axis) -> tuple[Lines, Lines]:
    run, count = axis.run, axis.midpoints
    even = samples[0 : 2 * run : 2]
    d = samples[1 : 2 * count : 2] - ((even[:count] + _right(even, axis)) >> 1)
    return even + _update(d, axis), d
