"""STL, binary or text: triangles without connectivity, read by trimesh."""

from __future__ import annotations

import re

import numpy as np

from ..errors import FormatError
from ..mesh import Mesh
from ..mesh.places import equal_places
from ..surface import Surface
from .meshes import check_faces, pad, surface_of
from .source import Source, number
from .trimesh_meshes import parts_of

__all__ = ["read", "sniff"]

_TEXT = re.compile(rb"\s*solid\b[^\n]*\n\s*(?:color\b[^\n]*\n\s*)?(?:facet\s+normal|endsolid)\b", re.IGNORECASE)
#: Bytes of the head of a binary file, and of each triangle.
_HEAD, _TRIANGLE = 84, 50
#: Further bytes of a text in which its first triangle begins.
_TEXT_HEAD = 4096


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file is text that begins with a solid, or is called .stl."""
    return suffix == ".stl" or _TEXT.match(head) is not None


def read(source: Source) -> Surface:
    """Read a mesh that is a structured surface. Corners at the same place are one vertex.

    Raises
    ------
    FormatError
        If the file is not whole, or its faces are no grid.
    """
    with source.path.open("rb") as file:
        head = file.read(_HEAD)
        promised = int.from_bytes(head[80:84], "little")
        if len(head) == _HEAD and source.size == _HEAD + _TRIANGLE * promised:
            check_faces(source, promised)
        elif _TEXT.match(head + file.read(_TEXT_HEAD)) is None:
            raise FormatError(
                f"this STL is cut short or damaged: it is no text that begins with a solid, and its "
                f"{number(source.size)} bytes are not the {number(_HEAD + _TRIANGLE * promised)} of the "
                f"{number(promised)} triangles that it says"
            )
        file.seek(0)
        parts = [mesh for mesh, _ in parts_of(file, "stl")]
    corners = np.concatenate([np.empty((0, 3)), *(mesh.triangles.reshape(-1, 3) for mesh in parts)])
    if not len(corners):
        raise FormatError("this STL has no triangles")
    check_faces(source, len(corners) // 3)
    places, vertex = equal_places(corners)
    source.check_vertices(len(places), f"{number(len(places))} vertices")
    coloured = any(np.any(mesh.face_attributes.get("stl", 0)) for mesh in parts)
    notes = ("colours of faces left out",) * coloured
    # Binary files, and most texts, say no more than float32 holds.
    small = places.astype(np.float32)
    places = small if np.array_equal(small, places, equal_nan=True) else places
    return surface_of(source, Mesh(places, pad(vertex.reshape(-1, 3)).astype(np.int32), notes=notes), "stl")
