"""Faces that are wound alike, the input for finding grids."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from .halfedges import Corners, find_twins, orient, turn
from .model import Mesh, name_faces

__all__ = ["Polygons", "prepare"]


@dataclass(frozen=True, slots=True)
class Polygons:
    """Faces that are wound alike, each naming a vertex once.

    Attributes
    ----------
    corners : int32 array of shape (F, 4)
    twins : int32 array of shape (4 F,)
        See `find_twins`.
    origin : int64 array of shape (F,)
        The face of the file from which each face is made, or the first of two triangles.
    folded : bool array of shape (F,)
        Triangles that are quads with a vertex repeated: it comes first.
    names : tuple of str
        Corner attributes that differ around some vertex.
    attributes : int32 array of shape (A, F, 4)
        For each of them and each corner a number, equal where values are equal. Of a folded quad the fourth is that of
        the repeated vertex at the side of the triangle's last corner.
    turned : int
        Faces that were turned round.
    """

    corners: Corners
    twins: NDArray[np.int32]
    origin: NDArray[np.int64]
    folded: NDArray[np.bool_]
    names: tuple[str, ...]
    attributes: NDArray[np.int32]
    turned: int


def prepare(mesh: Mesh, names: tuple[str, ...], attributes: NDArray[np.int32]) -> Polygons:
    """Check that faces make a surface with two sides, and wind them alike.

    Parameters
    ----------
    mesh : Mesh
    names : tuple of str
    attributes : int32 array of shape (A, F, 4)
        See `Polygons`, but for the corners as they are in the mesh.

    Raises
    ------
    FormatError
        When a face names a vertex twice (quads with a repeated vertex excepted, which are triangles at a pole), when
        three faces meet at an edge, or when the surface has one side only. The first such faces are named.
    """
    corners, attributes, folded = _fold(mesh, attributes)
    twins, crossed, same = find_twins(corners, len(mesh.vertices))
    if crossed >= 0:
        raise FormatError(_crossing(mesh, corners, crossed))
    polygons = Polygons(corners, twins, np.arange(len(corners)), folded, names, attributes, 0)
    return _wound_alike(mesh, polygons) if same else polygons


def _fold(mesh: Mesh, attributes: NDArray[np.int32]) -> tuple[Corners, NDArray[np.int32], NDArray[np.bool_]]:
    """Make triangles of quads that name a vertex twice; return corners, attributes and which faces were folded."""
    corners = mesh.corners
    pairs = [corners[:, k] == corners[:, (k + 1) % 4] for k in range(4)]
    pairs[3] |= (corners[:, 3] < 0) & (corners[:, 2] == corners[:, 0])
    repeated = pairs[0] | pairs[1] | pairs[2] | pairs[3]
    repeated |= (corners[:, 0] == corners[:, 2]) | (corners[:, 1] == corners[:, 3])
    folded = np.zeros(len(corners), np.bool_)
    if not repeated.any():
        return corners, attributes, folded
    corners, attributes = corners.copy(), attributes.copy()
    same = np.stack(pairs, axis=-1)
    distinct = np.diff(np.sort(corners, axis=1), axis=1).astype(np.bool_).sum(axis=1) + 1
    folded = (corners[:, 3] >= 0) & (same.sum(axis=1) == 1) & (distinct == 3)
    bad = np.flatnonzero(repeated & ~folded)
    if bad.size:
        raise FormatError(
            f"expected faces that name each vertex once (quads at a pole may name it twice in a row), got "
            f"{name_faces(mesh, bad)}: remove faces without area first"
        )
    # The second mention of the vertex comes first, then the two others; the first mention is in the fourth place.
    faces = np.flatnonzero(folded)
    around = (same[faces].argmax(axis=1)[:, None] + np.arange(1, 5)) % 4
    corners[faces] = corners[faces[:, None], around]
    attributes[:, faces] = attributes[:, faces[:, None], around]
    corners[faces, 3] = -1
    return corners, attributes, folded


def _crossing(mesh: Mesh, corners: Corners, half: int) -> str:
    """Return the error message for an edge with more than two faces."""
    sides = 3 if corners[half >> 2, 3] < 0 else 4
    a, b = int(corners[half >> 2, half & 3]), int(corners[half >> 2, ((half & 3) + 1) % sides])
    faces = np.flatnonzero((corners == a).any(axis=1) & (corners == b).any(axis=1))
    return (
        f"expected each edge to join at most two faces, got {len(faces)} at the edge from vertex {a + 1} to {b + 1}: "
        f"{name_faces(mesh, faces)}; remove all but two of them, or give the sheets vertices of their own"
    )


def _wound_alike(mesh: Mesh, polygons: Polygons) -> Polygons:
    """Turn faces round so that all of a piece are wound alike."""
    corners, twins = polygons.corners, polygons.twins
    turned = np.zeros(len(corners), np.bool_)
    wrong = orient(corners, twins, turned)
    if wrong >= 0:
        raise FormatError(
            f"expected a surface with two sides, got one on which a way round comes back to the other side, noticed at "
            f"{mesh.face_name(wrong)}: cut it open along a line of edges, with vertices of its own on either side"
        )
    moved = turn(corners, turned)
    triangles = corners[:, 3] < 0
    new, attributes = corners.copy(), polygons.attributes.copy()
    for faces, places in ((turned & ~triangles, (0, 3, 2, 1)), (turned & triangles, (0, 2, 1, 3))):
        new[faces] = corners[faces][:, places]
        attributes[:, faces] = polygons.attributes[:, faces][:, :, places]
    faces = turned & polygons.folded
    attributes[:, faces] = polygons.attributes[:, faces][:, :, (3, 2, 1, 0)]
    joined = np.where(twins >= 0, moved[twins], -1).astype(np.int32)
    new_twins = np.empty_like(twins)
    new_twins[moved] = joined
    return replace(polygons, corners=new, twins=new_twins, attributes=attributes, turned=int(turned.sum()))
