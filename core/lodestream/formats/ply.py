"""PLY: range grids, meshes and curves read; any surface written, binary and little-endian."""

from __future__ import annotations

from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, TooLargeError
from ..surface import Surface
from . import ply_mesh, range_grid
from .ply_elements import read_header
from .quads import columns, edges, quads
from .source import Source, number

__all__ = ["read", "sniff", "write"]

_NAMES = {"f4": "float", "f8": "double"}
_MAX_INDEX = 2**31 - 1
_BLOCK = 1 << 18

#: Largest magnitude of integers that each type holds without rounding, in order of preference.
_EXACT = {"f4": 2**24, "f8": 2**53}


def sniff(head: bytes, suffix: str) -> bool:
    """Whether a file begins like PLY."""
    return head.startswith((b"ply\n", b"ply\r"))


def read(source: Source) -> Surface:
    """Read a range grid, or a mesh or curve that is a structured surface."""
    header = read_header(source.path)
    names = [element.name for element in header.elements]
    if range_grid.ELEMENT in names:
        return range_grid.read(source, header)
    if ply_mesh.ELEMENT in names:
        return ply_mesh.read(source, header)
    if ply_mesh.CURVE in names:
        return ply_mesh.read_curve(source, header)
    raise FormatError(
        f"expected a PLY file with {range_grid.ELEMENT} or {ply_mesh.ELEMENT}, got elements "
        f"{', '.join(names) or 'none'}"
    )


def write(surface: Surface, file: BinaryIO) -> None:
    """Write points, attributes (as ``attribute_0`` and so on) and quads, or edges of a curve.

    Coordinates are float where that holds every value, else double: readers are used to no other types there.
    """
    values = columns(surface)
    if len(values[0]) > _MAX_INDEX:
        raise TooLargeError(f"expected at most {number(_MAX_INDEX)} points for PLY, got {number(len(values[0]))}")
    names = ["x", "y", "z", *(f"attribute_{index}" for index in range(len(values) - 3))]
    types = [_type(name, column) for name, column in zip(names, values, strict=True)]
    connections, curve = (edges(surface), True) if 1 in surface.shape else (quads(surface), False)
    file.write(_header(names, types, len(values[0]), len(connections), curve).encode("ascii"))
    _write_records(file, values, names, types)
    if curve:
        file.write(connections.astype("<i4").tobytes())
    else:
        _write_faces(file, connections)


def _type(name: str, values: NDArray[Any]) -> str:
    if values.dtype.kind == "f":
        return values.dtype.str[1:]
    low, high = int(values.min()), int(values.max())
    for code, limit in _EXACT.items():
        if -limit <= low and high <= limit:
            return code
    raise FormatError(f"expected integers that a double of PLY holds (up to 2^53), got {name} from {low} to {high}")


def _header(names: list[str], types: list[str], points: int, connections: int, curve: bool) -> str:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {points}"]
    lines += [f"property {_NAMES[code]} {name}" for name, code in zip(names, types, strict=True)]
    if curve:
        lines += [f"element edge {connections}", "property int vertex1", "property int vertex2"]
    else:
        lines += [f"element face {connections}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, "end_header", ""])


def _write_records(file: BinaryIO, values: list[NDArray[Any]], names: list[str], types: list[str]) -> None:
    record = np.dtype([(name, f"<{code}") for name, code in zip(names, types, strict=True)])
    for start in range(0, len(values[0]), _BLOCK):
        block = np.empty(len(values[0][start : start + _BLOCK]), record)
        for name, column in zip(names, values, strict=True):
            block[name] = column[start : start + _BLOCK]
        file.write(block.tobytes())


def _write_faces(file: BinaryIO, faces: NDArray[np.int64]) -> None:
    record = np.dtype([("count", "u1"), ("indices", "<i4", 4)])
    for start in range(0, len(faces), _BLOCK):
        block = np.empty(len(faces[start : start + _BLOCK]), record)
        block["count"] = 4
        block["indices"] = faces[start : start + _BLOCK]
        file.write(block.tobytes())
