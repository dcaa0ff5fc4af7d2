"""Half-edges of triangles and quads: which faces are adjacent, across which edge, and around which vertex.

Faces are rows of four corners, the last of which is -1 in a triangle. Half-edge ``4 f + k`` runs from corner k of face
f to the next one; its *twin* is the half-edge of the face beside it, or -1 where there is none.

An *umbrella* is a run of faces around a vertex, each beside the next. A vertex has one umbrella unless the surface
touches itself there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from .walks import batches, walk

__all__ = ["Corners", "find_pieces", "find_twins", "find_umbrellas", "join_pieces", "orient", "turn"]

Corners = NDArray[np.int32]

#: A number above that of any half-edge.
_NO_HALF_EDGE = 2**31 - 1

#: Mark of faces that `orient` has not visited.
_UNSEEN = 2


def find_twins(corners: Corners, vertices: int) -> tuple[NDArray[np.int32], int, int]:
    """Find the half-edge on the other side of each edge.

    Parameters
    ----------
    corners : int32 array of shape (F, 4)
        0-based vertices of each face; -1 in the last place of a triangle. No face names a vertex twice.
    vertices : int

    Returns
    -------
    twins : int32 array of shape (4 F,)
    crossed : int
        The first half-edge at an edge that already has two; -1 when there is none. `twins` are of no use otherwise.
    same : int
        Pairs of twins that run the same way: their faces are wound differently.
    """
    start = np.zeros(vertices + 1, np.int32)
    for batch in batches(len(corners)):
        kernels.mesh_count_edges(corners[batch], start)
    np.cumsum(start, out=start)
    order = np.empty(start[-1], np.int32)
    for batch in batches(len(corners)):
        kernels.mesh_sort_edges(corners, batch.start, batch.stop, start[:-1], order)
    # Half-edges of one vertex meet at the other one, whose number is higher.
    met = np.full((vertices, 2), -1, np.int32)
    twins = np.full(4 * len(corners), -1, np.int32)
    crossed = np.array([_NO_HALF_EDGE])
    same = sum(kernels.mesh_match_edges(corners, order[batch], met, twins, crossed) for batch in batches(len(order)))
    return twins, -1 if crossed[0] == _NO_HALF_EDGE else int(crossed[0]), same


def find_pieces(twins: NDArray[np.int32], piece: NDArray[np.int32]) -> int:
    """Number faces by the connected piece that they belong to, in the order of the pieces' first faces.

    Fills `piece`, int32 of shape (F,), and returns the number of pieces.
    """
    piece[:] = -1
    state = np.zeros(4, np.int64)
    walk(kernels.mesh_pieces, twins, piece, np.empty_like(piece), state)
    return int(state[3])


def join_pieces(corners: Corners, piece: NDArray[np.int32], pieces: int, vertices: int) -> NDArray[np.int64]:
    """Give pieces that share a vertex the same number of a part; parts are numbered in order, shape (piece,).

    `corners` has shape (F, 3) or (F, 4), `piece` shape (F,).
    """
    part = np.arange(pieces)
    if pieces < 2:
        return part
    there = corners >= 0
    corner, home = corners[there], np.broadcast_to(piece[:, None], corners.shape)[there]
    any_piece = np.empty(vertices, np.int32)
    any_piece[corner] = home
    beside = any_piece[corner]
    apart = beside != home
    piece_a, piece_b = np.divmod(np.unique(beside[apart].astype(np.int64) * pieces + home[apart]), pieces)
    while True:
        # Each piece, and the one that stands for it, gets the least of the numbers beside it.
        least = np.minimum(part[piece_a], part[piece_b])
        less = part.copy()
        np.minimum.at(less, part[piece_a], least)
        np.minimum.at(less, part[piece_b], least)
        less = less[less]
        if np.array_equal(less, part):
            return np.unique(part, return_inverse=True)[1].reshape(-1)
        part = less


def orient(corners: Corners, twins: NDArray[np.int32], turned: NDArray[np.bool_]) -> int:
    """Find the faces to turn round so that all of a piece are wound alike: the fewer of the two possible sets.

    Fills `turned`, of shape (F,). Returns -1, or the first face at which the surface was seen to have only one side.
    """
    sides = turned.view(np.uint8)
    sides[:] = _UNSEEN
    queue = np.empty(len(turned), np.int32)
    return walk(kernels.mesh_orient, corners, twins, sides, queue, np.zeros(5, np.int64)) - 2


def turn(corners: Corners, turned: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return where each half-edge is after faces were turned round.

    Returns
    -------
    int32 array of shape (4 F,)
        The new number of each half-edge. Corner k of a face of n goes to ``(n - k) % n``, its half-edge k to n - 1 - k.
    """
    moved = np.arange(4 * len(corners), dtype=np.int32).reshape(-1, 4)
    quads = turned & (corners[:, 3] >= 0)
    triangles = turned & (corners[:, 3] < 0)
    moved[quads] = moved[quads][:, (3, 2, 1, 0)]
    moved[triangles] = moved[triangles][:, (2, 1, 0, 3)]
    return moved.reshape(-1)


def find_umbrellas(
    corners: Corners, twins: NDArray[np.int32], umbrella: NDArray[np.int32], valence: NDArray[np.int32]
) -> int:
    """Number the umbrellas.

    Parameters
    ----------
    corners, twins
        Faces wound alike.
    umbrella : int32 array of shape (4 F,)
        Filled with the number of the umbrella that each corner belongs to; -1 in the last place of a triangle.
    valence : int32 array of shape (4 F,)
        Filled with the faces of each umbrella; negative where it is open, at a border.

    Returns
    -------
    int
        The number of umbrellas.
    """
    umbrella[:] = -1
    state = np.zeros(6, np.int64)
    walk(kernels.mesh_umbrellas, corners, twins, umbrella, valence, state)
    return int(state[1])
