"""Surfaces as meshes of trimesh, and back where a mesh is a structured surface."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..coordinates.seams import restore
from ..errors import FormatError, InputError
from ..formats.attributes import COLOR, NORMAL, TEXTURE
from ..formats.mesh_output import exact_float, output_of
from ..formats.trimesh_meshes import mesh_of
from ..surface import Surface
from .meshes import surface_of_mesh
from .optional import require_library

if TYPE_CHECKING:
    import trimesh

__all__ = ["from_trimesh", "to_trimesh"]

_WORDS = ("name", "unit", "crs")


def to_trimesh(surface: Surface) -> trimesh.Trimesh:
    """Convert a surface to a mesh of trimesh, see `lodestream.Surface.to_trimesh`.

    Raises
    ------
    FormatError
        If there are no faces.
    """
    tm = require_library("trimesh", "trimesh")
    mesh = output_of(restore(surface))
    if not len(mesh.quads) and not len(mesh.triangles):
        raise FormatError("expected a surface with faces for trimesh, got a curve or points without any")
    vertices = np.stack(
        [exact_float(axis, name, "trimesh") for name, axis in zip("xyz", mesh.coordinates, strict=True)], axis=-1
    ).astype(np.float64)
    faces = np.concatenate([mesh.quads[:, [0, 1, 2]], mesh.quads[:, [0, 2, 3]], mesh.triangles])
    attributes = dict(mesh.attributes)
    visual = _visual(tm, attributes)
    normals = attributes.pop(NORMAL) if _fits(attributes, NORMAL, (3,), "f") else None
    metadata = {key: value for key, value in surface.metadata.items() if isinstance(value, str | int | float)}
    result: trimesh.Trimesh = tm.Trimesh(
        vertices,
        faces,
        vertex_normals=normals,
        vertex_attributes=attributes,
        visual=visual,
        metadata=metadata,
        process=False,  # vertices stay as they are, those with and without faces
    )
    return result


def _fits(attributes: dict[str, NDArray[Any]], name: str, widths: tuple[int, ...], kinds: str) -> bool:
    values = attributes.get(name)
    return values is not None and values.ndim == 2 and values.shape[1] in widths and values.dtype.kind in kinds


def _visual(tm: Any, attributes: dict[str, NDArray[Any]]) -> Any:
    """Return colours or texture coordinates as trimesh has them, and remove them from the attributes."""
    if _fits(attributes, COLOR, (3, 4), "u") and attributes[COLOR].dtype == np.uint8:
        return tm.visual.ColorVisuals(vertex_colors=attributes.pop(COLOR))
    if _fits(attributes, TEXTURE, (2,), "f"):
        return tm.visual.TextureVisuals(uv=attributes.pop(TEXTURE))
    return None


def from_trimesh(mesh: trimesh.Trimesh, **remeshing: Any) -> Surface:
    """Convert a mesh of trimesh to a surface, see `lodestream.Surface.from_trimesh`.

    Raises
    ------
    InputError
        If this is no mesh of trimesh.
    FormatError
        If it is no structured surface.
    """
    tm = require_library("trimesh", "trimesh")
    if not isinstance(mesh, tm.Trimesh):
        raise InputError(f"expected a mesh of trimesh, got {type(mesh).__name__}")
    if not len(mesh.faces):
        raise FormatError(f"expected faces that join points to a grid, got {len(mesh.vertices):,} points and no face")
    words = {key: str(mesh.metadata[key]) for key in _WORDS if isinstance(mesh.metadata.get(key), str)}
    return surface_of_mesh(mesh_of(mesh), words, remeshing)
