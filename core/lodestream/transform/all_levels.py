"""All levels of a channel undone in one call of a kernel, or one level of a part of a grid.

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

#: Values of a level that are undone in one call.
_AT_ONCE = 1 << 20

#: Levels of all grids whose steps are told in one call: a table takes some 400 bytes for each.
_MOST_GRIDS = 1 << 14

#: Columns of a row of the kernel's table.
_KIND, _PLANE, _AXIS, _ROWS, _COLUMNS, _MIDPOINTS, _RUN, _A, _B, _TABLE = range(10)
_SOURCE, _FROM, _BY, _LINE = range(kernels.INVERSE_STEP - 4, kernels.INVERSE_STEP)


class _Steps(NamedTuple):
    """What the kernel is told of every level, but for what a channel and a state have of their own.

    Attributes
    ----------
    table : int64, shape (step, field)
        Level by level; of a grid a place for `refine`, what it takes from interfaces, then the axes in reverse.
    fitted : int64, shape (fitted step,)
        The steps that have an (a, b) of their own.
    rules : int64, shape (fitted step, 2)
        Which one: coarser level and axis.
    level : int64, shape (step,)
    coarse : int64, shape (step,)
        Of an inverse step along axis 1 the rows that have something where the level has no details, else -1.
    starts : list of int
        The first step of each level, and the number of steps.
    room : list of int
        Numbers that the kernel works in, up to each level.
    """

    table: NDArray[np.int64]
    fitted: NDArray[np.int64]
    rules: NDArray[np.int64]
    level: NDArray[np.int64]
    coarse: NDArray[np.int64]
    starts: list[int]
    room: list[int]


def memory_of(arrays: Sequence[NDArray[np.int32]], layout: Layout, level: int) -> NDArray[np.int32] | None:
    """What `inverse_levels` takes: the flat array, shape (number,), that all of these, (row, column), are windows of.

    None where there is none, or more values than a call may have.
    """
    if layout.points(level) > _AT_ONCE or (len(arrays) > 1 and len(arrays) * layout.levels > _MOST_GRIDS):
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
    """`pyramid.inverse` of arrays in one piece of memory, in place.

    ``memory`` is that of the arrays, which have the shape (row, column); ``predictors`` have (level, axis, 2).
    """
    told, fitted, rules, room = _told(layout, coordinate or not layout.shared, level, whole, tuple(bare))
    table = told.copy()
    table[fitted, _A : _B + 1] = predictors[rules[:, 0], rules[:, 1]]
    kernels.inverse(table, _planes(arrays, memory), memory, np.empty(room, np.int32))


def _planes(arrays: Sequence[NDArray[np.int32]], memory: NDArray[np.int32]) -> NDArray[np.int64]:
    """Where arrays lie within their memory, as the kernel takes it: int64, shape (array, 4)."""
    first = _address(memory)
    planes = [
        ((_address(array) - first) // array.itemsize, *array.shape, array.strides[0] // array.itemsize)
        for array in arrays
    ]
    return np.array(planes, np.int64)


def _address(array: NDArray[np.int32]) -> int:
    address: int = array.__array_interface__["data"][0]
    return address


@lru_cache(maxsize=2 * REMEMBERED)
def _told(
    layout: Layout, coordinate: bool, level: int, whole: int | None, bare: tuple[int, ...]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], int]:
    """The kernel's table for some levels; its rows with an (a, b) of their own, and which; room to work in."""
    steps = _steps(layout, coordinate)
    last = steps.starts[level + 1]
    table, of_level, coarse = steps.table[:last].copy(), steps.level[:last], steps.coarse[:last]
    if whole is not None:
        refined = (of_level == whole + 1) & (table[:, _KIND] == kernels.INVERSE_NOTHING)
        table[refined, _KIND] = kernels.INVERSE_REFINE
    for finer in bare:
        own = (of_level == finer) & (table[:, _KIND] == 1)
        table[own, _KIND] = kernels.LIFT_BARE
        own &= coarse >= 0
        table[own, _ROWS] = coarse[own]  # no other row has anything
    fitted = slice(int(np.searchsorted(steps.fitted, last)))
    return table, steps.fitted[fitted], steps.rules[fitted], steps.room[level]


