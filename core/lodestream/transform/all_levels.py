"""All levels of the only grid of a surface undone in one call of a kernel.

Small surfaces have many levels of few values, and so have prefixes of large ones, whose finest levels hold no details.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from ..grid.layout import REMEMBERED, Layout
from .lifting import REACH, work_room
from .predictors import FOUR_POINT, INTERFACES, is_fitted

__all__ = ["fits", "inverse_levels"]

#: Values of a level that are undone in one call.
_AT_ONCE = 1 << 20

#: Columns of a row of the kernel's table.
_KIND, _AXIS, _ROWS, _COLUMNS, _MIDPOINTS, _RUN, _A, _B, _TABLE = range(9)
#: Rows of a level: a place for `refine`, then the axes in reverse.
_EACH = 3


class _Steps(NamedTuple):
    """What the kernel is told of every level, but for what a channel and a state have of their own.

    ``table`` is int64, shape (3 a level, field), ``rules`` int64, which (a, b) each of its rows takes; ``coarse`` are
    the rows of nodes and ``room`` the room to work in up to each level.
    """

    table: NDArray[np.int64]
    rules: NDArray[np.int64]
    coarse: list[int]
    room: list[int]


def fits(layout: Layout, level: int) -> bool:
    """Whether `inverse_levels` takes this level: of one grid, of no more values than a call may have."""
    rows, columns = layout.shape(0, level)
    return len(layout.grids) == 1 and rows * columns <= _AT_ONCE


def inverse_levels(
    array: NDArray[np.int32],
    layout: Layout,
    predictors: NDArray[np.int8],
    level: int,
    whole: int | None,
    start: int,
    bare: Collection[int],
) -> None:
    """`pyramid.inverse` of the only grid, from the level ``start`` to one that `fits`, in place.

    ``array`` has the shape (row, column), ``predictors`` (level, axis, 2).
    """
    if start >= level:
        return
    steps = _steps(layout)
    table = steps.table[_EACH * start : _EACH * level].copy()
    rules = np.concatenate([predictors[:, :INTERFACES].reshape(-1, 2), [FOUR_POINT]])
    table[:, _A : _B + 1] = rules[steps.rules[_EACH * start : _EACH * level]]
    if whole is not None and start <= whole < level:
        table[_EACH * (whole - start), _KIND] = kernels.INVERSE_REFINE
    for finer in bare:
        if start < finer <= level:
            first = _EACH * (finer - 1 - start) + 1
            own = table[first : first + 2]
            own[own[:, _KIND] == 1, _KIND] = kernels.LIFT_BARE
            own[0, _ROWS] = steps.coarse[finer]  # no other row has anything
    kernels.inverse(table, array, np.empty(steps.room[level], np.int32))


@lru_cache(maxsize=REMEMBERED)
def _steps(layout: Layout) -> _Steps:
    table = np.zeros((_EACH * layout.levels, kernels.INVERSE_STEP), np.int64)
    rules = np.full(_EACH * layout.levels, layout.levels * INTERFACES)
    coarse, room = [0], [0]
    for level in range(1, layout.levels + 1):
        steps, shape = layout.steps(0, level), layout.shape(0, level)
        first = _EACH * (level - 1)
        table[first, [_KIND, _ROWS, _COLUMNS]] = kernels.INVERSE_NOTHING, *layout.shape(0, level - 1)
        most = room[-1]
        for place, axis in ((first + 1, 1), (first + 2, 0)):
            step = steps[axis]
            if step.midpoints:
                table[place, :_A] = 1, axis, *shape, step.midpoints, step.run
                table[place, _TABLE:] = step.extension(REACH).ravel()
                most = max(most, work_room(step, axis, shape[1 - axis]))
            if is_fitted(step):
                rules[place] = (level - 1) * INTERFACES + axis
        coarse.append(steps[0].coarse)
        room.append(most)
    return _Steps(table, rules, coarse, room)
