"""Windows of a grid: rows and columns, half-open, which along a closed axis may go on across its seam.

Along an open axis of N samples a window runs from ``start`` to before ``stop`` with 0 <= start < stop <= N. Along a
closed one ``start`` is below N and ``stop`` at most ``start + N``: sample N is sample 0 again. Everything that treats a
window of a closed axis unlike others is here.
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
    """Refuse a window that a grid does not have.

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
    """The parts of a window along an axis that do not cross the seam, in the window's order: one or two."""
    start, stop = span
    return [span] if stop <= length else [(start, length), (0, stop - length)]


def places(span: Span, length: int) -> NDArray[np.int64]:
    """The samples of an axis in a window, in the window's order; int64, shape (sample,)."""
    return np.arange(*span) % length


def samples(span: Span, length: int) -> NDArray[np.bool_]:
    """Which samples of an axis are in a window; bool, shape (sample,)."""
    inside = np.zeros(length, np.bool_)
    for start, stop in spans(span, length):
        inside[start:stop] = True
    return inside


def meets(span: Span, part: Span, length: int) -> bool:
    """Whether a window has samples of a part of the axis, a half-open span that does not cross the seam."""
    return any(start < part[1] and part[0] < stop for start, stop in spans(span, length))


def contains(outer: Region, inner: Region, shape: Shape) -> bool:
    """Whether all points of a window are in another one of the same grid."""
    for (first, last), (start, stop), length in zip(outer, inner, shape, strict=True):
        if last - first < length and (start - first) % length + stop - start > last - first:
            return False
    return True


def aligned(region: Region, shape: Shape, sizes: Sequence[int]) -> Region:
    """The smallest window around another one that is made of whole cells of so many rows and columns.

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
    """The window of a coarser grid that has the points of it that stand in a window of this one; None if none does.

    Parameters
    ----------
    region : ((int, int), (int, int))
        Rows and columns, half-open, of this grid.
    shape : (int, int)
        Of this grid.
    nodes : two int64 arrays, shape (row,) and (column,)
        The rows and the columns of this grid at which those of the coarser one stand, increasing.

    Returns
    -------
    ((int, int), (int, int)) or None
        Rows and columns, half-open, of the coarser grid; across its seam where ``region`` crosses this one's.
    """
    found = []
    for span, length, line in zip(region, shape, nodes, strict=True):
        parts = [np.searchsorted(line, part).tolist() for part in spans(span, length)]
        count, start = sum(stop - start for start, stop in parts), parts[0][0]
        if not count:
            return None
        start = 0 if start == len(line) else start  # the first one stands beyond the seam
        found.append((start, start + count))
    return found[0], found[1]


def spanning(window: Region, shape: Shape, nodes: Sequence[NDArray[np.int64]]) -> Region:
    """The smallest window of this grid that has the points of a window of a coarser one; undoes `among`.

    Parameters
    ----------
    window : ((int, int), (int, int))
        Rows and columns, half-open, of the coarser grid.
    shape, nodes
        As of `among`.
    """
    found = []
    for (start, stop), length, line in zip(window, shape, nodes, strict=True):
        turns, last = divmod(stop - 1, len(line))
        found.append((int(line[start]), int(line[last]) + 1 + turns * length))
    return found[0], found[1]


def hull(region: Region, shape: Shape) -> Region:
    """The smallest window around another one that crosses no seam: all of an axis along which that one does."""
    rows, columns = (span if span[1] <= length else (0, length) for span, length in zip(region, shape, strict=True))
    return rows, columns


def taken(array: NDArray[Any], region: Region, shape: Shape, first: Span = (0, 0)) -> NDArray[Any]:
    """The window of an array of a grid of this shape, shape (row, column, ...); a view where it crosses no seam.

    The array begins at row and column ``first`` of the grid, which are 0 where the window crosses the seam.
    """
    for axis, (span, length) in enumerate(zip(region, shape, strict=True)):
        if span[1] <= length:
            array = array[(slice(None),) * axis + (slice(span[0] - first[axis], span[1] - first[axis]),)]
        else:
            array = array.take(places(span, length), axis=axis)
    return array


def within(array: NDArray[Any], around: Region, region: Region, shape: Shape) -> NDArray[Any]:
    """The part of an array of a window around another one that belongs to this; a view where it is one piece.

    ``array`` has the shape (row, column, ...) of the window ``around``; ``shape`` is the grid's.
    """
    for axis, ((first, last), (start, stop), length) in enumerate(zip(around, region, shape, strict=True)):
        if last - first == length:  # all of the axis, from wherever: the window may go on from its end to its begin
            array = _along(array, axis, (start - first) % length, stop - start, length)
        else:
            begin = start - first if start >= first else start + length - first
            array = array[(slice(None),) * axis + (slice(begin, begin + stop - start),)]
    return array


def _along(array: NDArray[Any], axis: int, start: int, count: int, length: int) -> NDArray[Any]:
    """So many samples of an axis from one on, going on with the first ones; a view where they are one piece."""
    if start + count <= length:
        return array[(slice(None),) * axis + (slice(start, start + count),)]
    return array.take(places((start, start + count), length), axis=axis)


def is_whole(region: Region, shape: Shape) -> bool:
    """Whether a window has all points of a grid, from whatever point it starts."""
    return all(stop - start == length for (start, stop), length in zip(region, shape, strict=True))
