"""Meshes of trimesh as meshes of this package."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, UnavailableError
from ..mesh import Mesh
from .attributes import COLOR, NORMAL, TEXTURE
from .meshes import pad

if TYPE_CHECKING:
    import trimesh

__all__ = ["mesh_of", "parts_of"]


def parts_of(file: BinaryIO, kind: str) -> list[tuple[trimesh.Trimesh, NDArray[np.float64]]]:
    """Return the meshes of triangles in a file as trimesh reads it, each with the matrix, (4, 4), that places it.

    Parameters
    ----------
    file : binary file
        No other file is opened, whatever it names.
    kind : str
        The suffix that trimesh knows it by.

    Raises
    ------
    FormatError
        If trimesh cannot read it.
    UnavailableError
        If trimesh is not installed.
    """
    try:
        import trimesh
    except ModuleNotFoundError as error:
        if error.name != "trimesh":
            raise  # it is there, and lacks something itself
        raise UnavailableError(
            f"expected trimesh for {kind.upper()}, which is not installed: pip install 'lodestream[trimesh]'"
        ) from None
    try:
        scene: Any = trimesh.load(file, file_type=kind, force="scene", process=False)
        placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
    except MemoryError:
        raise
    except Exception as error:  # it raises whatever comes up in the code that meets what is wrong
        words = " ".join(str(error).split())[:200]
        raise FormatError(
            f"trimesh cannot read this {kind.upper()}, which may be damaged or cut short: {type(error).__name__}: "
            f"{words}"
        ) from None
    parts = [(scene.geometry[name], np.asarray(matrix, np.float64)) for matrix, name in placed]
    return [(mesh, matrix) for mesh, matrix in parts if isinstance(mesh, trimesh.Trimesh)]


def mesh_of(mesh: trimesh.Trimesh) -> Mesh:
    """Return triangles with numbers, colours, texture coordinates and the original normals of their vertices.

    Parameters
    ----------
    mesh : trimesh.Trimesh

    Raises
    ------
    FormatError
        If faces name vertices that do not exist, which trimesh does not check.
    """
    count = len(mesh.vertices)
    faces = np.array(mesh.faces, np.int64).reshape(-1, 3)
    if faces.size and not (faces.min() >= 0 and faces.max() < count):
        raise FormatError(f"expected faces over {count:,} vertices, got numbers outside 0 to {count - 1:,}")
    attributes = {
        str(name): values
        for name, values in ((name, np.array(values)) for name, values in mesh.vertex_attributes.items())
        if values.shape[:1] == (count,) and values.dtype.kind in "iuf"
    }
    visual: Any = mesh.visual
    if visual.kind == "vertex":
        attributes.setdefault(COLOR, np.array(visual.vertex_colors))
    elif visual.kind == "texture":
        _add_texture(attributes, visual, count)
    if "vertex_normals" in mesh._cache:  # those that it came with; others follow from the points
        attributes.setdefault(NORMAL, np.array(mesh.vertex_normals))
    return Mesh(np.array(mesh.vertices), pad(faces).astype(np.int32), attributes)


def _add_texture(attributes: dict[str, NDArray[Any]], visual: Any, count: int) -> None:
    """Add places in a texture, and the colours that trimesh keeps beside these."""
    if getattr(visual, "uv", None) is not None:
        attributes.setdefault(TEXTURE, np.array(visual.uv))
    beside: Mapping[str, Any] = getattr(visual, "vertex_attributes", None) or {}
    colours = np.array(beside.get("color", ()))
    if len(colours) == count and colours.ndim == 2 and colours.dtype.kind in "uf":
        # Whole numbers of 16 bits stand for parts of one; bytes are colours as they are.
        attributes.setdefault(COLOR, colours / 65535 if colours.dtype == np.uint16 else colours)
