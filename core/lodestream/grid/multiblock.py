"""The grids of a surface of several blocks: curves along which parts meet, and parts of blocks.

A side that two parts share is a curve of its own, coded once, from which both take their points; so does a side that is
collapsed to a point (a pole), whose curve is that one point. Curves that meet in the corner of a part have that point
in common: the first of them holds it.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from heapq import heappop, heappush
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..joints import Groups
from ..surface import Closed
from .connectivity import Arrangement, Part, Side
from .layout import Grid, Source

__all__ = ["VertexCounter", "covers", "grids_of", "shared_points"]


def grids_of(arrangement: Arrangement) -> list[Grid]:
    """The grids of an arrangement: curves first, then parts."""
    owners = _owners(arrangement)
    grids = []
    for number, curve in enumerate(arrangement.curves):
        ends: list[Source | None] = [None, None]
        for end in (0, 1):
            owner = owners.get((number, end), (number, end))
            if owner[0] != number or (owner[1] != end and curve.length > 1):
                ends[end] = Source(owner[0], owner[1] == 1)
        if curve.length == 1:
            ends[1] = None
        closed = curve.closed, False
        clamped = not curve.closed, not curve.closed, False, False
        sources = ends[0], ends[1], None, None
        grids.append(Grid((curve.length, 1), closed, clamped, (curve.stops, False), sources, curve=True))
    for part in arrangement.parts:
        first, last, left, right = (None if s is None else Source(s.curve, s.reversed) for s in part.sides)
        grids.append(Grid(part.shape, part.closed, part.clamped, part.stops, (first, last, left, right)))
    return grids


def _owners(arrangement: Arrangement) -> dict[tuple[int, int], tuple[int, int]]:
    """For every end of a curve the first end of a curve that is the same point; an end is (curve, 0 or 1)."""
    parent: dict[tuple[int, int], tuple[int, int]] = {}

    def find(end: tuple[int, int]) -> tuple[int, int]:
        while (above := parent.get(end, end)) != end:
            end = above
        return end

    def end_of(side: Side, last: int) -> tuple[int, int]:
        pole = arrangement.curves[side.curve].length == 1
        return side.curve, 0 if pole else last ^ side.reversed

    for part in arrangement.parts:
        for row, column in product((0, 1), (0, 1)):
            along, across = part.sides[row], part.sides[2 + column]
            if along is None or across is None or any(part.closed):
                continue
            a, b = sorted((find(end_of(along, column)), find(end_of(across, row))))
            parent[b] = a
    return {end: find(end) for end in list(parent)}


class VertexCounter:
    """Leaves each vertex of a surface to one of its parts, so that errors count it once."""

    def __init__(self, arrangement: Arrangement) -> None:
        self._curves = arrangement.curves
        self._owners = _owners(arrangement)
        self._used: set[int] = set()
        self._known: set[tuple[int, int]] = set()

    def count(self, part: Part, counted: NDArray[np.bool_]) -> None:
        """Set to False what earlier parts counted, or an earlier place of this part; shape (row, column), as stored."""
        last_row, last_column = (n - 1 for n in counted.shape)
        lines = counted[0], counted[-1], counted[:, 0], counted[:, -1]
        ends = (
            ((0, 0), (0, last_column)),
            ((last_row, 0), (last_row, last_column)),
            ((0, 0), (last_row, 0)),
            ((0, last_column), (last_row, last_column)),
        )
        valid = {place: bool(counted[place]) for pair in ends for place in pair}
        held: dict[tuple[int, int], tuple[int, int]] = {}
        for side, line, places in zip(part.sides, lines, ends, strict=True):
            if side is None:
                continue
            curve = self._curves[side.curve]
            if curve.length == 1:
                line[1:] = False
                held.setdefault(self._owners.get((side.curve, 0), (side.curve, 0)), places[0])
                continue
            if side.curve in self._used:
                line[slice(None) if curve.closed else slice(1, -1)] = False
            self._used.add(side.curve)
            if not curve.closed:
                for end, place in enumerate(places):
                    key = side.curve, end ^ side.reversed
                    owner = self._owners.get(key, key)
                    if held.setdefault(owner, place) != place:
                        valid[place] = False
        for owner, place in held.items():
            counted[place] = valid[place] and owner not in self._known
        for place, still in valid.items():
            counted[place] &= still
        self._known.update(held)


def shared_points(arrangement: Arrangement, shapes: Sequence[tuple[int, int]]) -> Groups:
    """The points of blocks of these shapes that are one, since they are the same point of a curve.

    They are numbered over all blocks, one after another, each in row order.
    """
    starts = np.cumsum([0, *(height * width for height, width in shapes)], dtype=np.int64)
    curves = starts[-1] + np.cumsum([0, *(curve.length for curve in arrangement.curves)], dtype=np.int64)
    pairs = [np.empty((0, 2), np.int64)]
    for part in arrangement.parts:
        shape = shapes[part.block]
        rows, columns = (
            np.arange(*window, dtype=np.int64)[:: -1 if flipped else 1] % length
            for window, flipped, length in zip((part.rows, part.columns), part.flipped, shape, strict=True)
        )
        lines = (rows[:1], columns), (rows[-1:], columns), (rows, columns[:1]), (rows, columns[-1:])
        for side, (down, right) in zip(part.sides, lines, strict=True):
            if side is not None:
                points = starts[part.block] + (down * shape[1] + right)
                along = np.arange(points.size)[:: -1 if side.reversed else 1]
                along = np.minimum(along, arrangement.curves[side.curve].length - 1)  # all of a pole are one
                pairs.append(np.stack([points, curves[side.curve] + along], axis=-1))
    found = Groups.of(np.concatenate(pairs))
    real = found.points < starts[-1]  # the points of curves have but helped
    return Groups.of(np.stack([found.points[real], found.firsts[real]], axis=-1))


def covers(shape: tuple[int, int], closed: Closed, parts: Sequence[Part]) -> bool:
    """Whether parts of a block cover each of its cells once; along a closed axis the last cells wrap."""
    cells = [
        (rows, columns)
        for part in parts
        for rows in _cells(shape[0], closed[0], part.closed[0], part.rows)
        for columns in _cells(shape[1], closed[1], part.closed[1], part.columns)
    ]
    whole = [n if wraps else max(n - 1, 1) for n, wraps in zip(shape, closed, strict=True)]
    area = sum((b - a) * (d - c) for (a, b), (c, d) in cells)
    return area == whole[0] * whole[1] and not _overlap(cells)


def _overlap(cells: list[tuple[tuple[int, int], tuple[int, int]]]) -> bool:
    """Whether any two rectangles, each (rows, columns), have a cell in common.

    Row after row the columns that are taken are kept in order, so that each is compared with two others: there may be
    tens of thousands.
    """
    taken: list[tuple[int, int]] = []
    ends: list[tuple[int, tuple[int, int]]] = []
    for (first, last), columns in sorted(cells):
        while ends and ends[0][0] <= first:
            taken.pop(bisect_left(taken, heappop(ends)[1]))
        place = bisect_left(taken, columns)
        if (place < len(taken) and taken[place][0] < columns[1]) or (place and taken[place - 1][1] > columns[0]):
            return True
        taken.insert(place, columns)
        heappush(ends, (last, columns))
    return False


def _cells(length: int, wraps: bool, closed: bool, window: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """First and past-the-last cell along an axis, in one piece or two."""
    if closed:
        yield 0, length
        return
    start, stop = window[0], max(window[1] - 1, window[0] + 1)
    if not wraps or stop <= length:
        yield start, stop
    else:
        yield start, length
        yield 0, stop - length
