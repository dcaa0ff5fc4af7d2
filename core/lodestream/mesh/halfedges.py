"""Half-edges of triangles and quads: who is beside whom, on which side, and around which vertex.

Faces are rows of four corners, the last of which is -1 in a triangle. Half-edge ``4 f + k`` runs from corner k of face
f to the next one; its *twin* is the half-edge of the face beside it, or -1 where there is none.

An *umbrella* is a run of faces around a vertex, each beside the next. A vertex has one umbrella unless the surface
touches itself there.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..numba_kernels import inlined, kernel

__all__ = [
    "Corners",
    "find_pieces",
    "find_twins",
    "find_umbrellas",
    "first_around",
    "join_pieces",
    "next_half_edge",
    "orient",
    "turn",
]

Corners = NDArray[np.int32]

_NONE = -1


@inlined
def next_half_edge(corners: Corners, half: int) -> int:
    """The next half-edge of the same face."""
    face, k = half >> 2, half & 3
    if k == 3 or (k == 2 and corners[face, 3] < 0):
        return half - k
    return half + 1


@inlined
def previous_half_edge(corners: Corners, half: int) -> int:
    """The half-edge before this one in the same face."""
    face, k = half >> 2, half & 3
    if k > 0:
        return half - 1
    return half + (2 if corners[face, 3] < 0 else 3)


@inlined
def first_around(corners: Corners, twins: NDArray[np.int32], seed: int) -> tuple[int, bool]:
    """Where a walk round the vertex of a half-edge begins, and whether it comes back there.

    Back against the sense of rotation, to the border or once round.
    """
    first = seed
    while True:
        twin = twins[first]
        if twin < 0:
            return first, False
        first = next_half_edge(corners, twin)
        if first == seed:
            return first, True


@kernel
def _find_twins(corners: Corners, vertices: int, twins: NDArray[np.int32]) -> tuple[int, int]:
    """Fill `twins`; give the first half-edge of a third face at an edge, or -1, and how many pairs run the same way."""
    faces = corners.shape[0]
    start = np.zeros(vertices + 1, np.int32)
    for face in range(faces):
        sides = 3 if corners[face, 3] < 0 else 4
        for k in range(sides):
            a, b = corners[face, k], corners[face, (k + 1) % sides]
            start[min(a, b) + 1] += 1
    for vertex in range(vertices):
        start[vertex + 1] += start[vertex]
    order = np.empty(start[vertices], np.int32)
    for face in range(faces):
        sides = 3 if corners[face, 3] < 0 else 4
        for k in range(sides):
            a, b = corners[face, k], corners[face, (k + 1) % sides]
            low = min(a, b)
            order[start[low]] = 4 * face + k
            start[low] += 1
    # Each start is now the end of its run. Half-edges of one run meet at the vertex with the higher number.
    met = np.full(vertices, -1, np.int32)
    open_half = np.empty(vertices, np.int32)
    crossed = 2147483647
    same = 0
    begin = 0
    for low in range(vertices):
        for j in range(begin, start[low]):
            half = order[j]
            face, k = half >> 2, half & 3
            sides = 3 if corners[face, 3] < 0 else 4
            a, b = corners[face, k], corners[face, (k + 1) % sides]
            high = max(a, b)
            if met[high] != low:
                met[high] = low
                open_half[high] = half
            elif open_half[high] >= 0:
                other = open_half[high]
                twins[half] = other
                twins[other] = half
                same += corners[other >> 2, other & 3] == a
                open_half[high] = -1
            else:
                crossed = min(crossed, half)
        begin = start[low]
    return (crossed if crossed < 2147483647 else -1), same


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
    twins = np.full(4 * len(corners), _NONE, np.int32)
    crossed, same = _find_twins(corners, vertices, twins)
    return twins, crossed, same


@kernel
def find_pieces(corners: Corners, twins: NDArray[np.int32], piece: NDArray[np.int32]) -> int:
    """Number faces by the connected piece that they belong to, in the order of the pieces' first faces.

    Fills `piece`, int32 of shape (F,), and gives the number of pieces.
    """
    faces = corners.shape[0]
    piece[:] = -1
    stack = np.empty(faces, np.int32)
    count = 0
    for seed in range(faces):
        if piece[seed] >= 0:
            continue
        piece[seed] = count
        stack[0] = seed
        top = 1
        while top > 0:
            top -= 1
            face = stack[top]
            for k in range(4):
                twin = twins[4 * face + k]
                if twin >= 0 and piece[twin >> 2] < 0:
                    piece[twin >> 2] = count
                    stack[top] = twin >> 2
                    top += 1
        count += 1
    return count


@kernel
def join_pieces(corners: Corners, piece: NDArray[np.int32], pieces: int, vertices: int) -> NDArray[np.int32]:
    """Number pieces that share a vertex alike: for each piece the number of its part, in order."""
    parent = np.arange(pieces).astype(np.int32)
    first = np.full(vertices, -1, np.int32)
    for face in range(corners.shape[0]):
        for k in range(4):
            vertex = corners[face, k]
            if vertex < 0:
                continue
            if first[vertex] < 0:
                first[vertex] = piece[face]
                continue
            a, b = first[vertex], piece[face]
            while parent[a] != a:
                parent[a] = parent[parent[a]]
                a = parent[a]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            if a < b:
                parent[b] = a
            else:
                parent[a] = b
    part = np.empty(pieces, np.int32)
    count = 0
    for j in range(pieces):
        if parent[j] == j:
            part[j] = count
            count += 1
        else:
            root = parent[j]
            while parent[root] != root:
                root = parent[root]
            part[j] = part[root]
    return part


@kernel
def orient(corners: Corners, twins: NDArray[np.int32], turned: NDArray[np.bool_]) -> int:
    """Find the faces to turn round so that all of a piece are wound alike: the fewer of the two possible sets.

    Fills `turned`, of shape (F,). Gives -1, or the first face at which a surface with only one side was noticed.
    """
    faces = corners.shape[0]
    seen = np.zeros(faces, np.bool_)
    queue = np.empty(faces, np.int32)
    end = 0
    for seed in range(faces):
        if seen[seed]:
            continue
        seen[seed] = True
        turned[seed] = False
        begin = end
        queue[end] = seed
        end += 1
        place = begin
        balance = 0
        while place < end:
            face = queue[place]
            place += 1
            balance += -1 if turned[face] else 1
            for k in range(4):
                twin = twins[4 * face + k]
                if twin < 0:
                    continue
                other = twin >> 2
                same = corners[face, k] == corners[other, twin & 3]
                if not seen[other]:
                    seen[other] = True
                    turned[other] = turned[face] != same
                    queue[end] = other
                    end += 1
                elif turned[other] != (turned[face] != same):
                    return int(face)
        if balance < 0:
            for place in range(begin, end):
                turned[queue[place]] = not turned[queue[place]]
    return -1


def turn(corners: Corners, turned: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Where each half-edge and, for the second result, each corner is after faces were turned round.

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


@kernel
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
        How many there are.
    """
    umbrella[:] = -1
    count = 0
    for seed in range(umbrella.size):
        if umbrella[seed] >= 0 or corners[seed >> 2, seed & 3] < 0:
            continue
        first, closed = first_around(corners, twins, seed)
        half = first
        faces = 0
        while True:
            umbrella[half] = count
            faces += 1
            half = twins[previous_half_edge(corners, half)]
            if half < 0 or half == first:
                break
        valence[count] = faces if closed else -faces
        count += 1
    return count
