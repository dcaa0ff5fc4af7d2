"""Surfaces from meshes of other libraries, by the rules of OBJ and PLY."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ..formats.meshes import grids_or_blocks, polygons_allowed, remesh_options
from ..mesh import Mesh
from ..surface import Surface

__all__ = ["from_mesh", "surface_of_mesh"]


def from_mesh(
    vertices: ArrayLike,
    faces: ArrayLike | Sequence[Sequence[int]],
    attributes: Mapping[str, ArrayLike] | None,
    remeshing: Mapping[str, object],
) -> Surface:
    """Convert arrays of a mesh to a surface, see `lodestream.Surface.from_mesh`.

    Parameters
    ----------
    vertices : array of shape (V, 2) or (V, 3)
    faces : int array of shape (F, 3) or (F, 4), or sequence of sequences of 3 or 4 int (with remesh of 3 or more)
    attributes : mapping of str to arrays of shape (V,) or (V, K), or None
    remeshing : mapping of str to values
        See `surface_of_mesh`.

    Raises
    ------
    InputError
        If the arrays have other shapes, or faces name vertices that do not exist.
    FormatError
        If the mesh is no structured surface, and is not to be resampled.
    """
    points = np.asarray(vertices)
    return surface_of_mesh(Mesh.of(points, faces, attributes, polygons_allowed(remeshing)), {}, remeshing)


def surface_of_mesh(mesh: Mesh, words: Mapping[str, str], remeshing: Mapping[str, object]) -> Surface:
    """Recognise the grids of a mesh and merge what repeats, or resample it; what is left out is a note.

    Parameters
    ----------
    mesh : Mesh
    words : mapping of str to str
        Metadata of the surface.
    remeshing : mapping of str to values
        Those of `lodestream.formats.meshes.REMESH_OPTIONS`.

    Raises
    ------
    FormatError
        If the mesh is no structured surface, and is not to be resampled.
    """
    return grids_or_blocks(mesh, words, remesh_options(remeshing))
