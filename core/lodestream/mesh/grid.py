"""Grids of the quads that were laid out, turned to the order of the file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..numba_kernels import kernel
from ..surface import Closed
from .develop import Development

__all__ = ["Grid", "make_grid"]

#: A grid of which fewer cells have a face is no grid with holes but a mesh of another shape.
_LEAST_FULL = 0.1

_MIN_CLOSED = 3


@dataclass(frozen=True, slots=True)
class Grid:
    """Quads in rows and columns.

    Attributes
    ----------
    corners : int32 array of shape (H, W)
        For each node a corner (4 f + k) that lies there; -1 where there is none.
    faces : int32 array of shape (H or H - 1, W or W - 1)
        The face of each cell; -1 where there is none. Cell (r, c) lies between nodes (r, c) and (r + 1, c + 1), where
        the next index wraps on closed axes.
    closed : (bool, bool)
    reversed : bool
        Whether faces go round as (r, c), (r + 1, c), ... and not as (r, c), (r, c + 1), ...
    """

    corners: NDArray[np.int32]
    faces: NDArray[np.int32]
    closed: Closed
    reversed: bool


@kernel
def _bounds(
    faces: NDArray[np.int64],
    first: NDArray[np.int32],
    heading: NDArray[np.int8],
    down: int,
    across: int,
) -> tuple[int, int, int, int]:
    """Lowest and highest row and column of the nodes, after the periods `down` and `across` (0: none)."""
    top = left = 1 << 62
    bottom = right = -top
    for face in faces:
        way = heading[face]
        # The corners of a cell are its first and those one step away in its two directions.
        r = int(first[face, 0]) - (way == 2 or way == 3)
        c = int(first[face, 1]) - (way == 1 or way == 2)
        top, left = min(top, r), min(left, c)
        bottom, right = max(bottom, r + 1), max(right, c + 1)
    if down > 0:
        top, bottom = 0, down - 1
    if across > 0:
        left, right = 0, across - 1
    return top, bottom, left, right


@kernel
def _fill(
    faces: NDArray[np.int64],
    first: NDArray[np.int32],
    heading: NDArray[np.int8],
    identity: NDArray[np.int32],
    top: int,
    left: int,
    closed_rows: bool,
    closed_columns: bool,
    nodes: NDArray[np.int32],
    cells: NDArray[np.int32],
) -> int:
    """Put faces and corners in their places; give the first face that lies on another or does not join it, or -1."""
    height, width = nodes.shape
    for face in faces:
        way = np.int64(heading[face])
        r = np.int64(first[face, 0]) - (way == 2 or way == 3) - top
        c = np.int64(first[face, 1]) - (way == 1 or way == 2) - left
        if closed_rows:
            r %= height
        if closed_columns:
            c %= width
        if cells[r, c] >= 0:
            return int(face)
        cells[r, c] = face
        for k in range(4):
            place = (way + k) % 4
            i = r + (place >= 2)
            j = c + (place == 1 or place == 2)
            if closed_rows and i == height:
                i = 0
            if closed_columns and j == width:
                j = 0
            corner = 4 * face + k
            other = nodes[i, j]
            if other < 0:
                nodes[i, j] = corner
            elif identity[other] != identity[corner]:
                return int(face)
    return -1


def make_grid(
    faces: NDArray[np.int64],
    laid: Development,
    piece: int,
    identity: NDArray[np.int32],
    vertex: NDArray[np.int32],
) -> Grid | None:
    """Make a grid of the quads of a piece.

    Parameters
    ----------
    faces : int64 array
        The quads of the piece.
    laid : Development
    piece : int
    identity : int32 array of shape (4 F,)
        Corners with different ones are different nodes.
    vertex : int32 array of shape (4 F,)
        The vertex of each corner; the grid is turned so that they come in order.

    Returns
    -------
    Grid or None
        None when the piece is no grid: it turns, winds or lies on itself, or is too far from rectangular.
    """
    a, b, d = (int(value) for value in laid.periods[piece])
    if laid.turns[piece] or b or (a and a < _MIN_CLOSED) or (d and d < _MIN_CLOSED):
        return None
    top, bottom, left, right = _bounds(faces, laid.first, laid.heading, a, d)
    height, width = bottom - top + 1, right - left + 1
    closed = (a > 0, d > 0)
    down, across = height - (not closed[0]), width - (not closed[1])
    if len(faces) < _LEAST_FULL * down * across:
        return None
    nodes = np.full((height, width), -1, np.int32)
    cells = np.full((down, across), -1, np.int32)
    if _fill(faces, laid.first, laid.heading, identity, top, left, *closed, nodes, cells) >= 0:
        return None
    return _in_order(Grid(nodes, cells, closed, False), vertex)


def _in_order(grid: Grid, vertex: NDArray[np.int32]) -> Grid:
    """Transpose, reverse and roll a grid so that its vertices come in the order of their numbers, as far as may be."""
    best: tuple[NDArray[np.int32], Grid] | None = None
    for transposed in (False, True):
        for rows in (False, True):
            for columns in (False, True):
                turned = _rolled(_turned(grid, transposed, rows, columns), vertex)
                order = turned.corners.reshape(-1)
                order = vertex[order[order >= 0]]
                if best is None or _precedes(order, best[0]):
                    best = order, turned
    assert best is not None
    return best[1]


def _precedes(order: NDArray[np.int32], other: NDArray[np.int32]) -> bool:
    different = np.flatnonzero(order != other)
    return bool(different.size and order[different[0]] < other[different[0]])


def _turned(grid: Grid, transposed: bool, rows: bool, columns: bool) -> Grid:
    corners, faces, closed = grid.corners, grid.faces, grid.closed
    if transposed:
        corners, faces, closed = corners.T, faces.T, (closed[1], closed[0])
    for axis, flip in enumerate((rows, columns)):
        if flip:
            corners = np.flip(corners, axis)
            faces = np.flip(faces, axis)
            if closed[axis]:  # the cell behind the last node is now before the first
                faces = np.roll(faces, -1, axis)
    return Grid(corners, faces, closed, grid.reversed ^ transposed ^ rows ^ columns)


def _rolled(grid: Grid, vertex: NDArray[np.int32]) -> Grid:
    corners, faces = grid.corners, grid.faces
    for axis in (0, 1):
        if grid.closed[axis]:
            lines = corners if axis else corners.T
            shift = -_start(np.ascontiguousarray(lines), vertex)
            corners, faces = np.roll(corners, shift, axis), np.roll(faces, shift, axis)
    return Grid(np.ascontiguousarray(corners), np.ascontiguousarray(faces), grid.closed, grid.reversed)


@kernel
def _start(lines: NDArray[np.int32], vertex: NDArray[np.int32]) -> int:
    """Where most of the closed lines may begin so that the first of their vertices is the one of the lowest number."""
    count, length = lines.shape
    votes = np.zeros(length + 1, np.int64)
    for line in range(count):
        lowest, place, high = -1, -1, -1
        for j in range(length):
            if lines[line, j] >= 0:
                number = vertex[lines[line, j]]
                high = max(high, number)
                if place < 0 or number < lowest:
                    lowest, place = number, j
        if high == lowest:
            continue  # a pole, or nothing
        begin = place
        while lines[line, begin - 1] < 0:
            begin -= 1
        if begin < 0:
            votes[begin + length] += 1
            votes[length] -= 1
            begin = 0
        votes[begin] += 1
        votes[place + 1] -= 1
    best, most, total = 0, np.int64(-1), np.int64(0)
    for j in range(length):
        total += votes[j]
        if total >= most:
            best, most = j, total
    return best
