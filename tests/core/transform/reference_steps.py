"""The steps of the reference decoder, by the ends of an axis, and all levels of a grid by these steps.

int64 holds all of its sums, for any coefficients of 28 bits: taps have 23 bits, and twenty of them are added up.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tests.reference import lifting
from tests.reference.levels import Axis

__all__ = ["CLOSED", "FREE", "Ends", "coarse", "forward", "forward_grid", "inverse", "inverse_grid", "shapes"]

Lines = NDArray[np.int64]


class Ends(NamedTuple):
    """How an axis ends; ``left`` and ``right`` say whether that end is clamped."""

    closed: bool = False
    left: bool = False
    right: bool = False


FREE, CLOSED = Ends(), Ends(closed=True)


def axis_of(length: int, ends: Ends) -> Axis:
    return Axis(length, ends.closed, (ends.left, ends.right))


def coarse(length: int, closed: bool) -> int:
    """Nodes of an axis."""
    axis = Axis(length, closed)
    return axis.nodes if axis.steps(False) else length


def forward(lines: NDArray[Any], ends: Ends, a: int, b: int) -> Lines:
    """One step along axis 0: nodes first, then details."""
    samples, axis = lines.astype(np.int64), axis_of(len(lines), ends)
    return lifting.forward(samples, axis, (a, b)) if axis.steps(False) else samples


def inverse(lines: NDArray[Any], ends: Ends, a: int, b: int) -> Lines:
    """Undo `forward`, with the limits of a reader."""
    coefficients, axis = lines.astype(np.int64), axis_of(len(lines), ends)
    return lifting.inverse(coefficients, axis, (a, b)) if axis.steps(False) else coefficients


def shapes(shape: tuple[int, int], closed: tuple[bool, bool]) -> list[tuple[int, int]]:
    """Shapes of all levels, coarsest first."""
    found = [shape]
    while (smaller := (coarse(found[-1][0], closed[0]), coarse(found[-1][1], closed[1]))) != found[-1]:
        found.append(smaller)
    return found[::-1]


def forward_grid(values: NDArray[Any], closed: tuple[bool, bool], predictors: Any) -> Lines:
    """All levels of a grid, each in the first rows and columns; ``predictors[level][axis]`` is (a, b)."""
    x = values.astype(np.int64)
    levels = shapes((x.shape[0], x.shape[1]), closed)
    for level in range(len(levels) - 1, 0, -1):
        _step(forward, x, levels[level], closed, predictors[level - 1], (0, 1))
    return x


def inverse_grid(values: NDArray[Any], closed: tuple[bool, bool], predictors: Any) -> Lines:
    """Undo `forward_grid`."""
    x = values.astype(np.int64)
    for level, shape in enumerate(shapes((x.shape[0], x.shape[1]), closed)[1:]):
        _step(inverse, x, shape, closed, predictors[level], (1, 0))
    return x


def _step(
    step: Any, x: Lines, shape: tuple[int, int], closed: tuple[bool, bool], predictors: Any, axes: tuple[int, int]
) -> None:
    for axis in axes:
        corner = x[: shape[0], : shape[1]] if axis == 0 else x[: shape[0], : shape[1]].T
        corner[:] = step(corner, Ends(closed[axis]), *(int(n) for n in predictors[axis]))
