"""Laying faces out in the plane, one beside the other, as cells of a lattice.

Where every inner vertex is regular this gives each face of a connected piece a place of its own, up to *periods*: the
steps by which a way round the surface comes back to the same face. Without periods a piece is a plane grid; one period
along an axis makes a cylinder, one along each a torus.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..numba_kernels import inlined, kernel
from .halfedges import Corners

__all__ = ["Development", "develop_quads", "develop_triangles"]


@dataclass(frozen=True, slots=True)
class Development:
    """Faces laid out.

    Attributes
    ----------
    piece : int32 array of shape (F,)
        Connected piece of each face.
    first : int32 array of shape (F, 2)
        Lattice coordinates of each face's first corner.
    heading : int8 array of shape (F,)
        Direction of each face's first half-edge: of quads 0 (0, 1), 1 (1, 0), 2 (0, -1), 3 (-1, 0); of triangles 0
        (1, 0), 1 (0, 1), 2 (-1, 1) and their opposites.
    turns : bool array of shape (P,)
        Pieces with a way round after which directions differ: no lattice fits them.
    periods : int64 array of shape (P, 3)
        (a, b, d): the periods of a piece are the sums of (a, b) and (0, d); zeros where there are none, 0 <= b < d.
    """

    piece: NDArray[np.int32]
    first: NDArray[np.int32]
    heading: NDArray[np.int8]
    turns: NDArray[np.bool_]
    periods: NDArray[np.int64]


@inlined
def _add_period(periods: NDArray[np.int64], piece: int, x: int, y: int) -> None:
    """Put a period into the triangular basis (a, b), (0, d)."""
    a, b, d = periods[piece, 0], periods[piece, 1], periods[piece, 2]
    while x != 0:
        times = a // x
        a, x = x, a - times * x
        b, y = y, b - times * y
    if a < 0:
        a, b = -a, -b
    d, y = abs(d), abs(y)
    while y != 0:
        d, y = y, d % y
    if d != 0:
        b %= d
    periods[piece, 0], periods[piece, 1], periods[piece, 2] = a, b, d


@kernel
def _develop(
    sides: int,
    rows: NDArray[np.int64],
    columns: NDArray[np.int64],
    twins: NDArray[np.int32],
    piece: NDArray[np.int32],
    first: NDArray[np.int32],
    heading: NDArray[np.int8],
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Develop faces of so many sides, where turning at a corner goes on by ``len(rows) / sides`` directions."""
    faces = piece.size
    directions = rows.size
    step = directions // sides
    heading[:] = -1
    stack = np.empty(faces, np.int32)
    turns = np.zeros(64, np.bool_)
    periods = np.zeros((64, 3), np.int64)
    number = 0
    for seed in range(faces):
        if heading[seed] >= 0:
            continue
        if number == turns.size:
            more_turns, more_periods = np.zeros(2 * number, np.bool_), np.zeros((2 * number, 3), np.int64)
            more_turns[:number] = turns
            more_periods[:number] = periods
            turns, periods = more_turns, more_periods
        heading[seed] = 0
        piece[seed] = number
        first[seed, 0] = 0
        first[seed, 1] = 0
        stack[0] = seed
        top = 1
        while top > 0:
            top -= 1
            face = stack[top]
            x, y, way = first[face, 0], first[face, 1], heading[face]
            for k in range(sides):
                x += rows[way]
                y += columns[way]
                twin = twins[4 * face + k]
                if twin >= 0:
                    other, m = twin >> 2, twin & 3
                    # The twin starts here, at corner m of the other face, and runs back.
                    back = (way + directions // 2 - step * m) % directions
                    u, v = x, y
                    for j in range(m):
                        u -= rows[(back + step * j) % directions]
                        v -= columns[(back + step * j) % directions]
                    if heading[other] < 0:
                        heading[other] = back
                        piece[other] = number
                        first[other, 0] = u
                        first[other, 1] = v
                        stack[top] = other
                        top += 1
                    elif heading[other] != back:
                        turns[number] = True
                    elif first[other, 0] != u or first[other, 1] != v:
                        _add_period(periods, number, u - first[other, 0], v - first[other, 1])
                way = (way + step) % directions
        number += 1
    return turns[:number], periods[:number]


_QUAD_ROWS = np.array([0, 1, 0, -1])
_QUAD_COLUMNS = np.array([1, 0, -1, 0])
_TRIANGLE_ROWS = np.array([1, 0, -1, -1, 0, 1])
_TRIANGLE_COLUMNS = np.array([0, 1, 1, 0, -1, -1])


def develop_quads(corners: Corners, twins: NDArray[np.int32]) -> Development:
    """Lay out quads that are wound alike. Where an inner vertex has not four quads, the piece `turns` or overlaps."""
    return _laid_out(4, _QUAD_ROWS, _QUAD_COLUMNS, corners, twins)


def develop_triangles(corners: Corners, twins: NDArray[np.int32]) -> Development:
    """Lay out triangles that are wound alike, on a lattice with three directions."""
    return _laid_out(3, _TRIANGLE_ROWS, _TRIANGLE_COLUMNS, corners, twins)


def _laid_out(
    sides: int, rows: NDArray[np.int64], columns: NDArray[np.int64], corners: Corners, twins: NDArray[np.int32]
) -> Development:
    faces = len(corners)
    piece = np.empty(faces, np.int32)
    first = np.empty((faces, 2), np.int32)
    heading = np.empty(faces, np.int8)
    turns, periods = _develop(sides, rows, columns, twins, piece, first, heading)
    return Development(piece, first, heading, turns, periods)
