"""Write PLY of any surface, binary and little-endian if its faces have the same number of corners."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...surface import Surface
from ..attributes import group, split
from ..mesh_output import check_count, exact_float, output_of, words_of, write_lines
from ..notes import listing, survives, warn, warn_left_out

__all__ = ["write"]

_TYPES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
_MAX_INDEX = 2**31 - 1
_BLOCK = 1 << 18


def write(surface: Surface, file: BinaryIO) -> None:
    """Write the welded mesh: vertices with their attributes, quads, then triangles; or edges of curves.

    Coordinates are float where that holds every integer, else double: readers are used to no other types there. Colours
    become red, green and blue, normals nx, ny, nz, places in a texture s and t; other attributes keep their name, with
    the number of the component. Name, unit and CRS are comments. A mesh of quads and triangles is written as text,
    since some libraries (trimesh) read lists of several lengths from text only.
    """
    mesh = output_of(surface)
    vertices = {
        axis: exact_float(column, axis, "PLY") for axis, column in zip("xyz", mesh.coordinates, strict=True)
    } | _columns(mesh.attributes)
    count = len(mesh.coordinates[0])
    check_count(count, _MAX_INDEX, "PLY")
    faces = len(mesh.quads) + len(mesh.triangles)
    text = bool(len(mesh.quads) and len(mesh.triangles))
    lines = ["ply", f"format {'ascii' if text else 'binary_little_endian'} 1.0"]
    lines += [f"comment {key} {text}" for key, text in _words(surface).items()]
    lines += [f"element vertex {count}"]
    lines += [f"property {_TYPES[column.dtype.str[1:]]} {name}" for name, column in vertices.items()]
    if faces or not len(mesh.edges):
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    if len(mesh.edges):
        lines += [f"element edge {len(mesh.edges)}", "property int vertex1", "property int vertex2"]
    file.write("\n".join([*lines, "end_header", ""]).encode("ascii"))
    if text:
        write_lines(file, "", list(vertices.values()))
        for corners in (mesh.quads, mesh.triangles):
            write_lines(file, str(corners.shape[1]), list(corners.T))
        if len(mesh.edges):
            write_lines(file, "", list(mesh.edges.T))
        return
    _write_rows(file, vertices)
    _write_faces(file, mesh.quads if len(mesh.quads) else mesh.triangles)
    file.write(mesh.edges.astype("<i4").tobytes())


def _columns(attributes: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Return the columns of attributes with types and names of PLY."""
    result: dict[str, NDArray[Any]] = {}
    rounded = []
    for name, column in split(attributes).items():
        if column.dtype.str[1:] not in _TYPES:
            if not survives(column, np.float64):
                rounded.append(name)
            column = column.astype(np.float64)
        label = _ascii(name, "!-~") or "_"
        while label in result or label in ("x", "y", "z"):
            label += "_"
        result[label] = column
    warn_left_out("PLY", [f"the last bits of {name}" for name in rounded], "whose integers it rounds to doubles")
    back = group(result)
    renamed = [name for name, column in attributes.items() if not _same_shape(column, back.get(name))]
    if renamed:
        warn(f"PLY is written with {listing(renamed)} under other names: it is read back as {listing(back)}")
    return result


def _same_shape(column: NDArray[Any], back: NDArray[Any] | None) -> bool:
    """Return whether an attribute comes back with its shape, or without its one component."""
    return back is not None and back.reshape(len(back), -1).shape == column.reshape(len(column), -1).shape


def _words(surface: Surface) -> dict[str, str]:
    """Return name, unit and CRS in characters that a header may have."""
    words = words_of("PLY", surface)
    plain = {key: _ascii(text, " -~") for key, text in words.items()}
    changed = [key for key, text in words.items() if plain[key] != text]
    warn_left_out("PLY", [f"some characters of {key}" for key in changed], "which are not ASCII")
    return plain


def _ascii(text: str, allowed: str) -> str:
    return re.sub(f"[^{allowed}]", "_", text)


def _write_rows(file: BinaryIO, columns: Mapping[str, NDArray[Any]]) -> None:
    record = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    count = len(columns["x"])
    for start in range(0, count, _BLOCK):
        rows = np.empty(min(_BLOCK, count - start), record)
        for name, column in columns.items():
            rows[name] = column[start : start + _BLOCK]
        file.write(rows.tobytes())


def _write_faces(file: BinaryIO, faces: NDArray[np.int64]) -> None:
    corners = faces.shape[1]
    record = np.dtype([("count", "u1"), ("indices", "<i4", corners)])
    for start in range(0, len(faces), _BLOCK):
        rows = np.empty(len(faces[start : start + _BLOCK]), record)
        rows["count"] = corners
        rows["indices"] = faces[start : start + _BLOCK]
        file.write(rows.tobytes())
