"""Section 8 of the page: a step of lines, and the way back.

Many lines go through a step together: row k of an array holds what the page calls the number k of each of them. All
numbers of the page are below 2^63.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from tests.stranger.layout import Predictor, Step
from tests.stranger.tables import TAPS

DETAIL = 2**28
SAMPLE = 2**27

Lines = NDArray[np.int64]


def _predicted(nodes: Lines, step: Step, predictor: Predictor) -> Lines:
    """What the nodes predict of each detail: floor((v_k + 128) / 256)."""
    run, (a, b) = step.run, predictor
    if run < 3 or predictor == (0, 0):
        return np.zeros_like(nodes[: step.midpoints])
    c = dict(enumerate(nodes[:run]))
    if step.periodic:
        for k in (-2, -1, run, run + 1, run + 2):
            c[k] = nodes[k % run]
    else:
        for k in (-1, -2):
            c[k] = 3 * c[k + 1] - 3 * c[k + 2] + c[k + 3]
        for k in (run, run + 1):
            c[k] = 3 * c[k - 1] - 3 * c[k - 2] + c[k - 3]
    wide = np.stack([c[k] for k in sorted(c)])
    before2, before, here, after, after2, after3 = (wide[2 + j : 2 + j + step.midpoints] for j in range(-2, 4))
    v: Lines = a * (-after2 + after + here - before) + b * (-after3 + after + here - before2)
    return (v + 128) >> 8


@functools.cache
def _beyond(step: Step) -> tuple[NDArray[np.intp], Lines]:
    """Which details, and times what, are d_-10 ... d_(R + 8)."""
    found = [_inside(step, index) for index in range(-10, step.run + 9)]
    return np.array([index for index, _ in found]), np.array([[sign] for _, sign in found])


def _inside(step: Step, index: int) -> tuple[int, int]:
    """The detail at any index: which one it is, and times what."""
    count, (first, last) = step.midpoints, step.clamped_run
    if step.periodic:
        return index % count, 1
    sign = 1
    while not 0 <= index < count:
        is_clamped = first if index < 0 else last
        if index in (-1, count) and not is_clamped:
            return 0, 0
        sign = -sign
        if index < 0:
            index = -1 - index if is_clamped else -2 - index
        else:
            index = 2 * count - 1 - index + (0 if is_clamped else 1)
    return index, sign


def _update(d: Lines, step: Step) -> Lines:
    """floor((s_k + 3 2^21) / 2^24) for every node of the run."""
    index, sign = _beyond(step)
    wide = d[index] * sign  # wide[10 + k] is d_k
    sums = np.zeros((step.run, d.shape[1]), np.int64)
    for j, tap in enumerate(TAPS):
        sums += tap * (wide[10 + j : 10 + j + step.run] + wide[9 - j : 9 - j + step.run])
    return (sums + 3 * 2**21) >> 24


def undo(lines: Lines, step: Step, predictor: Predictor) -> Lines:
    """Undoes a step on lines of nodes and then details."""
    predicted = _predicted(lines, step, predictor)
    d = np.clip(lines[step.nodes :] + predicted, -DETAIL, DETAIL)
    nodes = lines[: step.run] - _update(d, step)
    samples = np.zeros_like(lines)
    samples[0 : 2 * step.run : 2] = nodes
    samples[1 : 2 * step.midpoints : 2] = d + ((nodes + np.roll(nodes, -1, axis=0))[: step.midpoints] >> 1)
    if step.nodes > step.run:
        samples[-1] = lines[step.run]
    return np.clip(samples, -SAMPLE, SAMPLE)


def details(samples: Lines, step: Step, predictor: Predictor) -> Lines:
    """The details of a step on lines of samples."""
    x = np.concatenate([samples[: 2 * step.run], samples[:1]])
    even, odd = x[0::2], x[1::2][: step.midpoints]
    d = odd - ((even[: step.midpoints] + even[1 : step.midpoints + 1]) >> 1)
    nodes = even[: step.run] + _update(d, step)
    found: Lines = d - _predicted(nodes, step, predictor)
    return found
