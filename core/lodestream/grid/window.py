"""Windows of a grid: half-open ranges of rows and columns, which may continue across the seam of a closed axis.

Along an open axis of N samples a window runs from ``start`` to before ``stop`` with 0 <= start < stop <= N. Along a
closed one ``start`` is below N and ``stop`` at most ``start + N``: sample N is sample 0 again. All code that
distinguishes windows of closed axes is in this module.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError
from ..target import Region

__all__ = [
    "aligned",
    "among",
    "check_region",
    "contains",
    "hull",
    "is_whole",
    "meets",
    "places",
    "samples",
    "spanning",
    "spans",
    "taken",
    "within",
]

Span = tuple[int, int]
Shape = tuple[int, int]


def check_region(region: Region, shape: Shape, closed: tuple[bool, bool] = (False, False)) -> None:
    """Raise an error for a window that does not lie in a grid.

    Raises
    ------
    OptionError
        If it has no point, points beyond the end of an open axis, or a point of a closed axis twice.
    """
    for (start, stop), length, wraps, name in zip(region, shape, closed, ("rows", "columns"), strict=True):
        if wraps and 0 <= start < length and start < stop <= start + length:
            continue
        if not 0 <= start < stop <= length:
            seam = f", or across the seam up to {start}:{start + length}" if wraps and 0 <= start < length else ""
            raise OptionError(f"expected {name} within 0:{length}{seam}, at least one, got {start}:{stop}")


def spans(span: Span, length: int) -> list[Span]:
    """Return the one or two parts of a window along an axis that do not cross the seam, in the window's order."""
    start, stop = span
    return [span] if stop <= length else [(start, length), (0, stop - length)]


def places(span: Span, length: int) -> NDArray[np.int64]:
    """Return the samples of an axis in a window, in the window's order; int64, shape (sample,)."""
    return np.arange(*span) % length


def samples(span: Span, length: int) -> NDArray[np.bool_]:
    """Return which samples of an axis are in a window; bool, shape (sample,)."""
    inside = np.zeros(length, np.bool_)
    for start, stop in spans(span, length):
        inside[start:stop] = True
    return inside


def meets(span: Span, part: Span, length: int) -> bool:
    """Return whether a window has samples of a part of the axis, a half-open span that does not cross the seam."""
    return any(start < part[1] and part[0] < stop for start, stop in spans(span, length))


def contains(outer: Region, inner: Region, shape: Shape) -> bool:
    """Return whether all points of a window are in another one of the same grid."""
    for (first, last), (start, stop), length in zip(outer, inner, shape, strict=True):
        if last - first < length and (start - first) % length + stop - start > last - first:
            return False
    return True


def aligned(region: Region, shape: Shape, sizes: Sequence[int]) -> Region:
    """Return the smallest window around another one that consists of whole cells of ``sizes`` rows and columns.

    Cells begin with the first sample of an axis; the last one of an axis may be smaller.
    """
    rounded = []
    for (start, stop), length, size in zip(region, shape, sizes, strict=True):
        begin = start // size * size
        turn = length if stop > length else 0
        end = turn + min(-(-(stop - turn) // size) * size, length)
        rounded.append((0, length) if end - begin >= length else (begin, end))
    return rounded[0], rounded[1]


def among(region: Region, shape: Shape, nodes: Sequence[NDArray[np.int64]]) -> Region | None:
    """Return the window of a coarser grid of the points that lie in a window of this one; None if there are none.

    Parameters
    ----------
    region : ((int, int), (int, int))
        Rows and columns, half-open, of this grid.
    shape : (int, int)
        Rows and columns of this grid.
    nodes : two int64 arrays, shape (row,) and (column,)
        The rows and columns of this grid at which those of the coarser grid lie, ascending.

    Returns
    -------
    ((int, int), (int, int)) or None
        Rows and columns, half-open, of the coarser grid; across its seam where ``region`` crosses the seam.
    """
    window = []
    for span, length, line in zip(region, shape, nodes, strict=True):
        parts = [np.searchsorted(line, part).tolist() for part in spans(span, length)]
        count, start = sum(stop - start for start, stop in parts), parts[0][0]
        if not count:
            return None
        start = 0 if start == len(line) else start  # the first node lies beyond the seam
        window.append((start, start + count))
    return window[0], window[1]


def spanning(window: Region, shape: Shape, nodes: Sequence[NDArray[np.int64]]) -> Region:
    """Return the smallest window of this grid with all points of a window of a coarser one; the inverse of `among`.

    Parameters
    ----------
    window : ((int, int), (int, int))
        Rows and columns, half-open, of the coarser grid.
    shape, nodes
        As in `among`.
    """
    region = []
    for (start, stop), length, line in zip(window, shape, nodes, strict=True):
        turns, last = divmod(stop - 1, len(line))
        region.append((int(line[start]), int(line[last]) + 1 + turns * length))
    return region[0], region[1]


def hull(region: Region, shape: Shape) -> Region:
    """Return the smallest window around another one that crosses no seam: the whole axis where that one does."""
    rows, columns = (span if span[1] <= length else (0, length) for span, length in zip(region, shape, strict=True))
    return rows, columns


def taken(array: NDArray[Any], region: Region, shape: Shape, first: Span = (0, 0)) -> NDArray[Any]:
    """Return a window of the array of a grid, shape (row, column, ...); a view where it crosses no seam.

    ``shape`` is the grid's. The array begins at row and column ``first`` of the grid, which are 0 where the window
    crosses the seam.
    """
    for axis, (span, length) in enumerate(zip(region, shape, strict=True)):
        if span[1] <= length:
            array = array[(slice(None),) * axis + (slice(span[0] - first[axis], span[1] - first[axis]),)]
        else:
            array = array.take(places(span, length), axis=axis)
    return array


def within(array: NDArray[Any], around: Region, region: Region, shape: Shape) -> NDArray[Any]:
    """Return a window from the array of a window around it; a view where it is contiguous.

    ``array`` has the shape (row, column, ...) of the window ``around``; ``shape`` is the grid's.
    """
    for axis, ((first, last), (start, stop), length) in enumerate(zip(around, region, shape, strict=True)):
        if last - first == length:  # the whole axis: the window may continue from its end to its begin
            array = _along(array, axis, (start - first) % length, stop - start, length)
        else:
            begin = start - first if start >= first else start + length - first
            array = array[(slice(None),) * axis + (slice(begin, begin + stop - start),)]
    return array


def _along(array: NDArray[Any], axis: int, start: int, count: int, length: int) -> NDArray[Any]:
    """Return ``count`` samples of an axis from ``start`` on, continuing at the first; a view where contiguous."""
    if start + count <= length:
        return array[(slice(None),) * axis + (slice(start, start + count),)]
    return array.take(places((start, start + count), length), axis=axis)


def is_whole(region: Region, shape: Shape) -> bool:
    """Return whether a window has all points of a grid, from whatever point it starts."""
    return all(stop - start == length for (start, stop), length in zip(region, shape, strict=True))
