"""The inverse transform of all levels of a channel, or of one level of a part of a grid, in one call of a kernel.

Small surfaces have many levels of few values, and so have prefixes of large ones, whose finest levels hold no details.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from ..grid.axis import AxisStep
from ..grid.layout import REMEMBERED, Layout, Source
from .lifting import REACH, work_room
from .predictors import FOUR_POINT, INTERFACES, is_fitted

__all__ = ["LevelInverse", "inverse_levels", "memory_of"]

#: Points of a level that one call may invert.
_POINTS_PER_CALL = 1 << 20

#: Levels of all grids that one call may invert: the table of steps takes some 400 bytes for each.
_MAX_GRID_LEVELS = 1 << 14

#: Columns of a row of the kernel's table.
_KIND, _PLANE, _AXIS, _ROWS, _COLUMNS, _MIDPOINTS, _RUN, _A, _B, _TABLE = range(10)
_SOURCE, _FROM, _BY, _LINE = range(kernels.INVERSE_STEP - 4, kernels.INVERSE_STEP)


class _Steps(NamedTuple):
    """The kernel's table for every level, without what depends on the channel and its state.

    Attributes
    ----------
    table : int64, shape (step, field)
        Level by level; of a grid a place for `refine`, what it takes from interfaces, then the axes in reverse.
    fitted : int64, shape (fitted step,)
        The steps whose (a, b) was fitted.
    rules : int64, shape (fitted step, 2)
        Coarser level and axis of that (a, b).
    level : int64, shape (step,)
    coarse : int64, shape (step,)
        Of an inverse step along axis 1 the rows that are not all zero where the level has no details, else -1.
    starts : list of int
        The first step of each level, and the number of steps.
    room : list of int
        Elements of working memory that the kernel needs, up to each level.
    """

    table: NDArray[np.int64]
    fitted: NDArray[np.int64]
    rules: NDArray[np.int64]
    level: NDArray[np.int64]
    coarse: NDArray[np.int64]
    starts: list[int]
    room: list[int]


def memory_of(arrays: Sequence[NDArray[np.int32]], layout: Layout, level: int) -> NDArray[np.int32] | None:
    """Return the flat array, shape (value,), of which all arrays, (row, column), are windows, for `inverse_levels`.

    None where there is no such array, or where it has more values than a call may have.
    """
    if layout.points(level) > _POINTS_PER_CALL or (len(arrays) > 1 and len(arrays) * layout.levels > _MAX_GRID_LEVELS):
        return None
    owner = arrays[0] if arrays[0].base is None else arrays[0].base
    if not isinstance(owner, np.ndarray) or owner.dtype != np.int32 or not owner.flags.c_contiguous:
        return None
    if not all((array is owner or array.base is owner) and array.strides[1] == array.itemsize for array in arrays):
        return None
    return owner.reshape(-1)


def inverse_levels(
    memory: NDArray[np.int32],
    arrays: Sequence[NDArray[np.int32]],
    layout: Layout,
    predictors: NDArray[np.int8],
    level: int,
    whole: int | None,
    coordinate: bool,
    bare: Collection[int],
) -> None:
    """Do what `pyramid.inverse` does for arrays in one contiguous memory, in place.

    ``memory`` is that of the arrays, which have the shape (row, column); ``predictors`` have (level, axis, 2).
    """
    template, fitted, rules, room = _kernel_table(layout, coordinate or not layout.shared, level, whole, tuple(bare))
    table = template.copy()
    table[fitted, _A : _B + 1] = predictors[rules[:, 0], rules[:, 1]]
    kernels.inverse(table, _planes(arrays, memory), memory, np.empty(room, np.int32))


def _planes(arrays: Sequence[NDArray[np.int32]], memory: NDArray[np.int32]) -> NDArray[np.int64]:
    """Describe where arrays lie within their memory, as the kernel takes it: int64, shape (array, 4)."""
    first = _address(memory)
    planes = [
        ((_address(array) - first) // array.itemsize, *array.shape, array.strides[0] // array.itemsize)
        for array in arrays
    ]
    return np.array(planes, np.int64)


def _address(array: NDArray[np.int32]) -> int:
    """Return the address of an array's first element."""
    address: int = array.__array_interface__["data"][0]
    return address