@lru_cache(maxsize=2 * REMEMBERED)
def _steps(layout: Layout, coordinate: bool) -> _Steps:
    rows: list[_Step] = []
    starts, room = [0], [0]
    numbers = [k for k, grid in enumerate(layout.grids) if coordinate or not grid.interface]
    for level in range(layout.levels + 1):
        for k in numbers:
            rows += _of_grid(layout, k, level, coordinate)
        starts.append(len(rows))
        room.append(max((row.room for row in rows), default=0))
    table = np.zeros((len(rows), kernels.INVERSE_STEP), np.int64)
    for own, row in zip(table, rows, strict=True):
        own[: len(row.fields)] = row.fields
        own[_SOURCE:] = row.source
    fitted = [number for number, row in enumerate(rows) if row.rule is not None]
    rules = np.array([rows[number].rule for number in fitted], np.int64).reshape(-1, 2)
    level_of = np.repeat(np.arange(layout.levels + 1), np.diff(starts))
    coarse = np.array([row.coarse for row in rows], np.int64)
    return _Steps(table, np.array(fitted, np.int64), rules, level_of, coarse, starts, room[1:])


class _Step(NamedTuple):
    """A row of the table while it is made; ``rule`` is its place among all (a, b), None where it has none."""

    fields: list[int]
    source: tuple[int, int, int, int] = (0, 0, 0, 0)
    rule: tuple[int, int] | None = None
    coarse: int = -1
    room: int = 0


def _of_grid(layout: Layout, number: int, level: int, coordinate: bool) -> Iterator[_Step]:
    """What makes a level of a grid, in order."""
    grid, shape = layout.grids[number], layout.shape(number, level)
    if level == 0:
        yield from _nodes(layout, number) if coordinate else ()
        return
    steps = layout.steps(number, level)
    yield _Step([kernels.INVERSE_NOTHING, number, 0, *layout.shape(number, level - 1)])

    def lifted(kind: int, axis: int, shape: tuple[int, int]) -> tuple[list[int], tuple[int, int] | None]:
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
    """A row of the table for a step of the lifting."""
    return [kind, plane, axis, *shape, step.midpoints, step.run, *rule, *step.extension(REACH).ravel().tolist()]


def _nodes(layout: Layout, number: int) -> Iterator[_Step]:
    """Level 0 of what a grid takes from interfaces: of an interface its ends, of a patch its sides."""
    grid, (rows, columns) = layout.grids[number], layout.shape(number, 0)
    for side, source in enumerate(grid.sources):
        if source is None:
            continue
        place, count = (0, rows - 1, 0, columns - 1)[side], columns if side < 2 else rows
        points = _points(layout, source, 0)
        if grid.interface:  # a point of another one
            points, count = (*points[:2], 0), 1
        yield _Step([kernels.INVERSE_NODES, number, 1 if side < 2 else 0, 1, count], (*points, place))


def _points(layout: Layout, source: Source, level: int) -> tuple[int, int, int]:
    """Points of an interface at a level in the order of the side that takes them: its number, the first, the stride.

    A pole is one point.
    """
    count = layout.shape(source.grid, level)[0]
    if count == 1:
        return source.grid, 0, 0
    return (source.grid, count - 1, -1) if source.reversed else (source.grid, 0, 1)


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
        shape, self._coarse = (steps[0].length, steps[1].length), steps[0].coarse
        rows, self._room = [[kernels.INVERSE_NOTHING, 0, 0, steps[0].coarse, steps[1].coarse]], 0
        for axis in (1, 0):
            if steps[axis].midpoints:
                rows.append(_fields(1, 0, axis, shape, steps[axis], rules[axis]))
                self._room = max(self._room, work_room(steps[axis], axis, shape[1 - axis]))
        self._table = np.zeros((len(rows), kernels.INVERSE_STEP), np.int64)
        for own, row in zip(self._table, rows, strict=True):
            own[: len(row)] = row

    def __call__(self, array: NDArray[np.int32], refined: bool, bare: bool) -> None:
        """Turn nodes and details into the finer level, in place.

        Parameters
        ----------
        array : int32, shape (row, column)
            With all its columns side by side, in a C-contiguous array.
        refined : bool
            The nodes become steps over 2**`FRACTION_BITS` first, see `pyramid.refine`.
        bare : bool
            The details are 0, whatever stands in their places.
        """
        table = self._table.copy()
        if refined:
            table[0, _KIND] = kernels.INVERSE_REFINE
        if bare:
            table[1:, _KIND] = kernels.LIFT_BARE
            table[table[:, _AXIS] == 1, _ROWS] = self._coarse  # no other row has anything
        memory = array if array.base is None else array.base
        assert isinstance(memory, np.ndarray)
        memory = memory.reshape(-1)
        kernels.inverse(table, _planes([array], memory), memory, np.empty(self._room, np.int32))
