"""Read OBJ: points, faces and lines."""

from __future__ import annotations

import numpy as np

from ...errors import FormatError
from ...surface import Surface
from ..connectivity import find_curve
from ..meshes import surface_of
from ..notes import warn
from ..source import Source, number
from .mesh import IGNORED, READ, ObjFile

__all__ = ["read", "sniff"]

#: Bytes of text in any encoding that extends ASCII, for names and comments.
_TEXT = bytes((*b"\t\n\f\r", *range(0x20, 0x7F), *range(0x80, 0x100)))


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file is text named .obj, or text of another name that begins with an OBJ statement."""
    if head.translate(None, _TEXT):
        return False
    if suffix == ".obj":
        return True
    statements = (words for line in head.splitlines() if (words := line.split()) and not words[0].startswith(b"#"))
    return not suffix and next(statements, [b""])[0] in READ | IGNORED


def read(source: Source) -> Surface:
    """Read a mesh that is a structured surface, or lines that join points one after another to a curve, (N, 1, 3).

    Colours behind the coordinates of points, normals and places in a texture are attributes.

    Raises
    ------
    FormatError
        If nothing joins the points, or they are joined to no grid.
    """
    file = ObjFile(source)
    if file.face_count:
        return surface_of(source, file.mesh(), "obj", file.words)
    points, attributes = file.points()
    if not file.segments:
        raise FormatError(
            f"this OBJ has {number(len(points))} points and no faces, so that nothing joins the points to a grid: save "
            "it with its faces"
        )
    closed = find_curve(len(points), np.array(file.segments, np.int64), file.segment_lines)
    for text in file.notes():
        warn(text)
    columns_of = {name: values[:, None] for name, values in attributes.items()}
    metadata = source.metadata("obj") | file.words
    return Surface(points[:, None], (closed, False), attributes=columns_of, metadata=metadata)
