"""Points of a surface that are one point, by number and not by value.

Points are numbered over all blocks of the whole surface at full resolution, block after block, each in row order.
Two points may lie at one place, and may then also be one vertex: at one place with the same attributes. For a surface
from a container, its header has both, so that a coarse reconstruction is connected as the exact surface is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["Change", "Groups", "Joints", "Nodes", "Runs", "check_runs", "find_change"]

Numbers = NDArray[np.int64]
#: Rows of numbers as encoded by `to_runs`.
Runs = tuple[int, ...]
#: Rows and columns of a block that are the nodes of a grid, in order.
Nodes = tuple[Numbers, Numbers]


class Change(NamedTuple):
    """Difference between two groupings of points.

    Attributes
    ----------
    dissolved : int64 array, shape (D,)
        Points whose groups are dissolved: their members become single.
    joined : int64 array, shape (J, 2)
        Pairs of points whose groups are joined after that.
    """

    dissolved: Numbers
    joined: Numbers

    @property
    def runs(self) -> tuple[Runs, Runs]:
        """Both arrays as encoded by `to_runs`."""
        return to_runs(self.dissolved[:, np.newaxis]), to_runs(self.joined)

    @staticmethod
    def of(runs: tuple[Runs, Runs]) -> Change:
        """Decode `runs`."""
        return Change(from_runs(runs[0], 1)[:, 0], from_runs(runs[1], 2))


@dataclass(frozen=True)
class Groups:
    """Groups of points that are one.

    Attributes
    ----------
    points, firsts : int64 arrays, shape (K,)
        Points in groups of two or more, ascending, and the lowest point of the group of each. Other points are single.
    """

    points: Numbers
    firsts: Numbers

    @staticmethod
    def none() -> Groups:
        """Return groups in which all points are single."""
        return Groups(np.empty(0, np.int64), np.empty(0, np.int64))

    @staticmethod
    def of(pairs: Numbers) -> Groups:
        """Return the groups that pairs of points, shape (J, 2), make."""
        points, place = np.unique(pairs.reshape(-1), return_inverse=True)
        left, right = place.reshape(-1, 2).T
        label = np.arange(len(points))
        while (label[left] != label[right]).any():
            low = np.minimum(label[left], label[right])
            for end in (left, right):
                np.minimum.at(label, label[end], low)
            while (label != label[label]).any():
                label = label[label]
        several = np.bincount(label, minlength=len(points))[label] > 1
        return Groups(points[several], points[label[several]])

    def first(self, numbers: Numbers) -> Numbers:
        """Return the lowest point of each point's group, int64, the shape of ``numbers``."""
        if not self.points.size:
            return numbers
        place = np.minimum(np.searchsorted(self.points, numbers), self.points.size - 1)
        return np.where(self.points[place] == numbers, self.firsts[place], numbers)

    def changed(self, change: Change) -> Groups:
        """Return the groups after a change."""
        if not change.dissolved.size and not change.joined.size:
            return self
        kept = ~np.isin(self.firsts, self.first(change.dissolved))
        pairs = np.stack([self.points[kept], self.firsts[kept]], axis=-1)
        return Groups.of(np.concatenate([pairs, change.joined]))


def find_change(numbers: Numbers, groups: Groups, wanted: Numbers) -> Change:
    """Find the change after which groups distinguish some points as given numbers do.

    Parameters
    ----------
    numbers : int64 array, shape (N,)
        The points that are compared, each once.
    groups : Groups
    wanted : int64 array, shape (N,)
        Equal for points that are to be one.
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
    """Encode rows of numbers, shape (N, D), as runs with even steps: first row, steps, and number of rows of each."""
    runs: list[int] = []
    steps = np.diff(rows, axis=0).tolist()
    start = 0
    while start < len(rows):
        stop = start + 1
        while stop < len(rows) and steps[stop - 1] == steps[start]:
            stop += 1
        step = steps[start] if stop - start > 1 else [0] * rows.shape[1]
        runs += [*rows[start].tolist(), *step, stop - start]
        start = stop
    return tuple(runs)


def check_runs(runs: Any, width: int, points: int) -> Runs:
    """Check runs of rows of ``width`` numbers from 0 to ``points`` - 1, with at most ``points`` rows; return them.

    Raises
    ------
    ValueError
        When they are malformed.
    """
    run_length = 2 * width + 1
    if not isinstance(runs, list) or len(runs) % run_length or not all(type(number) is int for number in runs):
        raise ValueError(f"expected runs of {run_length} whole numbers, got others")
    total = 0
    for start in range(0, len(runs), run_length):
        *numbers, count = runs[start : start + run_length]
        total += max(count, 1)
        ends = [a + (count - 1) * b for a, b in zip(numbers[:width], numbers[width:], strict=True)]
        if count < 1 or total > points or not all(0 <= end < points for end in (*numbers[:width], *ends)):
            raise ValueError(f"expected runs of points below {points}, got {runs[start : start + run_length]}")
    return tuple(runs)


def from_runs(runs: Runs, width: int) -> Numbers:
    """Decode runs of `to_runs` that `check_runs` has accepted, for rows of ``width`` numbers; int64, shape (N, D)."""
    rows = [np.empty((0, width), np.int64)]
    for start in range(0, len(runs), 2 * width + 1):
        *numbers, count = runs[start : start + 2 * width + 1]
        steps = np.array(numbers[width:] if count > 1 else [0] * width, np.int64)
        rows.append(np.array(numbers[:width], np.int64) + np.arange(count)[:, None] * steps)
    return np.concatenate(rows)


@dataclass(frozen=True)
class Joints:
    """The points of a surface's grids that lie at one place, and those that are one vertex.

    Attributes
    ----------
    shapes : tuple of (int, int)
        Rows and columns of each block of the whole surface at full resolution.
    places, vertices : Groups
    nodes : tuple of (int64 array, int64 array), one for each block, or None
        Rows and columns that are the nodes of the grids, as at a level or in a window; None: all.
    """

    shapes: tuple[tuple[int, int], ...]
    places: Groups
    vertices: Groups
    nodes: tuple[Nodes, ...] | None = None

    def at(self, nodes: Sequence[Nodes]) -> Joints:
        """Return the joints of the subgrids given by these rows and columns."""
        if self.nodes is None:
            return Joints(self.shapes, self.places, self.vertices, tuple(nodes))
        composed = tuple(
            (old[0][rows], old[1][columns]) for old, (rows, columns) in zip(self.nodes, nodes, strict=True)
        )
        return Joints(self.shapes, self.places, self.vertices, composed)

    def number(self, block: int, rows: Numbers, columns: Numbers) -> Numbers:
        """Return the numbers in the whole surface of points of a grid; rows and columns of shapes that broadcast."""
        if self.nodes is not None:
            rows, columns = self.nodes[block][0][rows], self.nodes[block][1][columns]
        start = sum(height * width for height, width in self.shapes[:block])
        return np.asarray(start + rows * self.shapes[block][1] + columns, np.int64)
