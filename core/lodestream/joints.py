"""Which points of a surface are one point, by number and not by value.

Points are numbered over all blocks of the whole surface at full resolution, block after block, each in row order.
Two of them may lie at one place, and then also be one vertex: at one place with the same attributes. Of a surface that
comes out of a container both are known from its header, so that a coarse reconstruction of it
hangs together as the exact one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Change", "Groups", "Joints", "Nodes", "Runs", "check_runs", "find_change"]

Numbers = NDArray[np.int64]
#: Rows of numbers one after another, as `to_runs` writes them.
Runs = tuple[int, ...]
#: Rows and columns of a block that a grid shows, in order.
Nodes = tuple[Numbers, Numbers]


class Change(NamedTuple):
    """What turns groups of points into others.

    Attributes
    ----------
    dissolved : int64 array, shape (D,)
        Points whose groups are no more: their members stand alone.
    joined : int64 array, shape (J, 2)
        Pairs of points whose groups become one after that.
    """

    dissolved: Numbers
    joined: Numbers

    @property
    def runs(self) -> tuple[Runs, Runs]:
        """Both as `to_runs` writes them."""
        return to_runs(self.dissolved[:, np.newaxis]), to_runs(self.joined)

    @staticmethod
    def of(runs: tuple[Runs, Runs]) -> Change:
        """Undo `runs`."""
        return Change(from_runs(runs[0], 1)[:, 0], from_runs(runs[1], 2))


@dataclass(frozen=True)
class Groups:
    """Points that are one.

    Attributes
    ----------
    points, firsts : int64 arrays, shape (K,)
        Points in groups of two or more, increasing, and the lowest of the group of each. All others stand alone.
    """

    points: Numbers
    firsts: Numbers

    @staticmethod
    def none() -> Groups:
        """All points stand alone."""
        return Groups(np.empty(0, np.int64), np.empty(0, np.int64))

    @staticmethod
    def of(pairs: Numbers) -> Groups:
        """The groups that pairs of points make, shape (J, 2)."""
        points, place = np.unique(pairs.reshape(-1), return_inverse=True)
        one, other = place.reshape(-1, 2).T
        label = np.arange(len(points))
        while (label[one] != label[other]).any():
            low = np.minimum(label[one], label[other])
            for end in (one, other):
                np.minimum.at(label, label[end], low)
            while (label != label[label]).any():
                label = label[label]
        several = np.bincount(label, minlength=len(points))[label] > 1
        return Groups(points[several], points[label[several]])

    def first(self, numbers: Numbers) -> Numbers:
        """The lowest point of the group of each, shape (point,) as ``numbers``."""
        if not self.points.size:
            return numbers
        place = np.minimum(np.searchsorted(self.points, numbers), self.points.size - 1)
        return np.where(self.points[place] == numbers, self.firsts[place], numbers)

    def changed(self, change: Change) -> Groups:
        """The groups after a change."""
        if not change.dissolved.size and not change.joined.size:
            return self
        kept = ~np.isin(self.firsts, self.first(change.dissolved))
        pairs = np.stack([self.points[kept], self.firsts[kept]], axis=-1)
        return Groups.of(np.concatenate([pairs, change.joined]))


def find_change(numbers: Numbers, groups: Groups, wanted: Numbers) -> Change:
    """What makes groups tell some points apart as equal numbers do.

    Parameters
    ----------
    numbers : int64 array, shape (N,)
        The points that count, each once.
    groups : Groups
    wanted : int64 array, shape (N,)
        Equal for points that shall be one.
    """
    now = groups.first(numbers)
    held, place = np.unique(now, return_inverse=True)
    low, high = np.full(held.shape, np.iinfo(np.int64).max), np.full(held.shape, np.iinfo(np.int64).min)
    np.minimum.at(low, place, wanted)
    np.maximum.at(high, place, wanted)
    mixed = low != high
    now = np.where(mixed[place], numbers, now)
    rows = np.unique(np.stack([wanted, now], axis=-1), axis=0)
    again = np.flatnonzero(rows[1:, 0] == rows[:-1, 0]) + 1
    start = np.maximum.accumulate(np.where(np.isin(np.arange(len(rows)), again), 0, np.arange(len(rows))))
    joined = np.stack([rows[again, 1], rows[start[again], 1]], axis=-1)
    return Change(held[mixed], joined[np.argsort(joined[:, 0], kind="stable")])


def to_runs(rows: Numbers) -> Runs:
    """Rows of numbers, shape (N, D), as runs with even steps: for each its first row, its steps, and how many rows."""
    found: list[int] = []
    steps = np.diff(rows, axis=0).tolist()
    start = 0
    while start < len(rows):
        stop = start + 1
        while stop < len(rows) and steps[stop - 1] == steps[start]:
            stop += 1
        step = steps[start] if stop - start > 1 else [0] * rows.shape[1]
        found += [*rows[start].tolist(), *step, stop - start]
        start = stop
    return tuple(found)


def check_runs(runs: Any, width: int, points: int) -> Runs:
    """Runs of rows of ``width`` numbers from 0 to ``points`` - 1, and no more rows than points, as they came.

    Raises
    ------
    ValueError
        When they are of another form.
    """
    one = 2 * width + 1
    if not isinstance(runs, list) or len(runs) % one or not all(type(number) is int for number in runs):
        raise ValueError(f"expected runs of {one} whole numbers, got others")
    total = 0
    for start in range(0, len(runs), one):
        *numbers, count = runs[start : start + one]
        total += max(count, 1)
        ends = [a + (count - 1) * b for a, b in zip(numbers[:width], numbers[width:], strict=True)]
        if count < 1 or total > points or not all(0 <= end < points for end in (*numbers[:width], *ends)):
            raise ValueError(f"expected runs of points below {points}, got {runs[start : start + one]}")
    return tuple(runs)


def from_runs(runs: Runs, width: int) -> Numbers:
    """Undo `to_runs`, for rows of ``width`` numbers, which `check_runs` has seen."""
    rows = [np.empty((0, width), np.int64)]
    for start in range(0, len(runs), 2 * width + 1):
        *numbers, count = runs[start : start + 2 * width + 1]
        steps = np.array(numbers[width:] if count > 1 else [0] * width, np.int64)
        rows.append(np.array(numbers[:width], np.int64) + np.arange(count)[:, None] * steps)
    return np.concatenate(rows)


@dataclass(frozen=True)
class Joints:
    """What is known of the points that a surface's grids show: which lie at one place, and which are one vertex.

    Attributes
    ----------
    shapes : tuple of (int, int)
        Rows and columns of each block of the whole surface at full resolution.
    places, vertices : Groups
    nodes : tuple of (int64 array, int64 array), one for each block, or None
        Which rows and columns the grids show, as at a level or in a window; None: all.
    """

    shapes: tuple[tuple[int, int], ...]
    places: Groups
    vertices: Groups
    nodes: tuple[Nodes, ...] | None = None

    def at(self, nodes: Sequence[Nodes]) -> Joints:
        """What is known of grids that show these rows and columns of those that this is of."""
        if self.nodes is None:
            return Joints(self.shapes, self.places, self.vertices, tuple(nodes))
        composed = tuple(
            (old[0][rows], old[1][columns]) for old, (rows, columns) in zip(self.nodes, nodes, strict=True)
        )
        return Joints(self.shapes, self.places, self.vertices, composed)

    def number(self, block: int, rows: Numbers, columns: Numbers) -> Numbers:
        """Numbers in the whole surface of points of a grid; all of one shape, or of shapes that broadcast."""
        if self.nodes is not None:
            rows, columns = self.nodes[block][0][rows], self.nodes[block][1][columns]
        start = sum(height * width for height, width in self.shapes[:block])
        return np.asarray(start + rows * self.shapes[block][1] + columns, np.int64)
