"""The integer lifting written from its formulas, a line at a time, with nothing of the package in it.

Arrays of int64, or of Python's own integers (dtype object) where nothing at all may overflow. Axis 0 is the line, the
other axis holds lines that go through the same step.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np

__all__ = ["CLOSED", "FREE", "Ends", "coarse", "forward", "forward_grid", "inverse", "inverse_grid"]

Lines: TypeAlias = Any  # an array of int64 or of objects

TAPS = [4913933, -843098, 144653, -24818, 4258, -731, 125, -21, 4, -1]
LARGEST_POINT = 2**27
LARGEST_DETAIL = 2**28


class Ends(NamedTuple):
    """How an axis ends; ``left`` and ``right`` say whether that end is clamped."""

    closed: bool = False
    left: bool = False
    right: bool = False


FREE, CLOSED = Ends(), Ends(closed=True)


def coarse(length: int, closed: bool) -> int:
    """Nodes of an axis, by the rules of "Ends"."""
    if closed:
        return length if length < 5 else length // 2 if length % 2 == 0 else (length + 1) // 2
    return length if length < 3 else length // 2 + 1


def _run(length: int, ends: Ends) -> tuple[int, Ends]:
    """Samples before the gap, and the ends of these."""
    if ends.closed:
        return length, ends if length % 2 == 0 else FREE
    return (length, ends) if length % 2 else (length - 1, Ends(left=ends.left))


def _detail(d: Lines, k: int, ends: Ends) -> Lines:
    """d_k, also beyond the ends."""
    count, sign = len(d), 1
    if ends.closed:
        return d[k % count]
    while not 0 <= k < count:
        if k < 0 and ends.left:
            k = -1 - k
        elif k < 0:
            if k == -1:
                return d[0] * 0
            k = -2 - k
        elif ends.right:
            k = 2 * count - 1 - k
        else:
            if k == count:
                return d[0] * 0
            k = 2 * count - k
        sign = -sign
    return sign * d[k]


def _updates(d: Lines, nodes: int, ends: Ends) -> Lines:
    """floor(s + 3/8) for every node."""
    around = {k: _detail(d, k, ends) for k in range(-len(TAPS), nodes + len(TAPS))}
    sums = [sum(h * (around[k + j] + around[k - 1 - j]) for j, h in enumerate(TAPS)) for k in range(nodes)]
    return np.array([(s + 3 * 2**21) // 2**24 for s in sums], dtype=d.dtype)


def _surplus(c: Lines, details: int, ends: Ends, a: int, b: int) -> Lines:
    """floor((v_k + 128) / 256) for every detail."""
    count = len(c)
    if count < 3 or (a, b) == (0, 0):
        return np.zeros((details, *c.shape[1:]), c.dtype)
    node = {k: c[k] for k in range(count)}
    if ends.closed:
        node |= {k: c[k % count] for k in (-2, -1, count, count + 1, count + 2)}
    else:
        for k in (-1, -2):
            node[k] = 3 * node[k + 1] - 3 * node[k + 2] + node[k + 3]
        for k in (count, count + 1):
            node[k] = 3 * node[k - 1] - 3 * node[k - 2] + node[k - 3]
    rows = []
    for k in range(details):
        near = node[k] + node[k + 1]
        v = a * (near - node[k - 1] - node[k + 2]) + b * (near - node[k - 2] - node[k + 3])
        rows.append((v + 128) // 256)
    return np.array(rows, dtype=c.dtype)


def forward(x: Lines, ends: Ends, a: int, b: int) -> Lines:
    """One step: nodes first, then details (less what the third step predicts of them)."""
    if coarse(len(x), ends.closed) == len(x):
        return x.copy()
    run, inner = _run(len(x), ends)
    even, odd, tail = x[:run:2], x[1:run:2], x[run:]
    after = np.concatenate([even[1:], even[:1]])[: len(odd)]
    d = odd - (even[: len(odd)] + after) // 2
    c = even + _updates(d, len(even), inner)
    return np.concatenate([c, tail, d - _surplus(c, len(d), inner, a, b)])


def inverse(coefficients: Lines, ends: Ends, a: int, b: int) -> Lines:
    """Undo `forward`; with the limits of a reader, which matter for coefficients that no writer makes."""
    length = len(coefficients)
    nodes = coarse(length, ends.closed)
    if nodes == length:
        return coefficients.copy()
    run, inner = _run(length, ends)
    c, tail, e = coefficients[: (run + 1) // 2], coefficients[(run + 1) // 2 : nodes], coefficients[nodes:]
    d = np.clip(e + _surplus(c, len(e), inner, a, b), -LARGEST_DETAIL, LARGEST_DETAIL)
    even = c - _updates(d, len(c), inner)
    x = np.empty_like(coefficients)
    # The limit comes last: a midpoint is predicted from its nodes before these are limited.
    after = np.concatenate([even[1:], even[:1]])[: len(d)]
    x[:run:2], x[1:run:2], x[run:] = even, d + (even[: len(d)] + after) // 2, tail
    return np.clip(x, -LARGEST_POINT, LARGEST_POINT)


def shapes(shape: tuple[int, int], closed: tuple[bool, bool]) -> list[tuple[int, int]]:
    """Shapes of all levels, coarsest first."""
    found = [shape]
    while (smaller := (coarse(found[-1][0], closed[0]), coarse(found[-1][1], closed[1]))) != found[-1]:
        found.append(smaller)
    return found[::-1]


def forward_grid(x: Lines, closed: tuple[bool, bool], predictors: Any) -> Lines:
    """All levels of a grid, each in the first rows and columns; ``predictors[level][axis]`` is (a, b)."""
    x = x.copy()
    levels = shapes((x.shape[0], x.shape[1]), closed)
    for level in range(len(levels) - 1, 0, -1):
        rows, columns = levels[level]
        for axis in (0, 1):
            corner = x[:rows, :columns] if axis == 0 else x[:rows, :columns].T
            a, b = (int(n) for n in predictors[level - 1][axis])
            corner[:] = forward(corner, Ends(closed[axis]), a, b)
    return x


def inverse_grid(x: Lines, closed: tuple[bool, bool], predictors: Any) -> Lines:
    """Undo `forward_grid`."""
    x = x.copy()
    for level, (rows, columns) in enumerate(shapes((x.shape[0], x.shape[1]), closed)[1:]):
        for axis in (1, 0):
            corner = x[:rows, :columns] if axis == 0 else x[:rows, :columns].T
            a, b = (int(n) for n in predictors[level][axis])
            corner[:] = inverse(corner, Ends(closed[axis]), a, b)
    return x
