"""The grids of a surface of several blocks: curves along which parts meet, and parts of blocks.

A side that two parts share is a curve of its own, coded once, from which both take their points; so does a side that is
collapsed to a point (a pole), whose curve is that one point. Curves that meet in the corner of a part have that point
in common: the first of them holds it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from .layout import Grid, Source
from .sides import Arrangement, Part, Side
from .surface import Closed

__all__ = ["VertexCounter", "covers", "grids_of"]


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
    return area == whole[0] * whole[1] and not any(
        a < f and e < b and c < h and g < d for k, ((a, b), (c, d)) in enumerate(cells) for (e, f), (g, h) in cells[:k]
    )


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
