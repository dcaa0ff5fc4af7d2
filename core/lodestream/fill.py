"""Values under the holes of a surface, such that they cost few bytes.

`fill_holes` lays a thin plate through what is around them. Averages of 2 x 2 points are taken until there are no
holes left; on the way back each hole takes what the coarser grid has there, in a straight line between its points, and
some sweeps bring it to where a plate would lie. Coarser grids are swept more often, so the work is in proportion to the
number of points.

`settle_holes` then makes small coefficients vanish, in turns: transform, drop what is below a threshold, transform
back, put the valid points back where they were; each time with a lower threshold.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .layout import Layout
from .lifting import forward_step
from .numba_kernels import kernel
from .predictors import predictor
from .surface import Closed
from .transform import allocate, forward, inverse

__all__ = ["fill_holes", "settle_holes"]

#: Sweeps, there and back, of the finest grid; each coarser one has so many more.
_SWEEPS = 4
_MORE = 10
#: Each moves a point further than to its place, so that fewer are needed.
_OVER = 1.4
#: The first threshold, in medians of the coefficients' magnitudes; each further one is half of the one before.
_FIRST_THRESHOLD = 4


def fill_holes(values: NDArray[Any], mask: NDArray[np.bool_], closed: Closed) -> NDArray[Any]:
    """Fill holes smoothly.

    Parameters
    ----------
    values : integers or floats, shape (row, column) or (row, column, channel)
        What stands under a hole, NaN too, does not matter. Not changed.
    mask : bool, shape (row, column)
        True where a point is valid.
    closed : (bool, bool)
        Whether the rows and the columns wrap.

    Returns
    -------
    array
        A new one of the same shape and dtype: valid points as they were, holes within the range of their channel's
        valid points; 0 where there are none.
    """
    filled = values.copy()
    if mask.all():
        return filled
    if not mask.any():
        filled[...] = 0
        return filled
    channels = filled[..., np.newaxis] if filled.ndim == 2 else filled
    known = np.ascontiguousarray(mask)
    for channel in range(channels.shape[2]):
        own = channels[..., channel]
        low, high = own[known].min(), own[known].max()
        heights = np.where(known, own, 0).astype(np.float64)
        _fill(heights, known, closed, _SWEEPS)
        if values.dtype.kind in "iu":
            np.rint(heights, out=heights)
        inside = np.clip(heights[~known], float(low), float(high)).astype(values.dtype)
        own[~known] = np.clip(inside, low, high)
    return filled


def settle_holes(coordinates: NDArray[np.int32], mask: NDArray[np.bool_], layout: Layout) -> NDArray[np.int32]:
    """Move what is under holes so that the transform has fewer coefficients to code.

    Parameters
    ----------
    coordinates : int32, shape (row, column)
        Lattice coordinates of one channel, holes filled (`fill_holes`). Not changed.
    mask : bool, shape (row, column)
        True where a point is valid.
    layout : Layout
        As the channel will be coded, of one grid.

    Returns
    -------
    int32, shape (row, column)
        The same at valid points; holes within the range of the valid points.
    """
    settled = coordinates.copy()
    if mask.all() or not mask.any():
        return settled
    low, high = coordinates[mask].min(), coordinates[mask].max()
    work = allocate(layout.grids[0].shape)
    rows, columns = layout.shape(0, 0)
    work[...] = settled
    predictors = forward([work], layout)
    threshold = _FIRST_THRESHOLD * max(2, int(np.median(np.abs(work[::3, ::3]))))
    while threshold:
        coarsest = work[:rows, :columns].copy()
        work[np.abs(work) <= threshold] = 0
        work[:rows, :columns] = coarsest
        inverse([work], layout, predictors, layout.levels)
        np.copyto(settled, np.clip(work, low, high), where=~mask)
        threshold >>= 1
        if threshold:
            work[...] = settled
            _forward_again(work, layout, predictors)
    return settled


def _forward_again(values: NDArray[np.int32], layout: Layout, predictors: NDArray[np.int8]) -> None:
    """The forward transform with predictors that are known."""
    for level in range(layout.levels, 0, -1):
        rows, columns = layout.shape(0, level)
        for axis, step in enumerate(layout.steps(0, level)):
            if step.midpoints:
                rule = predictor(predictors, layout.grids[0], step, level, axis)
                forward_step(values[:rows, :columns], axis, step, rule)


def _fill(values: NDArray[np.float64], known: NDArray[np.bool_], closed: Closed, sweeps: int) -> None:
    """Fill one grid by way of coarser ones, in place."""
    shape = ((values.shape[0] + 1) // 2, (values.shape[1] + 1) // 2)
    coarser, found = np.empty(shape, np.float64), np.empty(shape, np.bool_)
    _pull(values, known, coarser, found)
    if not found.all():
        _fill(coarser, found, closed, sweeps + _MORE)
    _push(values, known, coarser, *closed)
    _relax(values, known, sweeps, *closed)


@kernel
def _pull(
    values: NDArray[np.float64],
    known: NDArray[np.bool_],
    coarser: NDArray[np.float64],
    found: NDArray[np.bool_],
) -> None:
    """Means of each 2 x 2 whose points are all known, or are known in part where no neighbour's all are.

    The mean of a part is not that of the middle: beside better ones it would do more harm than good.
    """
    rows, columns = values.shape
    height, width = coarser.shape
    whole = np.zeros((height + 2, width + 2), np.bool_)
    for i in range(height):
        for j in range(width):
            total, count, points = 0.0, 0, 0
            for k in range(2 * i, min(2 * i + 2, rows)):
                for m in range(2 * j, min(2 * j + 2, columns)):
                    points += 1
                    if known[k, m]:
                        total += 0.25 * values[k, m]
                        count += 1
            found[i, j] = count > 0
            whole[i + 1, j + 1] = count == points
            coarser[i, j] = total * (4.0 / count) if count else 0.0
    for i in range(height):
        for j in range(width):
            if found[i, j] and not whole[i + 1, j + 1]:
                for k in range(i, i + 3):
                    for m in range(j, j + 3):
                        if whole[k, m]:
                            found[i, j] = False


@kernel
def _beside(place: int, step: int, length: int, wraps: bool) -> int:
    """The neighbour at one side; at the end of an open axis, the place itself."""
    other = place + step
    if wraps:
        return other % length
    return min(max(other, 0), length - 1)


@kernel
def _push(
    values: NDArray[np.float64],
    known: NDArray[np.bool_],
    coarser: NDArray[np.float64],
    rows_wrap: bool,
    columns_wrap: bool,
) -> None:
    """Give holes what the coarser grid has at their place, by bilinear interpolation."""
    height, width = coarser.shape
    for i in range(values.shape[0]):
        near = i >> 1
        far = _beside(near, 2 * (i & 1) - 1, height, rows_wrap)
        for j in range(values.shape[1]):
            if known[i, j]:
                continue
            here = j >> 1
            there = _beside(here, 2 * (j & 1) - 1, width, columns_wrap)
            at_near = 0.75 * coarser[near, here] + 0.25 * coarser[near, there]
            at_far = 0.75 * coarser[far, here] + 0.25 * coarser[far, there]
            values[i, j] = 0.75 * at_near + 0.25 * at_far


@kernel
def _relax(
    values: NDArray[np.float64], known: NDArray[np.bool_], sweeps: int, rows_wrap: bool, columns_wrap: bool
) -> None:
    """Bring holes to where a plate would lie through what is around them, sweeping there and back."""
    height, width = values.shape
    for sweep in range(2 * sweeps):
        for row in range(height):
            i = height - 1 - row if sweep & 1 else row
            up, down = _beside(i, -1, height, rows_wrap), _beside(i, 1, height, rows_wrap)
            top, bottom = _beside(i, -2, height, rows_wrap), _beside(i, 2, height, rows_wrap)
            for column in range(width):
                j = width - 1 - column if sweep & 1 else column
                if known[i, j]:
                    continue
                left, right = _beside(j, -1, width, columns_wrap), _beside(j, 1, width, columns_wrap)
                west, east = _beside(j, -2, width, columns_wrap), _beside(j, 2, width, columns_wrap)
                near = (values[up, j] + values[down, j]) + (values[i, left] + values[i, right])
                corners = (values[up, left] + values[down, right]) + (values[up, right] + values[down, left])
                far = (values[top, j] + values[bottom, j]) + (values[i, west] + values[i, east])
                target = 0.4 * near - 0.1 * corners - 0.05 * far
                values[i, j] += _OVER * (target - values[i, j])
