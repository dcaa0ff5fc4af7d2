"""Meshes of triangles and quads as files hold them, made ready for recognition."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FormatError, InputError
from .halfedges import Corners, find_pieces, find_twins, orient, turn

__all__ = ["CornerAttribute", "Mesh", "Polygons", "name_faces", "prepare"]

#: How many of the faces that are wrong a message names.
_NAMED = 3


@dataclass(frozen=True, slots=True)
class CornerAttribute:
    """Values that belong to the corners of faces, not to vertices: two faces may see different ones at one vertex.

    Attributes
    ----------
    values : array of shape (N, K)
    corners : int32 array of shape (F, 4)
        For each corner the row of `values`, or -1 where it has none.
    """

    values: NDArray[Any]
    corners: NDArray[np.int32]


def _number(face: int) -> str:
    return f"face {face + 1}"


@dataclass(frozen=True, slots=True)
class Mesh:
    """A mesh of triangles and quads.

    Attributes
    ----------
    vertices : array of shape (V, 2) or (V, 3)
    corners : int32 array of shape (F, 4)
        0-based vertices of each face, going round it; -1 in the last place of a triangle.
    attributes : mapping of str to arrays of shape (V,) or (V, K)
        What belongs to the vertices.
    corner_attributes : mapping of str to CornerAttribute
        What belongs to the corners of faces.
    face_name : callable
        How to name a face in messages, from its 0-based number: "face 12 (line 31)".
    """

    vertices: NDArray[Any]
    corners: NDArray[np.int32]
    attributes: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    corner_attributes: Mapping[str, CornerAttribute] = field(default_factory=dict)
    face_name: Callable[[int], str] = _number

    @staticmethod
    def of(
        vertices: ArrayLike,
        faces: ArrayLike | Sequence[Sequence[int]],
        attributes: Mapping[str, ArrayLike] | None = None,
    ) -> Mesh:
        """Make a mesh of an array of quads, an array of triangles, or a list of either.

        Raises
        ------
        InputError
            When the arrays have other shapes, or faces name vertices that do not exist.
        """
        points = np.asarray(vertices)
        rows = [list(face) for face in faces] if isinstance(faces, list | tuple) else np.asarray(faces)
        if isinstance(rows, list):
            rows = np.array([row + [-1] * (4 - len(row)) for row in rows], np.int64).reshape(-1, 4)
        if rows.ndim != 2 or rows.shape[1] not in (3, 4) or points.ndim != 2 or points.shape[1] not in (2, 3):
            raise InputError(
                f"expected vertices of shape (V, 2) or (V, 3) and faces of 3 or 4 corners, got {points.shape} and "
                f"{rows.shape}"
            )
        corners = np.full((len(rows), 4), -1, np.int32)
        corners[:, : rows.shape[1]] = rows
        if corners.size and (corners[:, :3].min() < 0 or corners.min() < -1 or corners.max() >= len(points)):
            raise InputError(f"expected faces over {len(points)} vertices, got numbers outside 0 to {len(points) - 1}")
        return Mesh(points, corners, {name: np.asarray(values) for name, values in (attributes or {}).items()})


@dataclass(frozen=True, slots=True)
class Polygons:
    """Faces that are wound alike, each naming a vertex once.

    Attributes
    ----------
    corners : int32 array of shape (F, 4)
    twins : int32 array of shape (4 F,)
        See `find_twins`.
    origin : int64 array of shape (F,)
        The face of the file that each is, or the first of two triangles that it is made of.
    folded : bool array of shape (F,)
        Triangles that are quads with a vertex repeated: it comes first.
    names : tuple of str
        Corner attributes that are not the same all round each vertex.
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


def name_faces(mesh: Mesh, faces: ArrayLike) -> str:
    """Name the first few of some faces."""
    numbers = np.unique(np.asarray(faces)).tolist()
    words = [mesh.face_name(number) for number in numbers[:_NAMED]]
    if len(numbers) > _NAMED:
        return f"{', '.join(words)} and {len(numbers) - _NAMED:,} more"
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


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
    corners = mesh.corners
    pairs = [corners[:, k] == corners[:, (k + 1) % 4] for k in range(4)]
    pairs[3] |= (corners[:, 3] < 0) & (corners[:, 2] == corners[:, 0])
    repeated = pairs[0] | pairs[1] | pairs[2] | pairs[3]
    repeated |= (corners[:, 0] == corners[:, 2]) | (corners[:, 1] == corners[:, 3])
    folded = np.zeros(len(corners), np.bool_)
    if not repeated.any():
        return corners, attributes, folded
    corners, attributes = corners.copy(), attributes.copy()
    bad = []
    for face in np.flatnonzero(repeated).tolist():
        row = corners[face]
        same = [k for k in range(4) if row[k] == row[(k + 1) % 4]]
        if row[3] < 0 or len(same) != 1 or len(set(row.tolist())) != 3:
            bad.append(face)
            continue
        around = np.roll(np.arange(4), -same[0])  # the repeated vertex twice, then the two others
        corners[face] = (*row[around[1:]], -1)
        attributes[:, face] = attributes[:, face][:, (*around[1:], around[0])]
        folded[face] = True
    if bad:
        raise FormatError(
            f"expected faces that name each vertex once (quads at a pole may name it twice in a row), got "
            f"{name_faces(mesh, bad)}: remove faces without area first"
        )
    return corners, attributes, folded


def _crossing(mesh: Mesh, corners: Corners, half: int) -> str:
    sides = 3 if corners[half >> 2, 3] < 0 else 4
    a, b = int(corners[half >> 2, half & 3]), int(corners[half >> 2, ((half & 3) + 1) % sides])
    faces = np.flatnonzero((corners == a).any(axis=1) & (corners == b).any(axis=1))
    return (
        f"expected each edge to join at most two faces, got {len(faces)} at the edge from vertex {a + 1} to {b + 1}: "
        f"{name_faces(mesh, faces)}; remove all but two of them, or give the sheets vertices of their own"
    )


def _wound_alike(mesh: Mesh, polygons: Polygons) -> Polygons:
    corners, twins = polygons.corners, polygons.twins
    piece = np.empty(len(corners), np.int32)
    pieces = find_pieces(corners, twins, piece)
    turned = np.zeros(len(corners), np.bool_)
    wrong = orient(corners, twins, piece, pieces, turned)
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
