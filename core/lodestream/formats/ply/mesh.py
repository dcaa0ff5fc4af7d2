"""Meshes and curves in PLY: vertices joined by faces, or by edges."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import FormatError
from ...mesh import CornerAttribute, Mesh
from ...mesh.ears import cut_faces
from ...surface import Surface
from ..attributes import TEXTURE, group
from ..connectivity import find_curve
from ..meshes import check_corners, check_faces, polygons_allowed, surface_of
from ..notes import keep_words, warn
from ..source import Source, number
from .elements import Lists, Table, read_elements
from .header import PlyHeader

__all__ = ["CURVE", "ELEMENT", "lists_left_out", "read", "read_curve", "words_of"]

ELEMENT, CURVE = "face", "edge"

_INDICES = ("vertex_indices", "vertex_index")

#: Two numbers for each corner of a face.
_TEXTURE = "texcoord"


def read(source: Source, header: PlyHeader) -> Surface:
    """Read a mesh that is a structured surface.

    Properties of the vertices beside x, y and z are attributes, and so are places in a texture that faces have for
    their corners. Other properties of faces, and other elements, are left out, which ``recognised`` says.

    Raises
    ------
    FormatError
        If faces have no list of vertices, or are no grid.
    """
    rows = {element.name: element.rows for element in header.elements}
    source.check_vertices(rows.get("vertex", 0), f"{number(rows.get('vertex', 0))} vertices")
    check_faces(source, rows[ELEMENT])
    tables = read_elements(source.path, header)
    points, attributes = _vertices(tables)
    faces = tables[ELEMENT]
    lists = next((column for name in _INDICES if isinstance(column := faces.get(name), Lists)), None)
    if lists is None:
        raise FormatError(f"expected faces with a list {_INDICES[0]}, got {', '.join(faces) or 'no property'}")
    name = _Names(header)
    places, face_of = _places(source, lists, points, name.face)
    corners = np.where(places >= 0, lists.values[places], -1).astype(np.int32)
    texture = faces.get(_TEXTURE)
    of_corners = {}
    left_out = [key for key in faces if key not in _INDICES]
    if isinstance(texture, Lists) and (texture.counts == 2 * lists.counts).all():
        of_corners[TEXTURE] = CornerAttribute(texture.values.reshape(-1, 2), places.astype(np.int32))
        left_out.remove(_TEXTURE)
    notes = [f"{' and '.join(left_out)} of faces left out"] * bool(left_out)
    others = [key for key in tables if key not in ("vertex", ELEMENT) and rows[key]]
    notes += [f"element {' and '.join(others)} left out"] * bool(others)
    notes += lists_left_out(header)
    mesh = Mesh(points, corners, attributes, of_corners, lambda row: name.face(int(face_of[row])), tuple(notes))
    return surface_of(source, mesh, "ply", words_of(header))


def read_curve(source: Source, header: PlyHeader) -> Surface:
    """Read points that edges join one after another, as a curve of shape (N, 1, 3).

    Raises
    ------
    FormatError
        If edges do not name two vertices each, or join them in no single line.
    """
    tables = read_elements(source.path, header)
    points, attributes = _vertices(tables)
    source.check_vertices(len(points), f"{number(len(points))} vertices")
    edges = tables[CURVE]
    if not {"vertex1", "vertex2"} <= edges.keys():
        raise FormatError(f"expected edges with vertex1 and vertex2, got {', '.join(edges) or 'no property'}")
    segments = np.stack([np.asarray(edges[end], np.int64) for end in ("vertex1", "vertex2")], axis=-1)
    closed = find_curve(len(points), segments, range(1, len(segments) + 1), "edge")
    columns = {name: values[:, None] for name, values in attributes.items()}
    left_out = [f"{name} of edges" for name in edges if name not in ("vertex1", "vertex2")]
    left_out += [f"element {element.name}" for element in header.elements if element.rows]
    left_out = [name for name in left_out if name not in ("element vertex", f"element {CURVE}")]
    for text in [*lists_left_out(header), *(f"{name} left out" for name in left_out)]:
        warn(text)
    metadata = source.metadata("ply") | words_of(header)
    return Surface(points[:, None], (closed, False), attributes=columns, metadata=metadata)


def words_of(header: PlyHeader) -> dict[str, str]:
    """Return unit and CRS from the comments."""
    words: dict[str, str] = {}
    for line in header.info:
        keep_words(words, *line.partition(" ")[::2])
    return words


def lists_left_out(header: PlyHeader) -> list[str]:
    """Return a list, in words, of properties of vertices that are no numbers."""
    return [
        f"list {it.name} of vertices left out"
        for element in header.elements
        if element.name == "vertex"
        for it in element.properties
        if it.count
    ]


class _Names:
    """Names of faces, with their lines where the file is text."""

    def __init__(self, header: PlyHeader) -> None:
        self.line: int | None = None
        if not header.order:
            before = [element.name for element in header.elements].index(ELEMENT)
            self.line = header.lines + 1 + sum(element.rows for element in header.elements[:before])

    def face(self, face: int) -> str:
        return f"face {face + 1}" if self.line is None else f"face {face + 1} (line {self.line + face})"


def _vertices(tables: dict[str, Table]) -> tuple[NDArray[Any], dict[str, NDArray[Any]]]:
    columns = {name: column for name, column in tables.get("vertex", {}).items() if not isinstance(column, Lists)}
    if not {"x", "y", "z"} <= columns.keys():
        raise FormatError(f"expected vertices with x, y and z, got {', '.join(columns) or 'none'}")
    points = np.stack([columns.pop(axis) for axis in "xyz"], axis=-1)
    if not len(points):
        raise FormatError("expected at least one vertex, got none")
    return points, group(columns)


def _places(
    source: Source, lists: Lists, points: NDArray[Any], name: Callable[[int], str]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return triangles and quads, as places in the lists, (T, 4), and the face that each is a part of, (T,)."""
    polygons = polygons_allowed(source.options)
    wrong = (lists.counts < 3) | ((lists.counts > 4) & (not polygons))
    if wrong.any():
        face = int(wrong.argmax())
        check_corners(int(lists.counts[face]), f"in {name(face)}", polygons)
    values = lists.values.astype(np.int64)
    outside = (values < 0) | (values >= len(points))
    if outside.any():
        place = int(outside.argmax())
        face = int(np.searchsorted(np.cumsum(lists.counts), place, "right"))
        raise FormatError(f"expected vertices from 0 to {number(len(points) - 1)}, got {values[place]} in {name(face)}")
    check_faces(source, len(values) - 2 * len(lists.counts))
    return cut_faces(points, lists.counts, values)
