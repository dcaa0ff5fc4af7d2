"""Samples: numbered once for all blocks, which so share those on their sides, and placed by the maps of cells."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .layout import Block, Link
from .maps import Maps
from .rims import Rims
from .triangulation import Floats, Integers

__all__ = ["Grids", "number_samples", "place_samples", "quads_of", "triangles_of", "upsample"]


@dataclass(frozen=True)
class Grids:
    """Blocks of samples.

    Attributes
    ----------
    numbers : int64 array of shape (B, n + 1, n + 1)
        For each block, row and column the sample. Samples on the sides of blocks are those of their neighbours too.
    count : int
        Number of samples.
    """

    numbers: Integers
    count: int

    @property
    def intervals(self) -> int:
        """Quads along a side of a block."""
        return int(self.numbers.shape[1]) - 1


def quads_of(numbers: Integers) -> Integers:
    """Return quads between samples, counter-clockwise, (Q, 4)."""
    corners = numbers[:, :-1, :-1], numbers[:, :-1, 1:], numbers[:, 1:, 1:], numbers[:, 1:, :-1]
    return np.stack(corners, axis=-1).reshape(-1, 4)


def triangles_of(numbers: Integers) -> Integers:
    """Return the halves of quads, (2 Q, 3): first all lower ones, then all upper ones."""
    quads = quads_of(numbers)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


class _Sides:
    """Samples on the sides of blocks, which are lines between the centres of two cells."""

    def __init__(self, cells: int, intervals: int) -> None:
        self.intervals = intervals
        self.count = cells
        self._lines: dict[tuple[int, int], Integers] = {}
        self._points: dict[int, int] = {}

    def new(self, count: int) -> Integers:
        """Return numbers that no sample has yet."""
        self.count += count
        return np.arange(self.count - count, self.count)

    def across(self, arc: int, first: int, start: int, stop: int) -> Integers:
        """Return the line over an arc between two centres; `first` is the cell where the arc begins its description."""
        forward = start == first
        ends = (start, stop) if forward else (stop, start)
        if (arc, 0) not in self._lines:
            self._lines[arc, 0] = np.concatenate([ends[:1], self.new(self.intervals - 1), ends[1:]])
        line = self._lines[arc, 0]
        return line if forward else line[::-1]

    def to_border(self, arc: int, cell: int) -> Integers:
        """Return the line along the border from the centre of a cell to the corner at which an arc ends."""
        if arc not in self._points:
            self._points[arc] = int(self.new(1)[0])
        return np.concatenate([[cell], self.new(self.intervals - 1), [self._points[arc]]])


def number_samples(rims: Rims, blocks: list[Block], intervals: int) -> Grids:
    """Number the samples of all blocks: centres of cells, lines between these, and what is inside.

    Parameters
    ----------
    rims : Rims
    blocks : list of Block
    intervals : int
        Quads along a side of a block, two or more.
    """
    sides = _Sides(len(rims.sides), intervals)
    numbers = np.empty((len(blocks), intervals + 1, intervals + 1), np.int64)

    def line(start: Link, stop: Link, seen_from: Link) -> Integers:
        arc = rims.sides[seen_from.cell][seen_from.side].arc
        return sides.across(arc, rims.arcs[arc].cell, start.cell, stop.cell)

    for grid, block in zip(numbers, blocks, strict=True):
        if block.second is None:
            tip, right, left = block.first
            arc = rims.sides[right.cell][right.side].arc
            bottom, up = line(tip, right, tip), line(tip, left, left)
            up_right, top = sides.to_border(arc, right.cell), sides.to_border(arc, left.cell)
        else:
            begin, right, end = block.first
            _, _, left = block.second
            bottom, up_right = line(begin, right, begin), line(right, end, right)
            top, up = line(left, end, block.second[1]), line(begin, left, left)
        grid[0], grid[-1], grid[:, 0], grid[:, -1] = bottom, top, up, up_right
        grid[1:-1, 1:-1] = sides.new((intervals - 1) ** 2).reshape(intervals - 1, -1)
    return Grids(numbers, sides.count)


def place_samples(grids: Grids, rims: Rims, blocks: list[Block], maps: Maps) -> tuple[Floats, Integers]:
    """Find the points of the surface that the samples are in the maps of cells.

    Returns
    -------
    points : float64 array of shape (N, 3)
    triangles : int64 array of shape (N,)
        In which they lie.
    """
    steps = np.arange(grids.intervals + 1) / grids.intervals
    v, u = np.meshgrid(steps, steps, indexing="ij")
    places = []
    for block in blocks:
        lower = v <= u
        if block.second is None:
            low = np.stack([1 - u, u - v / 2, v / 2], axis=-1)
            high = np.stack([1 - v, u / 2, v - u / 2], axis=-1)
            weights, triangle = np.where(lower[..., np.newaxis], low, high), block.first
            places.append(_in_cells(triangle, weights, rims))
        else:
            below = _in_cells(block.first, np.stack([1 - u, u - v, v], axis=-1), rims)
            above = _in_cells(block.second, np.stack([1 - v, u, v - u], axis=-1), rims)
            places.append(np.where(lower[..., np.newaxis], below, above))
    place = np.stack(places).reshape(-1, 3)
    # Numbers in order of their first place in the blocks: np.unique finds that place.
    _, first = np.unique(grids.numbers.reshape(-1), return_index=True)
    cell, radius, angle = place[first].T
    return maps.locate(cell.astype(np.int64), radius, angle)


def _in_cells(triangle: tuple[Link, ...], weights: Floats, rims: Rims) -> Floats:
    """Return places in the maps of cells, from barycentric coordinates between the centres of three cells.

    The medians part the triangle into three quads, one for each cell: centre, where the line to the next centre
    crosses the rim, corner, and where the line to the last centre crosses the rim.

    Returns
    -------
    float64 array of shape (..., 3)
        Cell, radius and angle.
    """
    nearest = np.argmax(weights, axis=-1)
    places = np.zeros((*nearest.shape, 3))
    for corner, link in enumerate(triangle):
        sides = rims.sides[link.cell]
        side, following = sides[link.side], sides[(link.side + 1) % len(sides)]
        inside = nearest == corner
        to_next = np.clip(weights[..., (corner + 1) % 3][inside], 0, None)
        to_last = np.clip(weights[..., (corner + 2) % 3][inside], 0, None)
        more, less = np.maximum(to_next, to_last), np.minimum(to_next, to_last)
        radius = 2 * more + less
        share = 3 * less / np.maximum(radius, 1e-300)
        # The following side begins where this one stops, or a turn later.
        after = side.stop + following.crossing - following.start
        crossing = np.where(to_next >= to_last, side.crossing, after)
        angle = crossing + (side.stop - crossing) * share
        places[inside] = np.stack([np.full(len(radius), float(link.cell)), np.minimum(radius, 1), angle], axis=-1)
    return places


def upsample(coarse: Grids, fine: Grids, values: Floats) -> Floats:
    """Return values at twice as many samples along each side: old ones, and means of two or four between.

    Parameters
    ----------
    coarse, fine : Grids
        Both of `number_samples`, for the same blocks.
    values : float64 array of shape (N, 3)
    """
    result = np.empty((fine.count, values.shape[1]))
    old = values[coarse.numbers]
    result[fine.numbers[:, ::2, ::2]] = old
    # A line between two blocks has the same ends in the same or the opposite order: its means are the same bit for bit.
    result[fine.numbers[:, 1::2, ::2]] = (old[:, :-1] + old[:, 1:]) / 2
    result[fine.numbers[:, ::2, 1::2]] = (old[:, :, :-1] + old[:, :, 1:]) / 2
    rows = (old[:, :-1] + old[:, 1:]) / 2
    result[fine.numbers[:, 1::2, 1::2]] = (rows[:, :, :-1] + rows[:, :, 1:]) / 2
    return result
