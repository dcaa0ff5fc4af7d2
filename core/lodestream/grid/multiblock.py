"""Grids of a surface of several blocks: the patches of blocks, and the interfaces along which patches meet.

A side that two patches share is an interface, coded once, from which both take their points. A side that is collapsed
to a point (a pole) has an interface of this one point. Interfaces that meet in the corner of a patch share that point,
which is stored with the first of them.
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
from .connectivity import Arrangement, Patch, Side
from .layout import Grid, Source

__all__ = ["VertexCounter", "covers", "grids_of", "shared_points"]


def grids_of(arrangement: Arrangement) -> list[Grid]:
    """Return the grids of an arrangement: interfaces first, then patches."""
    owners = _owners(arrangement)
    grids = []
    for number, interface in enumerate(arrangement.interfaces):
        ends: list[Source | None] = [None, None]
        for end in (0, 1):
            owner = owners.get((number, end), (number, end))
            if owner[0] != number or (owner[1] != end and interface.length > 1):
                ends[end] = Source(owner[0], owner[1] == 1)
        if interface.length == 1:
            ends[1] = None
        closed = interface.closed, False
        clamped = not interface.closed, not interface.closed, False, False
        sources = ends[0], ends[1], None, None
        grids.append(Grid((interface.length, 1), closed, clamped, (interface.stops, False), sources, interface=True))
    for patch in arrangement.patches:
        first, last, left, right = (None if s is None else Source(s.interface, s.reversed) for s in patch.sides)
        grids.append(Grid(patch.shape, patch.closed, patch.clamped, patch.stops, (first, last, left, right)))
    return grids


def _owners(arrangement: Arrangement) -> dict[tuple[int, int], tuple[int, int]]:
    """Map every end of an interface to the first end that is the same point; an end is (interface, 0 or 1)."""
    parent: dict[tuple[int, int], tuple[int, int]] = {}

    def find(end: tuple[int, int]) -> tuple[int, int]:
        """Return the root of an end in the union-find structure ``parent``."""
        while (above := parent.get(end, end)) != end:
            end = above
        return end

    def end_of(side: Side, last: int) -> tuple[int, int]:
        """Return the end of an interface at the first or last point of a side."""
        pole = arrangement.interfaces[side.interface].length == 1
        return side.interface, 0 if pole else last ^ side.reversed

    for patch in arrangement.patches:
        for row, column in product((0, 1), (0, 1)):
            along, across = patch.sides[row], patch.sides[2 + column]
            if along is None or across is None or any(patch.closed):
                continue
            a, b = sorted((find(end_of(along, column)), find(end_of(across, row))))
            parent[b] = a
    return {end: find(end) for end in list(parent)}


class VertexCounter:
    """Assigns each vertex of a surface to one of its patches, so that errors count it once."""

    def __init__(self, arrangement: Arrangement) -> None:
        self._interfaces = arrangement.interfaces
        self._owners = _owners(arrangement)
        self._used: set[int] = set()
        self._known: set[tuple[int, int]] = set()

    def count(self, patch: Patch, counted: NDArray[np.bool_]) -> None:
        """Set vertices to False that earlier patches counted, or an earlier place of this; (row, column), as stored."""
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
        for side, line, places in zip(patch.sides, lines, ends, strict=True):
            if side is None:
                continue
            interface = self._interfaces[side.interface]
            if interface.length == 1:
                line[1:] = False  # a pole: the whole line is one vertex
                held.setdefault(self._owners.get((side.interface, 0), (side.interface, 0)), places[0])
                continue
            if side.interface in self._used:
                # Except its ends, which other interfaces may share: these are counted by owner below.
                line[slice(None) if interface.closed else slice(1, -1)] = False
            self._used.add(side.interface)
            if not interface.closed:
                for end, place in enumerate(places):
                    key = side.interface, end ^ side.reversed
                    owner = self._owners.get(key, key)
                    if held.setdefault(owner, place) != place:
                        valid[place] = False
        for owner, place in held.items():
            counted[place] = valid[place] and owner not in self._known
        for place, still in valid.items():
            counted[place] &= still
        self._known.update(held)

    def pass_over(self, patch: Patch) -> None:
        """Assign vertices to a patch as `count` does, without counting them."""
        for side in patch.sides:
            if side is None:
                continue
            interface = self._interfaces[side.interface]
            if interface.length > 1:
                self._used.add(side.interface)
            ends = (0,) if interface.length == 1 else () if interface.closed else (0, 1)
            self._known.update(self._owners.get((side.interface, end), (side.interface, end)) for end in ends)


def shared_points(arrangement: Arrangement, shapes: Sequence[tuple[int, int]]) -> Groups:
    """Return the groups of points of blocks of these shapes that are the same point of an interface.

    Points are numbered over all blocks in order, each block in row-major order.
    """
    starts = np.cumsum([0, *(height * width for height, width in shapes)], dtype=np.int64)
    interfaces = starts[-1] + np.cumsum(
        [0, *(interface.length for interface in arrangement.interfaces)], dtype=np.int64
    )
    pairs = [np.empty((0, 2), np.int64)]
    for patch in arrangement.patches:
        shape = shapes[patch.block]
        rows, columns = (
            np.arange(*window, dtype=np.int64)[:: -1 if flipped else 1] % length
            for window, flipped, length in zip((patch.rows, patch.columns), patch.flipped, shape, strict=True)
        )
        lines = (rows[:1], columns), (rows[-1:], columns), (rows, columns[:1]), (rows, columns[-1:])
        for side, (down, right) in zip(patch.sides, lines, strict=True):
            if side is not None:
                points = starts[patch.block] + (down * shape[1] + right)
                along = np.arange(points.size)[:: -1 if side.reversed else 1]
                # All points of a pole are one.
                along = np.minimum(along, arrangement.interfaces[side.interface].length - 1)
                pairs.append(np.stack([points, interfaces[side.interface] + along], axis=-1))
    groups = Groups.of(np.concatenate(pairs))
    real = groups.points < starts[-1]  # without the points of interfaces, which only connect points of blocks
    return Groups.of(np.stack([groups.points[real], groups.firsts[real]], axis=-1))


def covers(shape: tuple[int, int], closed: Closed, patches: Sequence[Patch]) -> bool:
    """Return whether patches of a block cover each of its cells once; along a closed axis the last cells wrap."""
    cells = [
        (rows, columns)
        for patch in patches
        for rows in _cells(shape[0], closed[0], patch.closed[0], patch.rows)
        for columns in _cells(shape[1], closed[1], patch.closed[1], patch.columns)
    ]
    cells_of_block = [n if wraps else max(n - 1, 1) for n, wraps in zip(shape, closed, strict=True)]
    # As many cells as the block has, and none twice, so every cell is covered.
    area = sum((b - a) * (d - c) for (a, b), (c, d) in cells)
    return area == cells_of_block[0] * cells_of_block[1] and not _overlap(cells)


def _overlap(cells: list[tuple[tuple[int, int], tuple[int, int]]]) -> bool:
    """Return whether any two rectangles, each (rows, columns), have a cell in common.

    A sweep over the rows keeps the occupied columns sorted, so that a rectangle is compared with only two others: there
    may be tens of thousands.
    """
    occupied: list[tuple[int, int]] = []
    ends: list[tuple[int, tuple[int, int]]] = []
    for (first, last), columns in sorted(cells):
        while ends and ends[0][0] <= first:
            occupied.pop(bisect_left(occupied, heappop(ends)[1]))
        place = bisect_left(occupied, columns)
        if (place < len(occupied) and occupied[place][0] < columns[1]) or (
            place and occupied[place - 1][1] > columns[0]
        ):
            return True
        occupied.insert(place, columns)
        heappush(ends, (last, columns))
    return False


def _cells(length: int, wraps: bool, closed: bool, window: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Yield first and past-the-last cell along an axis, in one piece or two."""
    if closed:
        yield 0, length
        return
    start, stop = window[0], max(window[1] - 1, window[0] + 1)
    if not wraps or stop <= length:
        yield start, stop
    else:
        yield start, length
        yield 0, stop - length
