"""Predictors (a, b) of the third step as the format sees them: which steps have a fitted one, which the fixed one."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..grid.axis import AxisStep
from ..grid.layout import REMEMBERED, Grid, Layout

__all__ = [
    "COEFFICIENT_BITS",
    "FIT_NODES",
    "FOUR_POINT",
    "INTERFACES",
    "default_predictors",
    "fitted_steps",
    "is_fitted",
    "predictor",
]

#: Magnitude bits of a coefficient, at most.
COEFFICIENT_BITS = 28
#: The third step where the axis is too short to fit one: the four-point rule.
FOUR_POINT = (16, 0)
#: Nodes that an axis needs for a fitted (a, b).
FIT_NODES = 24
#: Beside axis 0 and axis 1 of the patches: the axis of the interfaces.
INTERFACES = 2


@lru_cache(maxsize=REMEMBERED)
def fitted_steps(layout: Layout) -> tuple[tuple[int, int], ...]:
    """Return (coarser level, axis) of every step with a fitted (a, b): along an axis that is long enough.

    All patches share one (a, b); all interfaces share another one, whose axis is `INTERFACES`.
    """
    steps = []
    for level in range(layout.levels):
        fitted = set()
        for number, grid in enumerate(layout.grids):
            for axis, step in enumerate(layout.steps(number, level + 1)):
                if is_fitted(step):
                    fitted.add(INTERFACES if grid.interface else axis)
        steps += [(level, axis) for axis in sorted(fitted)]
    return tuple(steps)


def default_predictors(layout: Layout) -> NDArray[np.int8]:
    """Return the predictors before any is fitted: (0, 0) for every step; int8, shape (level, axis, 2)."""
    return np.zeros((layout.levels, INTERFACES + 1, 2), np.int8)


def predictor(predictors: NDArray[np.int8], grid: Grid, step: AxisStep, level: int, axis: int) -> tuple[int, int]:
    """Return the (a, b) of a grid's step along an axis from ``level`` to the level below."""
    if not is_fitted(step):
        return FOUR_POINT
    a, b = (int(x) for x in predictors[level - 1, INTERFACES if grid.interface else axis])
    return a, b


def is_fitted(step: AxisStep) -> bool:
    """Return whether a step has a fitted (a, b): along an axis that is long enough."""
    return step.midpoints > 0 and step.run >= FIT_NODES
