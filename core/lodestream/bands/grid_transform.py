"""The forward transform of one channel by runs of grids, level by level: what `pyramid.forward` makes of all grids.

A grid needs nothing of the others but the fitted predictors: those of the patches, and one more of the interfaces. So
each level takes two rounds of tasks as it does by bands of rows, see `forward`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..entropy.part_table import part_of
from ..entropy.tile_coder import planes_of
from ..entropy.tiles import TileTable, gather
from ..grid.layout import Layout
from ..scratch import Scratch
from ..transform.fitting import fitted_to_columns, sample_stride
from ..transform.lifting import forward_step
from ..transform.predictors import INTERFACES, fitted_steps, is_fitted, predictor
from ..transform.pyramid import empty
from .grid_runs import GridRuns

__all__ = [
    "coefficients_of",
    "details_of",
    "fit",
    "joined",
    "largest_of",
    "read_grids",
    "sampled_lines",
    "separated",
    "step",
]

_Arrays = list[NDArray[np.int32]]


def joined(arrays: Sequence[NDArray[np.int32]]) -> NDArray[np.int32]:
    """Grids, shape (row, column), one after another in a flat array."""
    return np.concatenate([np.zeros(0, np.int32), *(array.ravel() for array in arrays)])


def separated(flat: NDArray[np.int32], shapes: Sequence[tuple[int, int]]) -> _Arrays:
    """Undo `joined`: arrays of these shapes, from `pyramid.empty`."""
    found, done = [], 0
    for rows, columns in shapes:
        array = empty((rows, columns))
        array[...] = flat[done : done + rows * columns].reshape(rows, columns)
        done += rows * columns
        found.append(array)
    return found


def read_grids(scratch: Scratch, name: str, runs: GridRuns, level: int, grids: range) -> _Arrays:
    """Neighbouring grids of a level, from files ``name/0``, ``name/1`` ... of the level's samples."""
    found: _Arrays = []
    for number, own in enumerate(runs.samples(level)):
        common = range(max(own.start, grids.start), min(own.stop, grids.stop))
        if common:
            before = sum(runs.size(grid, level) for grid in range(own.start, common.start))
            shapes = [runs.layout.shape(grid, level) for grid in common]
            found += separated(scratch.read(f"{name}/{number}")[before:], shapes)
    return found


def sampled_lines(arrays: Sequence[NDArray[np.int32]], layout: Layout, level: int, grids: range, axis: int) -> _Arrays:
    """The lines along an axis of some grids that predictors are fitted to, as columns: shape (sample, line) each.

    None of grids whose axis is too short. ``arrays`` are the grids' at the level, shape (row, column).
    """
    strides = _strides(layout, level, grids, axis)
    return [
        (array if axis == 0 else array.T)[:, :: strides[grid]]
        for array, grid in zip(arrays, grids, strict=True)
        if grid in strides
    ]


def _strides(layout: Layout, level: int, grids: range, axis: int) -> dict[int, int]:
    """Every how manieth line along an axis is looked at, of those grids whose predictor is fitted."""
    lines = _lines(layout, level, axis)
    return {
        grid: sample_stride(layout.shape(grid, level)[1 - axis], lines[layout.grids[grid].interface])
        for grid in grids
        if is_fitted(layout.steps(grid, level)[axis])
    }


@lru_cache(maxsize=64)
def _lines(layout: Layout, level: int, axis: int) -> tuple[int, int]:
    """Lines along an axis that all patches have together at a level, and all interfaces."""
    lines = [0, 0]
    for number, grid in enumerate(layout.grids):
        lines[grid.interface] += layout.shape(number, level)[1 - axis]
    return lines[0], lines[1]


def fit(
    flat: Sequence[NDArray[np.int32]], runs: Sequence[range], layout: Layout, level: int, rule: int
) -> tuple[int, int] | None:
    """The (a, b) of axis 0 or 1 of the patches, or of the interfaces; None: it is not fitted.

    Parameters
    ----------
    flat : sequence of int32 arrays, flat
        What `sampled_lines` found along the axis, one for each of the runs, `joined`.
    runs : sequence of range
        Grids.
    rule : int
        An axis, or `INTERFACES`.
    """
    if (level - 1, rule) not in fitted_steps(layout):
        return None
    axis = 0 if rule == INTERFACES else rule
    chosen = []
    for array, grids in zip(flat, runs, strict=True):
        strides = _strides(layout, level, grids, axis)
        shapes = []
        for grid, stride in strides.items():
            shape = layout.shape(grid, level)
            shapes.append((shape[axis], -(-shape[1 - axis] // stride)))
        for grid, columns in zip(strides, separated(array, shapes), strict=True):
            if layout.grids[grid].interface == (rule == INTERFACES):
                chosen.append((columns, layout.steps(grid, level)[axis]))
    return fitted_to_columns(chosen)


def step(
    arrays: Sequence[NDArray[np.int32]],
    layout: Layout,
    level: int,
    grids: range,
    axis: int,
    predictors: NDArray[np.int8],
) -> None:
    """Step grids of a level, shape (row, column) each, along an axis, in place; predictors as `pyramid.forward` has."""
    for array, grid in zip(arrays, grids, strict=True):
        own = layout.steps(grid, level)[axis]
        if own.midpoints:
            forward_step(array, axis, own, predictor(predictors, layout.grids[grid], own, level, axis))


def details_of(array: NDArray[np.int32], coarse: tuple[int, int]) -> list[NDArray[np.int32]]:
    """What a step of both axes leaves beside the nodes; views, shape (row, column).

    ``array`` is the grid's, shape (row, column), of which the first rows and columns are the nodes, ``coarse`` of them.
    """
    return [array[coarse[0] :], array[: coarse[0], coarse[1] :]]


def largest_of(arrays: Sequence[NDArray[np.int32]]) -> int:
    """The largest magnitude in arrays of any shape; 0 of none."""
    return max((max(int(array.max()), -int(array.min())) for array in arrays if array.size), default=0)


def coefficients_of(
    arrays: Sequence[NDArray[np.int32]], table: TileTable, grids: range, tiles: range
) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
    """What tiles have in the flat array of all coefficients, and their bit-planes, int8, shape (tile,).

    Parameters
    ----------
    arrays : sequence of int32 arrays, shape (row, column)
        Of the grids of these tiles after the steps of both axes.
    table : TileTable
        Of all tiles.
    grids, tiles : range
        As of a `GridRun`.
    """
    part = part_of(table, [tiles])
    flat = gather(part.table, arrays, grids=grids)
    planes = np.array([planes_of(part.table, flat, tile) for tile in range(len(tiles))], np.int8)
    return flat[part.spans[0][1]], planes
