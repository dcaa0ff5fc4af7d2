"""The hierarchy of one channel in integers: all levels, in place, with the third step fitted by the encoder.

A channel has an array for each grid of the layout, see `lodestream.grid.layout`. A patch whose side comes from an
interface holds that side's points at every level: level 0 copies them, and the details along the side that the inverse
needs are made by a forward step of the interface's points. Interfaces are therefore stepped first.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import lru_cache
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import NDArray

from ..grid.axis import AxisStep
from ..grid.layout import REMEMBERED, Layout, Source
from .all_levels import inverse_levels, memory_of
from .fitting import fitted_predictor
from .lifting import CLAMP, FRACTION_BITS, REACH, TAPS, forward_step, inverse_step
from .predictors import INTERFACES, default_predictors, fitted_steps, predictor

__all__ = [
    "PADDING",
    "allocate",
    "bare_level",
    "copied",
    "empty",
    "forward",
    "grids",
    "inverse",
    "inverse_level",
    "refine",
    "synthesis_norms",
    "take_details",
    "take_nodes",
    "third_step",
]

#: Unused columns at the end of an array of coefficients, see `allocate`.
PADDING = 24
_NORM_LEVELS = 6


def allocate(shape: tuple[int, int]) -> NDArray[np.int32]:
    """Allocate an int32 array of zeros of shape (row, column) for a channel's coefficients.

    It is a window of a slightly wider array, so that the distance between rows is never a power of two, at which a
    column's samples would compete for the same cache lines.
    """
    rows, columns = shape
    return np.zeros((rows, columns + PADDING), np.int32)[:, :columns]


def empty(shape: tuple[int, int]) -> NDArray[np.int32]:
    """Allocate as `allocate` does, shape (row, column), without setting values."""
    rows, columns = shape
    return np.empty((rows, columns + PADDING), np.int32)[:, :columns]


def grids(layout: Layout, level: int) -> list[NDArray[np.int32]]:
    """Allocate an int32 array for each grid of a level, shape (row, column) each, in one contiguous memory."""
    shapes = [layout.shape(number, level) for number in range(len(layout.grids))]
    ends = list(accumulate((rows * (columns + PADDING) for rows, columns in shapes), initial=0))
    memory = np.empty(ends[-1], np.int32)
    return [
        memory[first:last].reshape(rows, columns + PADDING)[:, :columns]
        for (first, last), (rows, columns) in zip(pairwise(ends), shapes, strict=True)
    ]


def copied(array: NDArray[np.int32]) -> NDArray[np.int32]:
    """Copy an array, shape (row, column), into one from `allocate`."""
    copy = allocate(array.shape)
    copy[...] = array
    return copy


def forward(
    arrays: Sequence[NDArray[np.int32]], layout: Layout, fit: bool = True, top: int | None = None, search: bool = True
) -> NDArray[np.int8]:
    """Turn a channel's lattice coordinates into its coefficients, in place.

    Parameters
    ----------
    arrays : int32, shape (row, column), from `allocate`, one for each grid
        Magnitudes of at most 2**24. Sides that come from interfaces hold the same points as these.
    layout : Layout
    fit : bool
        Choose the third step's (a, b) by size for each level and axis that is long enough; otherwise (0, 0) there.
    top : int, optional
        The arrays hold, and have the shape of, the grids of this level; by default of the finest one.
    search : bool
        See `fitted_predictor`.

    Returns
    -------
    int8, shape (level, axis, 2)
        (a, b) of the step from ``level + 1`` to ``level`` along axis 0 and 1 of the patches, and of the interfaces.
    """
    predictors = default_predictors(layout)
    fitted = set(fitted_steps(layout))
    for level in range(layout.levels if top is None else top, 0, -1):
        for axis in range(2):
            # All patches have one predictor, and all interfaces another: a short side alone is no sample to fit it to.
            corners = [_corner(array, layout.shape(k, level)) for k, array in enumerate(arrays)]
            for which in (axis, INTERFACES) if axis == 0 else (axis,):
                if fit and (level - 1, which) in fitted:
                    lines = [
                        (corner if axis == 0 else corner.T, layout.steps(k, level)[axis])
                        for k, corner in enumerate(corners)
                        if layout.grids[k].interface == (which == INTERFACES)
                    ]
                    predictors[level - 1, which] = fitted_predictor(lines, search)
            for k, grid in enumerate(layout.grids):
                step = layout.steps(k, level)[axis]
                if step.midpoints:
                    forward_step(corners[k], axis, step, predictor(predictors, grid, step, level, axis))
    return predictors


def _corner(array: NDArray[np.int32], shape: tuple[int, int]) -> NDArray[np.int32]:
    """Return the first rows and columns of an array, a view of this shape."""
    return array[: shape[0], : shape[1]]


def inverse(
    arrays: Sequence[NDArray[np.int32]],
    layout: Layout,
    predictors: NDArray[np.int8],
    level: int,
    whole: int | None = None,
    coordinate: bool = True,
    bare: Collection[int] = (),
) -> None:
    """Turn coefficients into the grids of ``level``, in place, in the first rows and columns of the arrays.

    The arrays have the shape (row, column) of each grid, ``predictors`` the shape (level, axis, 2). Small arrays of
    `grids` take one call of a kernel, others one for each step.

    Without ``whole``, the forward transform is undone exactly. Otherwise details of the levels up to ``whole`` count
    lattice steps, those above count steps over 2**`FRACTION_BITS`; so does the result where ``whole`` is less than
    ``level``.

    Where all details are known, rounding to whole steps undoes that of the forward transform; where some are unknown,
    it would only add an error at every level.

    If the channel is no ``coordinate``, no side comes from an interface, and interfaces are skipped.

    Details of the levels in ``bare`` count as 0, whatever the arrays hold there; with interfaces, ``bare`` is empty.
    """
    if (memory := memory_of(arrays, layout, level)) is not None:
        inverse_levels(memory, arrays, layout, predictors, level, whole, coordinate, bare)
        return
    numbers = [k for k, grid in enumerate(layout.grids) if coordinate or not grid.interface]
    if coordinate:
        take_nodes(arrays, layout)
    for finer in range(1, level + 1):
        for k in numbers:
            if whole is not None and finer == whole + 1:
                refine(_corner(arrays[k], layout.shape(k, whole)))  # the first level with details missing
            if coordinate:
                take_details(arrays, layout, predictors, k, finer)
            inverse_level(arrays[k], layout, predictors, k, finer, finer in bare)


def refine(nodes: NDArray[np.int32]) -> None:
    """Turn lattice steps into steps over 2**`FRACTION_BITS`, in place, clipped to what the kernel takes.

    ``nodes`` has the shape (row, column).
    """
    np.clip(nodes, -(CLAMP >> FRACTION_BITS), CLAMP >> FRACTION_BITS, out=nodes)
    nodes <<= FRACTION_BITS


def inverse_level(
    array: NDArray[np.int32], layout: Layout, predictors: NDArray[np.int8], number: int, level: int, bare: bool = False
) -> None:
    """Turn the nodes of the level below and the details of ``level`` into this level of a grid, in place.

    ``array`` is the grid's, shape (row, column), ``predictors`` have the shape (level, axis, 2). If ``bare``, details
    count as 0, whatever the array holds there.
    """
    corner, steps = _corner(array, layout.shape(number, level)), layout.steps(number, level)
    for axis in (1, 0):  # the forward transform's axes in reverse: rounding makes the order matter
        if steps[axis].midpoints:
            rule = predictor(predictors, layout.grids[number], steps[axis], level, axis)
            known = corner[: steps[0].coarse] if bare and axis == 1 else corner
            inverse_step(known, axis, steps[axis], rule, bare)


def bare_level(array: NDArray[np.int32], layout: Layout, number: int, level: int) -> None:
    """Turn a level of a grid, shape (row, column), into nodes of the level below and details before the third step.

    In place, as with the predictor (0, 0).
    """
    corner, steps = _corner(array, layout.shape(number, level)), layout.steps(number, level)
    for axis in range(2):
        if steps[axis].midpoints:
            forward_step(corner, axis, steps[axis], (0, 0))


def third_step(nodes: NDArray[np.int32], axis: int, step: AxisStep, predictor: tuple[int, int]) -> NDArray[np.int32]:
    """Compute the third step's prediction of details from the coarser level's nodes: floor((v_k + 128) / 256).

    Parameters
    ----------
    nodes : int32, shape (row, column)
        ``step.coarse`` of them along ``axis``.

    Returns
    -------
    int32, shape (row, column)
        ``step.midpoints`` of them along ``axis``.
    """
    rows, columns = nodes.shape
    values = allocate((step.length, columns) if axis == 0 else (rows, step.length))
    if nodes.size and predictor != (0, 0):
        # Inverting zero details with the third step and stepping forward without it leaves the prediction.
        values[:rows, :columns] = nodes
        inverse_step(values, axis, step, predictor)
        forward_step(values, axis, step, (0, 0))
    return values[step.coarse :] if axis == 0 else values[:, step.coarse :]


def take_nodes(arrays: Sequence[NDArray[np.int32]], layout: Layout) -> None:
    """Copy level 0 from interfaces, in place: first the ends that interfaces share, then the sides of patches.

    The arrays have the shape (row, column) of each grid.
    """
    for k, grid in enumerate(layout.grids):
        rows, columns = layout.shape(k, 0)
        for side, source in enumerate(grid.sources):
            if source is None:
                continue
            if grid.interface:
                last = layout.shape(source.grid, 0)[0] - 1
                arrays[k][0 if side == 0 else rows - 1, 0] = arrays[source.grid][last if source.reversed else 0, 0]
            else:
                place = (0, rows - 1, 0, columns - 1)[side]
                line = arrays[k][place, :columns] if side < 2 else arrays[k][:rows, place]
                line[:] = _points(arrays, layout, source, 0)


def _points(arrays: Sequence[NDArray[np.int32]], layout: Layout, source: Source, level: int) -> NDArray[np.int32]:
    """Return the points of an interface at a level, in the order of the side that takes them, shape (point,)."""
    points = arrays[source.grid][: layout.shape(source.grid, level)[0], 0]
    return points[::-1] if source.reversed else points


def take_details(
    arrays: Sequence[NDArray[np.int32]], layout: Layout, predictors: NDArray[np.int8], patch: int, level: int
) -> None:
    """Compute the details along a patch's sides from interfaces at ``level``, in place.

    The arrays have the shape (row, column) of each grid, ``predictors`` the shape (level, axis, 2).
    """
    grid, steps = layout.grids[patch], layout.steps(patch, level)
    if grid.interface:
        return
    rows, columns = (step.coarse for step in steps)
    for side, source in enumerate(grid.sources):
        axis = 1 if side < 2 else 0
        step = steps[axis]
        if source is None or not step.midpoints:
            continue
        place = (0, rows - 1, 0, columns - 1)[side]
        target = arrays[patch][place, : step.length] if side < 2 else arrays[patch][: step.length, place]
        points = _points(arrays, layout, source, level)
        if points.size == 1:
            target[step.coarse :] = 0  # a pole
            continue
        # The interface is complete at this level, so its forward step gives the details: they are never sent twice.
        line = points.reshape(1, -1).copy()
        forward_step(line, 1, step, predictor(predictors, grid, step, level, axis))
        target[step.coarse :] = line[0, step.coarse :]


def synthesis_norms(layout: Layout, predictors: NDArray[np.int8], number: int = 0) -> NDArray[np.float64]:
    """Compute squared norms of the surface change by a unit of a grid's coefficients, in the middle of the grid.

    A coefficient of an interface also changes the patches beside it, as their nodes do.

    Returns
    -------
    float64, shape (level, 2, 2)
        By level of the band and its kind along either axis (node, detail); at level 0 only [0, 0, 0] has a meaning.
    """
    lines = _line_norms(layout, predictors, number)
    norms: NDArray[np.float64] = lines[0][:, :, None] * lines[1][:, None, :]
    beside = _patches_beside(layout).get(number)
    if beside is not None:
        patch, side = beside
        # Across the side its points count as nodes of the patch; a pole's only point does so all along it.
        points = layout.grids[patch].shape[1 - side // 2] if layout.grids[number].shape[0] == 1 else 1
        return norms * points * _line_norms(layout, predictors, patch)[side // 2, :, 0][:, None, None]
    return norms


@lru_cache(maxsize=REMEMBERED)
def _patches_beside(layout: Layout) -> dict[int, tuple[int, int]]:
    """Return for each interface that a patch takes points from the first such patch, and its side."""
    sides = {
        source.grid: (patch, side)
        for patch, grid in reversed(list(enumerate(layout.grids)))
        for side, source in reversed(list(enumerate(grid.sources)))
        if source is not None and not grid.interface
    }
    return {number: beside for number, beside in sides.items() if layout.grids[number].interface}


def _line_norms(layout: Layout, predictors: NDArray[np.int8], number: int) -> NDArray[np.float64]:
    """Compute squared norms along each axis of a grid: float64, shape (axis, level, node or detail)."""
    lines = np.ones((2, layout.levels + 1, 2))
    for axis in range(2):
        stepping = []
        for level in range(1, layout.levels + 1):
            step = layout.steps(number, level)[axis]
            if step.midpoints:
                stepping.append((level, *predictor(predictors, layout.grids[number], step, level, axis)))
        for level in range(layout.levels + 1):
            above = tuple(step for step in stepping if step[0] >= level)
            lines[axis, level] = _line_norm(above, max(level, 1))
    return lines


@lru_cache(maxsize=4096)
def _line_norm(stepping: tuple[tuple[int, int, int], ...], first: int) -> tuple[float, float]:
    """Compute squared norms along one axis of a node and of a detail of a band of level ``first``.

    ``stepping``: level and (a, b) of the steps from this level on.
    """
    if not stepping:
        return 1.0, 1.0
    nodes, details = np.zeros((2, 2, 16))
    nodes[0, 8] = 1.0
    (details if stepping[0][0] == first else nodes)[1, 8] = 1.0
    for _, a, b in stepping[:_NORM_LEVELS]:
        nodes = _synthesised(nodes, details, a, b)
        details = np.zeros_like(nodes)
    squares = (nodes * nodes).sum(axis=1) * 2.0 ** max(0, len(stepping) - _NORM_LEVELS)
    return float(squares[0]), float(squares[1])


def _synthesised(nodes: NDArray[np.float64], surplus: NDArray[np.float64], a: int, b: int) -> NDArray[np.float64]:
    """Apply one inverse step to closed lines without rounding; float64, shape (line, sample)."""
    count = nodes.shape[1]
    c = np.concatenate([nodes[:, -2:], nodes, nodes[:, :3]], axis=1)
    before, here, after = (c[:, k : k + count] for k in (1, 2, 3))
    v = a * (here + after - c[:, 4:-1] - before) + b * (here + after - c[:, 5:] - c[:, :-5])
    details = surplus + v / 256.0
    d = np.concatenate([details[:, -REACH:], details, details[:, : REACH - 1]], axis=1)
    total = np.zeros_like(nodes)
    for j, tap in enumerate(TAPS):
        total += tap * (d[:, REACH + j : REACH + j + count] + d[:, REACH - 1 - j : REACH - 1 - j + count])
    line = np.empty((2, 2 * count))
    line[:, ::2] = even = nodes - total / 2.0**24
    line[:, 1::2] = details + (even + np.concatenate([even[:, 1:], even[:, :1]], axis=1)) / 2.0
    return line
