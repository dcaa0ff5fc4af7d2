"""Contacts of blocks: where their sides run through the same points of the lattice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .model import LatticeBlock

__all__ = ["Axis", "Link", "find_links", "line_of"]

#: Number of a block, and of one of its axes.
Axis = tuple[int, int]


def line_of(block: LatticeBlock, axis: int, place: int, along: NDArray[np.intp], geometric: int) -> NDArray[np.int32]:
    """Return points of a row (``axis`` 1) or column (0) for comparison: coordinates, and 1 where valid, else 0.

    Parameters
    ----------
    block : LatticeBlock
    axis : 0 or 1
        The axis along which the line runs.
    place : int
        Number of the row or column.
    along : int array, shape (N,)
        Indices along the axis.
    geometric : int
        The number of coordinates that are compared.

    Returns
    -------
    array of int32, shape (N, geometric + 1)
    """
    at = (along, place) if axis == 0 else (place, along)
    line = np.ones((len(along), geometric + 1), np.int32)
    line[:, :geometric] = block.coordinates[at][:, :geometric]
    if block.mask is not None:
        line[:, geometric] = block.mask[at]
    return line


@dataclass(frozen=True)
class Link:
    """A contact seen from one of its two sides: position i of the source is ``sign`` i + ``shift`` of the target.

    Attributes
    ----------
    source, target : int
        Numbers of sides, see `find_links`.
    first, last : int
        Positions of the source; of a closed side they run from 0 to its length, which is position 0 again.
    sign : 1 or -1
    shift : int
    """

    source: int
    target: int
    first: int
    last: int
    sign: int
    shift: int

    def at(self, position: int) -> int:
        """Return the target's position."""
        return self.sign * position + self.shift

    @property
    def turned(self) -> Link:
        """The same contact seen from the other side."""
        first, last = sorted((self.at(self.first), self.at(self.last)))
        return Link(self.target, self.source, first, last, self.sign, -self.sign * self.shift)


@dataclass(frozen=True)
class _Edges:
    """Edges of all sides in order: side and position, points at both ends, and whether it can make a contact."""

    side: NDArray[np.intp]
    position: NDArray[np.intp]
    start: NDArray[np.intp]
    stop: NDArray[np.intp]
    firm: NDArray[np.bool_]


def find_links(blocks: Sequence[LatticeBlock], geometric: int) -> tuple[list[Axis], list[Link]]:
    """Find all contacts of sides, as the longest possible runs.

    A contact begins and ends with an edge between two different valid points; edges without length and invalid points
    are allowed inside it. Where more than two sides have an edge, each is linked with the next.

    Parameters
    ----------
    blocks : sequence of LatticeBlock
    geometric : int
        Number of coordinates.

    Returns
    -------
    list of (int, int)
        The axis along which each side runs; the two sides of an axis are adjacent.
    list of Link
        Each contact once, by the numbers of its sides.
    """
    axes: list[Axis] = []
    lines: list[NDArray[np.int32]] = []
    for number, block in enumerate(blocks):
        shape = block.coordinates.shape[:2]
        if min(shape) < 2:
            continue
        for axis in (0, 1):
            if block.closed[1 - axis]:
                continue
            along = np.arange(shape[axis] + block.closed[axis]) % shape[axis]
            for place in (0, shape[1 - axis] - 1):
                axes.append((number, axis))
                lines.append(line_of(block, axis, place, along, geometric))
    if not lines:
        return [], []
    points, valid = _numbered(lines), np.concatenate(lines)[:, -1] == 1
    offsets = np.cumsum([0] + [len(line) for line in lines])
    return axes, _runs(_edges(points, valid, offsets), points, offsets)


def _numbered(lines: list[NDArray[np.int32]]) -> NDArray[np.intp]:
    """Number the points, equal points alike; int64, shape (point,)."""
    rows = np.concatenate(lines)
    order = np.lexsort(rows.T)
    fresh = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    numbers = np.empty(len(rows), np.intp)
    numbers[order] = np.concatenate([[0], np.cumsum(fresh)])
    return numbers


def _edges(points: NDArray[np.intp], valid: NDArray[np.bool_], offsets: NDArray[np.intp]) -> _Edges:
    """Make the edges between neighbouring points of each side."""
    side = np.repeat(np.arange(len(offsets) - 1), np.diff(offsets))
    inside = side[1:] == side[:-1]
    position = np.arange(len(points)) - offsets[side]
    firm = valid[1:] & valid[:-1] & (points[1:] != points[:-1])
    return _Edges(*(column[inside] for column in (side[:-1], position[:-1], points[:-1], points[1:], firm)))


def _runs(edges: _Edges, points: NDArray[np.intp], offsets: NDArray[np.intp]) -> list[Link]:
    """Link sides along runs of edges that they have in common."""
    low, high = np.minimum(edges.start, edges.stop), np.maximum(edges.start, edges.stop)
    firm = np.flatnonzero(edges.firm)
    # Edges of the same two points stand together, whichever way they run: each is linked with the next.
    order = firm[np.lexsort((firm, high[firm], low[firm]))]
    same = (low[order[1:]] == low[order[:-1]]) & (high[order[1:]] == high[order[:-1]])
    if not same.any():
        return []
    edge, next_edge = order[:-1][same], order[1:][same]
    i, j = edges.position[edge], edges.position[next_edge]
    sign = np.where(edges.start[edge] == edges.start[next_edge], 1, -1)
    shift = np.where(sign == 1, j - i, j + i + 1)
    pairs = np.stack([edges.side[edge], edges.side[next_edge], sign, shift, i])
    pairs = pairs[:, np.lexsort(pairs[::-1])]
    # Along a run source, target, sign and shift stay, and the position grows by one: a run ends where that ends.
    fresh = (np.diff(pairs[:4]) != 0).any(axis=0) | (np.diff(pairs[4]) != 1)
    starts = np.concatenate([[0], np.flatnonzero(fresh) + 1])
    lasts = np.concatenate([starts[1:], [pairs.shape[1]]]) - 1
    links: list[Link] = []
    for begin, end in zip(starts, lasts, strict=True):
        source, target, turn, constant, first = (int(number) for number in pairs[:, begin])
        link = Link(source, target, first, int(pairs[4, end]) + 1, turn, constant)
        if links and _goes_on(links[-1], link, points, offsets):
            link = Link(source, target, links.pop().first, link.last, turn, constant)
        links.append(link)
    return links


def _goes_on(before: Link, after: Link, points: NDArray[np.intp], offsets: NDArray[np.intp]) -> bool:
    """Return whether the points between two runs agree too."""
    if (before.source, before.target, before.sign, before.shift) != (
        after.source,
        after.target,
        after.sign,
        after.shift,
    ):
        return False
    between = np.arange(before.last, after.first + 1)
    here, there = offsets[before.source] + between, offsets[before.target] + before.sign * between + before.shift
    return bool((points[here] == points[there]).all())
