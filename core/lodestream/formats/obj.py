"""OBJ: points, faces and lines, read and written."""

from __future__ import annotations

from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..surface import Surface
from .connectivity import find_curve
from .meshes import surface_of
from .obj_mesh import IGNORED, READ, ObjFile
from .quads import columns, edges, quads
from .source import Source, number

__all__ = ["read", "sniff", "write"]

#: Bytes of text in any encoding that extends ASCII, for names and comments.
_TEXT = bytes((*b"\t\n\f\r", *range(0x20, 0x7F), *range(0x80, 0x100)))

_ROWS = 1 << 16


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file is text named .obj, or text that begins with an OBJ statement and is not named otherwise."""
    if head.translate(None, _TEXT):
        return False
    if suffix == ".obj":
        return True
    statements = (words for line in head.splitlines() if (words := line.split()) and not words[0].startswith(b"#"))
    return not suffix and next(statements, [b""])[0] in READ | IGNORED


def read(source: Source) -> Surface:
    """Read a mesh that is a structured surface, or lines that join points one after another to a curve, (N, 1, 3).

    Colours behind the coordinates of points, normals and places in a texture are attributes.
    """
    file = ObjFile(source)
    if file.face_count:
        return surface_of(source, file.mesh(), "obj")
    points, attributes = file.points()
    if not file.segments:
        raise FormatError(f"expected faces that join points to a grid, got {number(len(points))} points and no face")
    closed = find_curve(len(points), np.array(file.segments, np.int64), file.segment_lines)
    columns_of = {name: values[:, None] for name, values in attributes.items()}
    return Surface(points[:, None], (closed, False), attributes=columns_of, metadata=source.metadata("obj"))


def write(surface: Surface, file: BinaryIO) -> None:
    """Write points and quads, or segments of a curve; every number reads back as it was.

    Closed axes are joined by faces. Three attributes follow x, y and z as readers of vertex colours expect; OBJ has no
    place for any other number of them.
    """
    values = columns(surface)
    if len(values) not in (3, 6):
        raise FormatError(f"expected x, y, z and none or 3 attributes for OBJ, got {len(values) - 3} attributes")
    _write_lines(file, "v", values)
    curve = 1 in surface.shape
    connections = edges(surface) if curve else quads(surface)
    for start in range(0, len(connections), _ROWS):
        block = connections[start : start + _ROWS] + 1
        _write_lines(file, "l" if curve else "f", list(block.T))


def _write_lines(file: BinaryIO, keyword: str, values: list[NDArray[Any]]) -> None:
    """Write a line for each index of the arrays `values`, all of one length."""
    template = " ".join([keyword, *(_spell(column.dtype) for column in values)]) + "\n"
    for start in range(0, len(values[0]), _ROWS):
        block = [column[start : start + _ROWS].tolist() for column in values]
        flat: list[float] = [0] * (len(block) * len(block[0]))
        for index, column in enumerate(block):
            flat[index :: len(block)] = column
        file.write((template * len(block[0]) % tuple(flat)).encode("ascii"))


def _spell(dtype: np.dtype[Any]) -> str:
    """Choose the shortest of the usual spellings that reads back as the same number."""
    if dtype.kind in "iu":
        return "%d"
    return "%.9g" if dtype.itemsize == 4 else "%r"
