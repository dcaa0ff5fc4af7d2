"""Section 8 of docs/format.md: the forward and the inverse step.

Many lines go through a step together: row k of an array holds what the page calls number k of each of them, int64 of
shape (sample, line). All numbers of the page are below 2^63.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from .levels import Axis, Predictor

__all__ = ["Lines", "forward_details", "inverse"]

TAPS = [4913933, -843098, 144653, -24818, 4258, -731, 125, -21, 4, -1]
DETAIL = 2**28
SAMPLE = 2**27

Lines = NDArray[np.int64]


def _predicted(nodes: Lines, axis: Axis, predictor: Predictor) -> Lines:
    """What the nodes predict of each detail: floor((v_k + 128) / 256)."""
    run, (a, b) = axis.run, predictor
    if run < 3 or predictor == (0, 0):
        return np.zeros_like(nodes[: axis.midpoints])
    if axis.periodic:
        c = nodes[np.arange(-2, run + 3) % run]
    else:
        first, last = _extended(nodes[2::-1])[::-1], _extended(nodes[run - 3 : run])
        c = np.concatenate((first, nodes[:run], last))
    before2, before, here, after, after2, after3 = (c[2 + j : 2 + j + axis.midpoints] for j in range(-2, 4))
    v: Lines = a * (-after2 + after + here - before) + b * (-after3 + after + here - before2)
    return (v + 128) >> 8


def _extended(three: Lines) -> Lines:
    """The two nodes that follow three by quadratic extrapolation."""
    x, y, z = three
    fourth = 3 * z - 3 * y + x
    return np.stack((fourth, 3 * fourth - 3 * z + y))


@functools.cache
def _beyond(axis: Axis) -> tuple[NDArray[np.intp], Lines]:
    """Which details, and times what, are d_-10 ... d_(R + 8)."""
    found = [_inside(axis, index) for index in range(-10, axis.run + 9)]
    return np.array([index for index, _ in found]), np.array([[sign] for _, sign in found])


def _inside(axis: Axis, index: int) -> tuple[int, int]:
    """The detail of any index: which one it is, and times what."""
    count, (first, last) = axis.midpoints, axis.clamped_run
    if axis.periodic:
        return index % count, 1
    sign = 1
    while not 0 <= index < count:
        is_clamped = first if index < 0 else last
        if index in (-1, count) and not is_clamped:
            return 0, 0
        sign = -sign
        index = -2 - index + is_clamped if index < 0 else 2 * count - index - is_clamped
    return index, sign


def _update(d: Lines, axis: Axis) -> Lines:
    """floor((s_k + 3 2^21) / 2^24) for every node of the run."""
    index, sign = _beyond(axis)
    wide = d[index] * sign  # wide[10 + k] is d_k
    sums = np.zeros((axis.run, d.shape[1]), np.int64)
    for j, tap in enumerate(TAPS):
        sums += tap * (wide[10 + j : 10 + j + axis.run] + wide[9 - j : 9 - j + axis.run])
    return (sums + 3 * 2**21) >> 24


def inverse(lines: Lines, axis: Axis, predictor: Predictor) -> Lines:
    """The samples of lines that hold nodes and then details; the axis is that of the samples."""
    d = np.clip(lines[axis.nodes :] + _predicted(lines, axis, predictor), -DETAIL, DETAIL)
    nodes = lines[: axis.run] - _update(d, axis)
    samples = np.zeros_like(lines)
    samples[0 : 2 * axis.run : 2] = nodes
    samples[1 : 2 * axis.midpoints : 2] = d + ((nodes + np.roll(nodes, -1, axis=0))[: axis.midpoints] >> 1)
    if axis.nodes > axis.run:
        samples[-1] = lines[axis.run]
    return np.clip(samples, -SAMPLE, SAMPLE)


def forward_details(samples: Lines, axis: Axis, predictor: Predictor) -> Lines:
    """The details of lines of samples."""
    x = np.concatenate([samples[: 2 * axis.run], samples[:1]])
    even, odd = x[0::2], x[1::2][: axis.midpoints]
    d = odd - ((even[: axis.midpoints] + even[1 : axis.midpoints + 1]) >> 1)
    nodes = even[: axis.run] + _update(d, axis)
    found: Lines = d - _predicted(nodes, axis, predictor)
    return found
