"""Poles: fans of triangles round one vertex, taken for quads along a side that is collapsed to this vertex."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..numba_kernels import kernel
from .halfedges import Corners, first_around, next_half_edge, previous_half_edge

__all__ = ["find_fans", "find_poles", "unfold"]

#: Fewer triangles round an inner vertex would share two edges each.
_MIN_FAN = 3

#: Triangles round an inner vertex of a grid whose cells are cut in two.
_REGULAR = 6


def find_fans(
    corners: Corners, umbrella: NDArray[np.int32], valence: NDArray[np.int32], mixed: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Find the poles of a mesh of quads and triangles: vertices with triangles alone.

    Parameters
    ----------
    corners, umbrella, valence
        See `find_umbrellas`.
    mixed : bool array of shape (F,)
        Faces of the pieces to look at.

    Returns
    -------
    pole : bool array of shape (U,)
        Which umbrellas are poles.
    misfits : int64 array
        Triangles that belong to no pole, or to several.
    """
    triangles = np.flatnonzero(mixed & (corners[:, 3] < 0))
    tips = umbrella.reshape(-1, 4)[triangles, :3]
    count = np.bincount(tips.reshape(-1), minlength=len(valence))
    pole = (count > 0) & (count == np.abs(valence)) & ((valence < 0) | (valence >= _MIN_FAN))
    misfits = triangles[pole[tips].sum(axis=1) != 1]
    return pole, misfits


@kernel
def find_poles(
    corners: Corners,
    twins: NDArray[np.int32],
    umbrella: NDArray[np.int32],
    valence: NDArray[np.int32],
    corner_of: NDArray[np.int32],
    order: NDArray[np.int32],
    together: bool,
    pole: NDArray[np.bool_],
    missing: NDArray[np.int32],
) -> None:
    """Find the poles of meshes of triangles: vertices without which the mesh is a grid whose cells are cut in two.

    A vertex beside a pole has five triangles, as three of the six become two there; between two poles it has four.

    Parameters
    ----------
    corners, twins, umbrella, valence
        See `find_umbrellas`.
    corner_of : int32 array of shape (U,)
        A half-edge that leaves each umbrella; with no face before it where the umbrella is open.
    order : int32 array
        The umbrellas that may be poles.
    together : bool
        Take them one after another, each only if it fits to those before; or else each for itself.
    pole : bool array of shape (U,)
        Filled with those that are.
    missing : int32 array of shape (U,)
        Filled with the triangles by which inner vertices are short of six, those of poles beside them counted.
    """
    for vertex in range(valence.size):
        missing[vertex] = _REGULAR - valence[vertex] if valence[vertex] > 0 else 0
    ring = np.empty(valence.size, np.int32)
    for j in range(order.size):
        vertex = order[j]
        faces = abs(valence[vertex])
        if faces < 2 or (valence[vertex] > 0 and faces < _MIN_FAN):
            continue
        # The vertices between two triangles of the fan.
        half = corner_of[vertex]
        count = 0
        fits = True
        for turn in range(faces):
            other = umbrella[next_half_edge(corners, half)]
            fits &= not (together and pole[other])
            if valence[vertex] > 0 or turn > 0:
                fits &= missing[other] > 0 if valence[other] > 0 else valence[other] == -2
                ring[count] = other
                count += 1
            half = previous_half_edge(corners, half)
            if valence[vertex] < 0 and turn == faces - 1:
                fits &= not (together and pole[umbrella[half]])
                break
            half = twins[half]
        if not fits:
            continue
        pole[vertex] = True
        if together:
            missing[vertex] = 0
            for index in range(count):
                if valence[ring[index]] > 0:
                    missing[ring[index]] -= 1


@kernel
def unfold(
    corners: Corners,
    twins: NDArray[np.int32],
    umbrella: NDArray[np.int32],
    pole: NDArray[np.bool_],
    folded: NDArray[np.bool_],
    attributes: NDArray[np.int32],
    vertices: int,
    new_corners: Corners,
    new_attributes: NDArray[np.int32],
    pole_of: NDArray[np.int32],
) -> int:
    """Make each triangle of a fan a quad whose side at the pole has two new vertices.

    Parameters
    ----------
    corners, twins, umbrella
        See `find_umbrellas`.
    pole : bool array of shape (U,)
        Umbrellas that are poles.
    folded : bool array of shape (F,)
        Triangles that are quads with a repeated vertex, which is their first: the values at its second mention are in
        the fourth place of `attributes`.
    attributes : int32 array of shape (A, F, 4)
        What the corners have beside their vertices.
    vertices : int
        New vertices are numbered from here.
    new_corners, new_attributes
        Copies of `corners` and `attributes`, in which the fans' triangles are replaced: the quad's first corner has
        what the triangle had at the pole, its last corner the same as the next triangle's quad.
    pole_of : int32 array
        Filled with the pole's vertex of each new one.

    Returns
    -------
    int
        How many new vertices there are.
    """
    done = np.zeros(corners.shape[0], np.bool_)
    count = 0
    for seed in range(umbrella.size):
        if umbrella[seed] < 0 or not pole[umbrella[seed]] or done[seed >> 2]:
            continue
        first, closed = first_around(corners, twins, seed)
        half = first
        start = count
        while True:
            face, tip = half >> 2, half & 3
            across = previous_half_edge(corners, half)
            following = twins[across]
            last = following < 0 or following == first
            done[face] = True
            pole_of[count] = corners[face, tip]
            new_corners[face, 0] = vertices + count
            new_corners[face, 1] = corners[face, (tip + 1) % 3]
            new_corners[face, 2] = corners[face, (tip + 2) % 3]
            new_corners[face, 3] = vertices + (start if last and closed else count + 1)
            for a in range(attributes.shape[0]):
                old = attributes[a, face]
                row = new_attributes[a, face]
                row[0] = old[tip]
                row[1] = old[(tip + 1) % 3]
                row[2] = old[(tip + 2) % 3]
                row[3] = old[3] if folded[face] else old[tip]
                if not folded[face] and following >= 0:
                    beside = attributes[a, following >> 2]
                    if beside[(following + 1 - 4 * (following >> 2)) % 3] == row[2]:
                        row[3] = beside[following & 3]
            count += 1
            if last:
                if not closed:
                    pole_of[count] = corners[face, tip]
                    count += 1
                break
            half = following
    return count
