"""All levels of the only grid of a surface undone in one call of a kernel, or one level of a part of it.

Small surfaces have many levels of few values, and so have prefixes of large ones, whose finest levels hold no details.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from ..grid.axis import AxisStep
from ..grid.layout import REMEMBERED, Layout
from .lifting import REACH, work_room
from .predictors import FOUR_POINT, INTERFACES, is_fitted

__all__ = ["LevelInverse", "fits", "inverse_levels"]

#: Values of a level that are undone in one call.
_AT_ONCE = 1 << 20

#: Columns of a row of the kernel's table.
_KIND, _AXIS, _ROWS, _COLUMNS, _MIDPOINTS, _RUN, _A, _B, _TABLE = range(9)
#: Rows of a level: a place for `refine`, then the axes in reverse.
_EACH = 3
#: The axes in the order in which they are undone, and the rows of their steps.
_PLACES = (1, 1), (0, 2)


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
            first = _EACH * (finer - 1 - start)
            _bare(table[first : first + _EACH], steps.coarse[finer])
    kernels.inverse(table, array, np.empty(steps.room[level], np.int32))


def _bare(table: NDArray[np.int64], coarse: int) -> None:
    """Rows of a level, of so many rows of nodes, become those of one without details."""
    steps = table[1:]
    steps[steps[:, _KIND] == 1, _KIND] = kernels.LIFT_BARE
    steps[0, _ROWS] = coarse  # no other row has anything


class LevelInverse:
    """The step that makes one level, of a grid or of a part of it, undone in one call.

    Parameters
    ----------
    steps : (AxisStep, AxisStep)
        Along the columns' axis and along the rows' axis.
    rules : ((int, int), (int, int))
        The third step's (a, b) of either.
    """

    def __init__(self, steps: tuple[AxisStep, AxisStep], rules: tuple[tuple[int, int], tuple[int, int]]) -> None:
        table, self._room = _level(steps)
        for axis, place in _PLACES:
            table[place, _A : _B + 1] = rules[axis]
        self._table, self._coarse = table, steps[0].coarse

    def __call__(self, array: NDArray[np.int32], refined: bool, bare: bool) -> None:
        """Turn nodes and details into the finer level, in place, shape (row, column).

        ``refined``: the nodes become steps over 2**`FRACTION_BITS` first, see `pyramid.refine`. ``bare``: the details
        are 0, whatever stands in their places.
        """
        table = self._table.copy()
        if refined:
            table[0, _KIND] = kernels.INVERSE_REFINE
        if bare:
            _bare(table, self._coarse)
        kernels.inverse(table, array, np.empty(self._room, np.int32))


def _level(steps: tuple[AxisStep, AxisStep]) -> tuple[NDArray[np.int64], int]:
    """The rows of a level in the kernel's table, but for what a channel and a state have of their own; and its room."""
    table, room = np.zeros((_EACH, kernels.INVERSE_STEP), np.int64), 0
    shape = steps[0].length, steps[1].length
    table[0, [_KIND, _ROWS, _COLUMNS]] = kernels.INVERSE_NOTHING, steps[0].coarse, steps[1].coarse
    for axis, place in _PLACES:
        step = steps[axis]
        if step.midpoints:
            table[place, :_A] = 1, axis, *shape, step.midpoints, step.run
            table[place, _TABLE:] = step.extension(REACH).ravel()
            room = max(room, work_room(step, axis, shape[1 - axis]))
    return table, room


@lru_cache(maxsize=REMEMBERED)
def _steps(layout: Layout) -> _Steps:
    table = np.zeros((_EACH * layout.levels, kernels.INVERSE_STEP), np.int64)
    rules = np.full(_EACH * layout.levels, layout.levels * INTERFACES)
    coarse, room = [0], [0]
    for level in range(1, layout.levels + 1):
        steps, first = layout.steps(0, level), _EACH * (level - 1)
        table[first : first + _EACH], most = _level(steps)
        for axis, place in _PLACES:
            if is_fitted(steps[axis]):
                rules[first + place] = (level - 1) * INTERFACES + axis
        coarse.append(steps[0].coarse)
        room.append(max(room[-1], most))
    return _Steps(table, rules, coarse, room)
