"""How a surface of several blocks is coded: parts of blocks, and the curves along which parts meet.

A side that two parts share is a curve of its own, coded once, from which both take their points; so does a side that is
collapsed to a point (a pole), whose curve is that one point. Curves that meet in the corner of a part have that point
in common: the first of them holds it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from .layout import Grid, Sides, Source
from .surface import Closed

__all__ = ["Arrangement", "Curve", "Part", "Side", "grids_of"]


@dataclass(frozen=True)
class Side:
    """A side of a part that is a curve; ``reversed``: the part's order along the side runs against the curve's."""

    curve: int
    reversed: bool


@dataclass(frozen=True)
class Part:
    """What is coded as one grid: a window of a block, perhaps turned round.

    Attributes
    ----------
    block : int
    rows, columns : (int, int)
        The window, half-open, in the block; neighbouring parts have the points at the cut in common.
    closed : (bool, bool)
    flipped : (bool, bool)
        Stored back to front along that axis.
    sides : four Side or None
        Of the part as stored: first row, last row, first column, last column.
    clamped : four bool
        In the same order: that end of an axis keeps its node as it is.
    stops : (bool, bool)
        The axis is not coarsened further once its length is even.
    """

    block: int
    rows: tuple[int, int]
    columns: tuple[int, int]
    closed: Closed = (False, False)
    flipped: tuple[bool, bool] = (False, False)
    sides: tuple[Side | None, Side | None, Side | None, Side | None] = (None, None, None, None)
    clamped: Sides = (False, False, False, False)
    stops: tuple[bool, bool] = (False, False)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows[1] - self.rows[0], self.columns[1] - self.columns[0]


@dataclass(frozen=True)
class Curve:
    """A side that is coded by itself: so many points, closed or open; a single one is a pole."""

    length: int
    closed: bool = False
    stops: bool = False


@dataclass(frozen=True)
class Arrangement:
    """Parts, block by block, and curves."""

    parts: tuple[Part, ...]
    curves: tuple[Curve, ...] = ()


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
        first, last, left, right = (side and Source(side.curve, side.reversed) for side in part.sides)
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


def covers(shape: tuple[int, int], closed: Closed, windows: Sequence[tuple[tuple[int, int], tuple[int, int]]]) -> bool:
    """Whether windows of a block cover each of its cells once; ``closed`` says whether the last cells wrap."""
    if any(closed):
        return len(windows) == 1 and windows[0] == ((0, shape[0]), (0, shape[1]))
    cells = [(r0, max(r1 - 1, r0 + 1), c0, max(c1 - 1, c0 + 1)) for (r0, r1), (c0, c1) in windows]
    area = sum((b - a) * (d - c) for a, b, c, d in cells)
    if area != max(shape[0] - 1, 1) * max(shape[1] - 1, 1):
        return False
    return not any(
        a < f and e < b and c < h and g < d for k, (a, b, c, d) in enumerate(cells) for e, f, g, h in cells[:k]
    )
