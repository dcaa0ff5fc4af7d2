"""Poles: fans of triangles round a vertex, treated as quads along a side that is collapsed to this vertex."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from .halfedges import Corners
from .walks import walk

__all__ = ["find_fans", "find_poles", "leaving_half_edges", "unfold"]

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
        Faces of the pieces that are examined.

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


def leaving_half_edges(
    twins: NDArray[np.int32], umbrella: NDArray[np.int32], valence: NDArray[np.int32]
) -> NDArray[np.int32]:
    """Return a half-edge that leaves each umbrella, with no face before it where the umbrella is open.

    `twins` and `umbrella` have an entry a half-edge, shape (4 F,), `valence` and the result one an umbrella, shape
    (U,).
    """
    halves = np.flatnonzero(umbrella >= 0).astype(np.int32)
    leaving = np.empty(len(valence), np.int32)
    leaving[umbrella[halves]] = halves
    borders = halves[twins[halves] < 0]
    leaving[umbrella[borders]] = borders
    return leaving


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
        See `leaving_half_edges`.
    order : int32 array
        The umbrellas that may be poles.
    together : bool
        Add them one after another, each only if it is consistent with those before; otherwise test each alone.
    pole : bool array of shape (U,)
        Filled: True at poles.
    missing : int32 array of shape (U,)
        Filled with the triangles by which inner vertices are short of six, those of poles beside them counted.
    """
    missing[:] = np.where(valence > 0, _REGULAR - valence, 0)
    walk(
        kernels.mesh_poles,
        *(corners, twins, umbrella, valence, corner_of, order, together, pole.view(np.uint8), missing),
        np.zeros(4, np.int64),
    )


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
        Numbers of the attribute values of the corners.
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
        The number of new vertices.
    """
    state = np.zeros(4, np.int64)
    walk(
        kernels.mesh_unfold,
        *(corners, twins, _first_of_fans(twins, umbrella, pole), folded.view(np.uint8), attributes, vertices),
        *(new_corners, new_attributes, pole_of),
        state,
    )
    return int(state[3])


def _first_of_fans(twins: NDArray[np.int32], umbrella: NDArray[np.int32], pole: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Return a half-edge that leaves each pole, at the border or else the lowest; in the order of the lowest ones."""
    tips = np.flatnonzero((umbrella >= 0) & pole[umbrella]).astype(np.int32)
    first = np.full(len(pole), -1, np.int32)
    first[umbrella[tips[::-1]]] = tips[::-1]
    lowest = np.sort(first[pole])
    at_border = tips[twins[tips] < 0]
    first[umbrella[at_border]] = at_border
    return first[umbrella[lowest]]