@lru_cache(maxsize=2 * REMEMBERED)
def _kernel_table(
    layout: Layout, coordinate: bool, level: int, whole: int | None, bare: tuple[int, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], int]:
    """Return the kernel's table for some levels; its fitted rows, and the rule of each; elements of working memory."""
    steps = _steps(layout, coordinate)
    last = steps.starts[level + 1]
    table, of_level, coarse = steps.table[:last].copy(), steps.level[:last], steps.coarse[:last]
    if whole is not None:
        refined = (of_level == whole + 1) & (table[:, _KIND] == kernels.INVERSE_NOTHING)
        table[refined, _KIND] = kernels.INVERSE_REFINE
    for finer in bare:
        bare_steps = (of_level == finer) & (table[:, _KIND] == 1)
        table[bare_steps, _KIND] = kernels.LIFT_BARE
        bare_steps &= coarse >= 0
        table[bare_steps, _ROWS] = coarse[bare_steps]  # the other rows are zero
    fitted = slice(int(np.searchsorted(steps.fitted, last)))
    return table, steps.fitted[fitted], steps.rules[fitted], steps.room[level]


@lru_cache(maxsize=2 * REMEMBERED)
def _steps(layout: Layout, coordinate: bool) -> _Steps:
    """Make the table of all levels of a layout."""
    rows: list[_Step] = []
    starts, room = [0], [0]
    numbers = [k for k, grid in enumerate(layout.grids) if coordinate or not grid.interface]
    for level in range(layout.levels + 1):
        for k in numbers:
            rows += _of_grid(layout, k, level, coordinate)
        starts.append(len(rows))
        room.append(max((row.room for row in rows), default=0))
    table = np.zeros((len(rows), kernels.INVERSE_STEP), np.int64)
    for line, row in zip(table, rows, strict=True):
        line[: len(row.fields)] = row.fields
        line[_SOURCE:] = row.source
    fitted = [number for number, row in enumerate(rows) if row.rule is not None]
    rules = np.array([rows[number].rule for number in fitted], np.int64).reshape(-1, 2)
    level_of = np.repeat(np.arange(layout.levels + 1), np.diff(starts))
    coarse = np.array([row.coarse for row in rows], np.int64)
    return _Steps(table, np.array(fitted, np.int64), rules, level_of, coarse, starts, room[1:])


class _Step(NamedTuple):
    """A row of the table while it is made; ``rule`` is the level and axis of a fitted (a, b), else None."""

    fields: list[int]
    source: tuple[int, int, int, int] = (0, 0, 0, 0)
    rule: tuple[int, int] | None = None
    coarse: int = -1
    room: int = 0


def _of_grid(layout: Layout, number: int, level: int, coordinate: bool) -> Iterator[_Step]:
    """Yield the steps that make a level of a grid, in order."""
    grid, shape = layout.grids[number], layout.shape(number, level)
    if level == 0:
        yield from _nodes(layout, number) if coordinate else ()
        return
    steps = layout.steps(number, level)
    yield _Step([kernels.INVERSE_NOTHING, number, 0, *layout.shape(number, level - 1)])

    def lifted(kind: int, axis: int, shape: tuple[int, int]) -> tuple[list[int], tuple[int, int] | None]:
        """Return the table fields of a step along an axis, and its rule."""
        rule = (level - 1, INTERFACES if grid.interface else axis) if is_fitted(steps[axis]) else None
        return _fields(kind, number, axis, shape, steps[axis], FOUR_POINT), rule

    if coordinate and not grid.interface:
        for side, source in enumerate(grid.sources):
            axis = 1 if side < 2 else 0
            if source is not None and steps[axis].midpoints:
                points = _points(layout, source, level)
                line = (0, steps[0].coarse - 1, 0, steps[1].coarse - 1)[side]
                length = steps[axis].length
                fields, rule = lifted(kernels.INVERSE_DETAILS, axis, (1, length))
                yield _Step(fields, (*points, line), rule, room=length + work_room(steps[axis], 1, 1))
    for axis in (1, 0):
        if steps[axis].midpoints:
            fields, rule = lifted(1, axis, shape)
            coarse = steps[0].coarse if axis == 1 else -1
            yield _Step(fields, rule=rule, coarse=coarse, room=work_room(steps[axis], axis, shape[1 - axis]))


