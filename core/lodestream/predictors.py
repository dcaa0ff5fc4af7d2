"""The third step of the lifting as the format sees it: which steps have an (a, b) of their own, which a common one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .layout import Layout

__all__ = ["COEFFICIENT_BITS", "FIT_NODES", "FOUR_POINT", "default_predictors", "fitted_steps"]

#: A coefficient has at most so many magnitude bits.
COEFFICIENT_BITS = 28
#: The third step where the axis is too short to fit one: the four-point rule.
FOUR_POINT = (16, 0)
#: Nodes that an axis needs for an (a, b) of its own.
FIT_NODES = 24


def fitted_steps(layout: Layout) -> list[tuple[int, int]]:
    """(coarser level, axis) of every step along an axis that is long enough for an (a, b) of its own."""
    return [
        (level, axis)
        for level in range(layout.levels)
        for axis, step in enumerate(layout.steps(level + 1))
        if step.midpoints and step.run >= FIT_NODES
    ]


def default_predictors(layout: Layout) -> NDArray[np.int8]:
    """The (a, b) that no container carries: the four-point rule on short axes, (0, 0) where one may be fitted."""
    predictors = np.zeros((layout.levels, 2, 2), np.int8)
    predictors[:, :] = FOUR_POINT
    for level, axis in fitted_steps(layout):
        predictors[level, axis] = 0
    return predictors
