"""The third step of the lifting as the format sees it: which steps have an (a, b) of their own, which a common one."""

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

#: A coefficient has at most so many magnitude bits.
COEFFICIENT_BITS = 28
#: The third step where the axis is too short to fit one: the four-point rule.
FOUR_POINT = (16, 0)
#: Nodes that an axis needs for an (a, b) of its own.
FIT_NODES = 24
#: Beside axis 0 and axis 1 of the patches: the axis of the interfaces.
INTERFACES = 2


@lru_cache(maxsize=REMEMBERED)
def fitted_steps(layout: Layout) -> tuple[tuple[int, int], ...]:
    """(coarser level, axis) of every step with an (a, b) of its own: along an axis 0 or 1 that is long enough.

    All patches have it in common; all interfaces have another in common, whose axis is `INTERFACES`.
    """
    found = []
    for level in range(layout.levels):
        fitted = set()
        for number, grid in enumerate(layout.grids):
            for axis, step in enumerate(layout.steps(number, level + 1)):
                if is_fitted(step):
                    fitted.add(INTERFACES if grid.interface else axis)
        found += [(level, axis) for axis in sorted(fitted)]
    return tuple(found)


def default_predictors(layout: Layout) -> NDArray[np.int8]:
    """What no container carries: (0, 0) for every step; int8, shape (level, axis, 2)."""
    return np.zeros((layout.levels, INTERFACES + 1, 2), np.int8)


def predictor(predictors: NDArray[np.int8], grid: Grid, step: AxisStep, level: int, axis: int) -> tuple[int, int]:
    """The (a, b) of a grid's step along an axis from ``level`` to the level below."""
    if not is_fitted(step):
        return FOUR_POINT
    a, b = (int(x) for x in predictors[level - 1, INTERFACES if grid.interface else axis])
    return a, b


def is_fitted(step: AxisStep) -> bool:
    """Whether a step has an (a, b) of its own: along an axis that is long enough."""
    return step.midpoints > 0 and step.run >= FIT_NODES