def _fields(
    kind: int, plane: int, axis: int, shape: tuple[int, int], step: AxisStep, rule: tuple[int, int]
) -> list[int]:
    """Return the table row of a lifting step."""
    return [kind, plane, axis, *shape, step.midpoints, step.run, *rule, *step.extension(REACH).ravel().tolist()]


def _nodes(layout: Layout, number: int) -> Iterator[_Step]:
    """Yield the steps that copy level 0 of a grid from interfaces: the ends of an interface, the sides of a patch."""
    grid, (rows, columns) = layout.grids[number], layout.shape(number, 0)
    for side, source in enumerate(grid.sources):
        if source is None:
            continue
        place, count = (0, rows - 1, 0, columns - 1)[side], columns if side < 2 else rows
        points = _points(layout, source, 0)
        if grid.interface:  # one point of another interface
            points, count = (*points[:2], 0), 1
        yield _Step([kernels.INVERSE_NODES, number, 1 if side < 2 else 0, 1, count], (*points, place))


def _points(layout: Layout, source: Source, level: int) -> tuple[int, int, int]:
    """Return an interface's number, and first index and stride of its points in the order of the side that takes them.

    A pole is one point.
    """
    count = layout.shape(source.grid, level)[0]
    if count == 1:
        return source.grid, 0, 0
    return (source.grid, count - 1, -1) if source.reversed else (source.grid, 0, 1)


class LevelInverse:
    """Inverse transform of one level, of a grid or of a part of it, in one call.

    Parameters
    ----------
    steps : (AxisStep, AxisStep)
        Along the columns' axis and along the rows' axis.
    rules : ((int, int), (int, int))
        The third step's (a, b) of each axis.
    """

    def __init__(self, steps: tuple[AxisStep, AxisStep], rules: tuple[tuple[int, int], tuple[int, int]]) -> None:
        shape, self._coarse = (steps[0].length, steps[1].length), steps[0].coarse
        rows, self._room = [[kernels.INVERSE_NOTHING, 0, 0, steps[0].coarse, steps[1].coarse]], 0
        for axis in (1, 0):
            if steps[axis].midpoints:
                rows.append(_fields(1, 0, axis, shape, steps[axis], rules[axis]))
                self._room = max(self._room, work_room(steps[axis], axis, shape[1 - axis]))
        self._table = np.zeros((len(rows), kernels.INVERSE_STEP), np.int64)
        for line, row in zip(self._table, rows, strict=True):
            line[: len(row)] = row

    def __call__(self, array: NDArray[np.int32], refined: bool, bare: bool) -> None:
        """Turn nodes and details into the finer level, in place.

                Parameters
                ----------
                array : int32, shape (row, column)
                    All its columns are adjacent, in a C-contiguous array.
                refined : bool
                    The nodes become steps over 2**`FRACTION_BITS` first, see `pyramid.refine`.
                bare : bool
        The details count as 0, whatever the array holds there.
        """
        table = self._table.copy()
        if refined:
            table[0, _KIND] = kernels.INVERSE_REFINE
        if bare:
            table[1:, _KIND] = kernels.LIFT_BARE
            table[table[:, _AXIS] == 1, _ROWS] = self._coarse  # the other rows are zero
        memory = array if array.base is None else array.base
        assert isinstance(memory, np.ndarray)
        memory = memory.reshape(-1)
        kernels.inverse(table, _planes([array], memory), memory, np.empty(self._room, np.int32))
