"""Fill the holes of a surface with values that cost few bytes.

`fill_holes` lays a thin plate through what is around them. Averages of 2 x 2 points are taken until there are no
holes left; on the way back each hole takes what the coarser grid has there, in a straight line between its points, and
some sweeps bring it to where a plate would lie. Coarser grids are swept more often, so the work is in proportion to the
number of points.

`settle_holes` then makes small coefficients vanish, in turns: transform, drop what is below a threshold, transform
back, put the valid points back where they were; each time with a lower threshold.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from ..grid.layout import Layout
from ..quantization.lattice import to_dtype
from ..scratch import IN_MEMORY, Room, rows_at_once
from ..surface import Closed
from ..transform.lifting import forward_step
from ..transform.predictors import predictor
from ..transform.pyramid import PADDING, forward, inverse

__all__ = ["fill_channel", "fill_holes", "settle_holes"]

#: Sweeps, there and back, of the finest grid; each coarser one has so many more.
_SWEEPS = 4
_MORE = 10
#: The first threshold, in medians of the coefficients' magnitudes; each further one is half of the one before.
_FIRST_THRESHOLD = 4
#: Points in one call of a kernel.
_AT_ONCE = 1 << 20


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
    channels = filled[..., np.newaxis] if filled.ndim == 2 else filled
    for channel in range(channels.shape[2]):
        fill_channel(channels[..., channel], mask, closed)
    return filled


def fill_channel(values: NDArray[Any], mask: NDArray[np.bool_], closed: Closed, room: Room = IN_MEMORY) -> None:
    """Fill the holes of one channel in place; `fill_holes` says how.

    Parameters
    ----------
    values : integers or floats, shape (row, column)
    mask : bool, shape (row, column)
        True where a point is valid; some are not.
    closed : (bool, bool)
    room : Room
        Where large arrays go.
    """
    if not mask.any():
        values[...] = 0
        return
    known = np.ascontiguousarray(mask)
    strips = list(rows_at_once(values.shape))
    ends = [(valid.min(), valid.max()) for rows in strips if (valid := values[rows][known[rows]]).size]
    low, high = min(least for least, _ in ends), max(most for _, most in ends)
    heights = room.empty(values.shape, np.float64)
    for rows in strips:
        heights[rows] = np.where(known[rows], values[rows], 0)
    _fill(heights, known, closed, _SWEEPS, room)
    for rows in strips:
        hidden = ~known[rows]
        clipped = np.clip(heights[rows][hidden], float(low), float(high))
        clipped[np.isnan(clipped)] = low  # sums beyond float64: values that large are refused with their lattice
        inside = to_dtype(clipped, values.dtype)  # the largest integers are no float64, which may be beyond them
        values[rows][hidden] = np.clip(inside, low, high)


def settle_holes(
    coordinates: NDArray[np.int32], mask: NDArray[np.bool_], layout: Layout, room: Room = IN_MEMORY
) -> None:
    """Move the values under holes so that the transform has fewer coefficients to code.

    Parameters
    ----------
    coordinates : int32, shape (row, column)
        Lattice coordinates of one channel, holes filled (`fill_holes`). Those at holes are changed, and stay within the
        range of the valid points.
    mask : bool, shape (row, column)
        True where a point is valid.
    layout : Layout
        As the channel will be coded, of one grid.
    room : Room
        Where an array of the size of the coordinates goes.
    """
    if mask.all() or not mask.any():
        return
    strips = list(rows_at_once(coordinates.shape))
    ends = [(valid.min(), valid.max()) for strip in strips if (valid := coordinates[strip][mask[strip]]).size]
    low, high = min(least for least, _ in ends), max(most for _, most in ends)
    height, width = layout.grids[0].shape
    work = room.empty((height, width + PADDING), np.int32)[:, :width]
    rows, columns = layout.shape(0, 0)
    work[...] = coordinates
    predictors = forward([work], layout)
    threshold = _FIRST_THRESHOLD * max(2, int(np.median(np.abs(work[::3, ::3]))))
    while threshold:
        coarsest = work[:rows, :columns].copy()
        for strip in strips:
            work[strip][np.abs(work[strip]) <= threshold] = 0
        work[:rows, :columns] = coarsest
        inverse([work], layout, predictors, layout.levels)
        for strip in strips:
            np.copyto(coordinates[strip], np.clip(work[strip], low, high), where=~mask[strip])
        threshold >>= 1
        if threshold:
            work[...] = coordinates
            _forward_again(work, layout, predictors)


def _forward_again(values: NDArray[np.int32], layout: Layout, predictors: NDArray[np.int8]) -> None:
    """Run the forward transform with given predictors, in place."""
    for level in range(layout.levels, 0, -1):
        rows, columns = layout.shape(0, level)
        for axis, step in enumerate(layout.steps(0, level)):
            if step.midpoints:
                rule = predictor(predictors, layout.grids[0], step, level, axis)
                forward_step(values[:rows, :columns], axis, step, rule)


def _fill(
    values: NDArray[np.float64], known: NDArray[np.bool_], closed: Closed, sweeps: int, room: Room = IN_MEMORY
) -> None:
    """Fill the holes of one grid in place, from coarser grids."""
    shape = ((values.shape[0] + 1) // 2, (values.shape[1] + 1) // 2)
    coarser, filled = room.empty(shape, np.float64), room.empty(shape, np.bool_)
    for first, last in _runs(coarser.size):
        kernels.pull(values, known, *values.shape, first, last, coarser, filled)
    if not filled.all():
        _fill(coarser, filled, closed, sweeps + _MORE, room)
    for first, last in _runs(values.size):
        kernels.push(values, known, *values.shape, first, last, *closed, coarser)
    for first, last in _runs(2 * sweeps * values.size):
        kernels.relax(values, known, *values.shape, first, last, *closed)


def _runs(count: int) -> Iterator[tuple[int, int]]:
    """Divide ``count`` points into runs, one for each call of a kernel; yield (first, last + 1)."""
    return ((first, min(first + _AT_ONCE, count)) for first in range(0, count, _AT_ONCE))
