"""Development of faces into the plane, one beside the other, as cells of a lattice.

Where every inner vertex is regular, each face of a connected piece gets a distinct place, up to *periods*: the steps
after which a way round the surface comes back to the same face. Without periods a piece is a plane grid; one period
along an axis makes a cylinder, one along each a torus.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from .walks import walk

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


#: Pieces for which memory is allocated at first, and the kernel's result when there are more.
_INITIAL_PIECES, _NO_ROOM = 64, 2


def develop_quads(twins: NDArray[np.int32]) -> Development:
    """Lay out quads that are wound alike, of twins of shape (4 F,).

    Where an inner vertex does not have four quads, the piece `turns` or overlaps.
    """
    return _laid_out(4, twins)


def develop_triangles(twins: NDArray[np.int32]) -> Development:
    """Lay out triangles that are wound alike, of twins of shape (3 F,), on a lattice with three directions."""
    return _laid_out(3, twins)


def _laid_out(sides: int, twins: NDArray[np.int32]) -> Development:
    """Lay out faces of 3 or 4 sides that are wound alike."""
    faces = len(twins) // 4
    piece = np.empty(faces, np.int32)
    first = np.empty((faces, 2), np.int32)
    heading = np.full(faces, -1, np.int8)
    turns, periods = np.zeros(_INITIAL_PIECES, np.bool_), np.zeros((_INITIAL_PIECES, 3), np.int64)
    stack, state = np.empty(faces, np.int32), np.zeros(3, np.int64)
    arrays = (piece, first, heading)
    while walk(kernels.mesh_develop, sides, twins, *arrays, turns.view(np.uint8), periods, stack, state) == _NO_ROOM:
        turns = np.concatenate([turns, np.zeros_like(turns)])
        periods = np.concatenate([periods, np.zeros_like(periods)])
    return Development(piece, first, heading, turns[: state[2]], periods[: state[2]])
