"""A mesh of triangles and quads, as files store it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from .ears import cut_faces

__all__ = ["CornerAttribute", "Mesh", "name_faces", "names_of_parts"]

#: Faces that an error message names, at most.
_MAX_NAMED_FACES = 4


@dataclass(frozen=True, slots=True)
class CornerAttribute:
    """Values of the corners of faces, not of vertices: two faces may have different ones at one vertex.

    Attributes
    ----------
    values : array of shape (N, K)
    corners : int32 array of shape (F, 4)
        For each corner the row of `values`, or -1 where it has none.
    """

    values: NDArray[Any]
    corners: NDArray[np.int32]


def _number(face: int) -> str:
    """Name a face by its 1-based number."""
    return f"face {face + 1}"


def names_of_parts(faces: NDArray[np.int64]) -> Callable[[int], str]:
    """Return the `face_name` of a mesh whose faces, shape (T,), are parts of those with these 0-based numbers."""
    return lambda part: _number(int(faces[part]))


@dataclass(frozen=True, slots=True)
class Mesh:
    """A mesh of triangles and quads.

    Attributes
    ----------
    vertices : array of shape (V, 2) or (V, 3)
    corners : int32 array of shape (F, 4)
        0-based vertices of each face, going round it; -1 in the last place of a triangle.
    attributes : mapping of str to arrays of shape (V,) or (V, K)
        Values of the vertices.
    corner_attributes : mapping of str to CornerAttribute
        Values of the corners of faces.
    face_name : callable
        Returns the name of a face in messages from its 0-based number: "face 12 (line 31)".
    notes : tuple of str
        Descriptions of contents of the file that a surface cannot keep.
    """

    vertices: NDArray[Any]
    corners: NDArray[np.int32]
    attributes: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    corner_attributes: Mapping[str, CornerAttribute] = field(default_factory=dict)
    face_name: Callable[[int], str] = _number
    notes: tuple[str, ...] = ()

    @staticmethod
    def of(
        vertices: ArrayLike,
        faces: ArrayLike | Sequence[Sequence[int]],
        attributes: Mapping[str, ArrayLike] | None = None,
        polygons: bool = False,
    ) -> Mesh:
        """Make a mesh of an array of quads, an array of triangles, or a list of either.

        With `polygons` faces may have more corners, and are cut into triangles (`cut_faces`).

        Raises
        ------
        InputError
            When the arrays have other shapes, or faces name vertices that do not exist.
        """
        points = np.asarray(vertices)
        rows = [list(face) for face in faces] if isinstance(faces, list | tuple) else np.asarray(faces)
        name: Callable[[int], str] = _number
        fitting = points.ndim == 2 and points.shape[1] in (2, 3)
        if isinstance(rows, list):
            counts = np.array([len(row) for row in rows], np.int64)
            if counts.min(initial=3) < 3 or (counts.max(initial=3) > 4 and not polygons):
                raise InputError(
                    "expected faces of 3 corners or more, got others"
                    if polygons
                    else "expected faces of 3 or 4 corners, got others; remesh=True takes more"
                )
            flat = np.array([corner for row in rows for corner in row], np.int64)
            if flat.size and fitting and not (flat.min() >= 0 and flat.max() < len(points)):
                raise InputError(_outside(len(points)))
            places, parts = cut_faces(points, counts, flat) if fitting else (np.empty((0, 4), np.int64), counts)
            name = names_of_parts(parts)
            rows = np.where(places >= 0, flat[places], -1) if flat.size else places
        if rows.ndim != 2 or rows.shape[1] not in (3, 4) or not fitting:
            raise InputError(
                f"expected vertices of shape (V, 2) or (V, 3) and faces of 3 or 4 corners, got {points.shape} and "
                f"{rows.shape}"
            )
        corners = np.full((len(rows), 4), -1, np.int32)
        corners[:, : rows.shape[1]] = rows
        if corners.size and (corners[:, :3].min() < 0 or corners.min() < -1 or corners.max() >= len(points)):
            raise InputError(_outside(len(points)))
        of_vertices = {key: np.asarray(values) for key, values in (attributes or {}).items()}
        return Mesh(points, corners, of_vertices, face_name=name)


def _outside(count: int) -> str:
    return f"expected faces over {count} vertices, got numbers outside 0 to {count - 1}"


def name_faces(mesh: Mesh, faces: ArrayLike) -> str:
    """Name the first few of some faces, whose numbers have any shape."""
    numbers = np.unique(np.asarray(faces)).tolist()
    # Several triangles may be parts of one face.
    words = list(dict.fromkeys(mesh.face_name(number) for number in numbers[:_MAX_NAMED_FACES]))
    if len(numbers) > _MAX_NAMED_FACES:
        return f"{', '.join(words)} and {len(numbers) - _MAX_NAMED_FACES:,} more"
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
