"""Write binary glTF 2.0 (.glb) of any surface.

The container is written here because it is a header and two chunks, while libraries for it keep the whole file in
memory. Source: Khronos Group, glTF 2.0 Specification, sections 3.6 (accessors), 3.7 (meshes) and 4 (GLB).
"""

from __future__ import annotations

import json
import re
import struct
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..surface import Surface
from .attributes import COLOR, NORMAL, TEXTURE
from .mesh_output import Output, check_count, output_of, words_of
from .notes import listing, survives, warn, warn_left_out
from .source import number

__all__ = ["MEDIA_TYPE", "sniff", "write"]

MEDIA_TYPE = "model/gltf-binary"

_MAGIC, _VERSION = b"glTF", 2
_MAX_INDEX = 2**32 - 2  # the last one restarts a primitive
_MAX_BYTES = 2**32 - 1
_FLOAT, _UINT, _BYTE = 5126, 5125, 5121
_ARRAY, _ELEMENTS = 34962, 34963
_TRIANGLES, _LINES, _POINTS = 4, 1, 0
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}

#: How far from 1 the length of a normal may be, as glTF's validator has it.
_UNIT = 5e-4


def sniff(head: bytes, suffix: str) -> bool:
    """Return whether a file begins like binary glTF."""
    return head.startswith(_MAGIC)


def write(surface: Surface, file: BinaryIO) -> None:
    """Write the welded mesh as triangles; a curve as lines.

    glTF has float32 only. Where coordinates need more, they are stored from the middle of their box, which the node's
    translation puts back, so that they lose least; that, and attributes that lose bits, are warned of. Colours become
    COLOR_0, unit normals NORMAL, places in a texture TEXCOORD_0 (whose second axis points down there), and others
    ``_NAME``. Name, unit and CRS are in the ``extras`` of the asset.
    """
    mesh = output_of(surface)
    check_count(len(mesh.joined), _MAX_INDEX, "GLB")
    content = _Content()
    places, translation = _places(mesh)
    bounds = {"min": places.min(axis=0).tolist(), "max": places.max(axis=0).tolist()}
    attributes = {"POSITION": content.add(places, _ARRAY, **bounds)}
    rounded = _add_attributes(content, mesh, attributes)
    indices, mode = _indices(mesh)
    primitive: dict[str, Any] = {"attributes": attributes, "mode": mode}
    if indices.size:
        primitive["indices"] = content.add(indices, _ELEMENTS)
    if translation is not None:
        rounded.insert(0, "coordinates")
    if rounded:
        warn(f"GLB is written with float32, to which it rounds {listing(rounded)}")
    node = {"mesh": 0} | ({"translation": translation} if translation is not None else {})
    extras = words_of("GLB", surface)
    scene = {
        "asset": {"version": "2.0", "generator": "Lodestream"} | ({"extras": extras} if extras else {}),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "accessors": content.accessors,
        "bufferViews": content.views,
        "buffers": [{"byteLength": content.size}],
    }
    _write_container(file, scene, content)


class _Content:
    """The arrays of a file, and how glTF describes them."""

    def __init__(self) -> None:
        self.arrays: list[NDArray[Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.size = 0

    def add(self, values: NDArray[Any], target: int, **more: Any) -> int:
        """Add an array whose rows are whole words of four bytes, and return the number of its accessor."""
        kinds = {"f4": _FLOAT, "u4": _UINT, "u1": _BYTE}
        code = values.dtype.str[1:]
        width = values.shape[1] if values.ndim == 2 else 1
        self.views.append({"buffer": 0, "byteOffset": self.size, "byteLength": values.nbytes, "target": target})
        accessor = {"bufferView": len(self.views) - 1, "componentType": kinds[code], "count": len(values)}
        self.accessors.append(accessor | {"type": _SHAPES[width]} | more)
        self.arrays.append(values.astype(values.dtype.newbyteorder("<"), copy=False))
        self.size += values.nbytes
        return len(self.accessors) - 1


def _places(mesh: Output) -> tuple[NDArray[np.float32], list[float] | None]:
    """Return coordinates as float32, and their origin if that is not 0."""
    exact = np.stack([column.astype(np.float64) for column in mesh.coordinates], axis=-1)
    with np.errstate(over="ignore"):
        places = exact.astype(np.float32)
    if np.array_equal(places, exact):
        return places, None
    if not np.isfinite(places).all():
        raise FormatError("expected coordinates that float32 of GLB can hold, got larger ones")
    middle = ((exact.min(axis=0) + exact.max(axis=0)) / 2).astype(np.float32).astype(np.float64)
    return (exact - middle).astype(np.float32), middle.tolist()


def _indices(mesh: Output) -> tuple[NDArray[np.uint32], int]:
    if len(mesh.edges):
        return mesh.edges.astype(np.uint32).reshape(-1), _LINES
    halves = mesh.quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)
    triangles = np.concatenate([halves, mesh.triangles]).astype(np.uint32)
    return triangles.reshape(-1), _TRIANGLES if len(triangles) else _POINTS


def _add_attributes(content: _Content, mesh: Output, attributes: dict[str, int]) -> list[str]:
    """Add the attributes, and return the names of those that lose bits."""
    rounded = []
    for name, values in mesh.attributes.items():
        width = values.shape[1] if values.ndim == 2 else 1
        if name == COLOR and values.dtype == np.uint8 and width in (3, 4):
            colors = np.full((len(values), 4), 255, np.uint8)  # three bytes would not be whole words
            colors[:, :width] = values
            attributes["COLOR_0"] = content.add(colors, _ARRAY, normalized=True)
            continue
        with np.errstate(over="ignore"):
            floats = values.astype(np.float32)
        if not survives(values, np.float32) or np.isnan(floats).any():
            rounded.append(name)
        if values.dtype.kind == "f" and np.isinf(values).any():
            warn_left_out("GLB", [f"the infinities of {name}"], "in whose place it has the largest numbers")
        floats = np.nan_to_num(floats)  # no NaN or infinity may stand in a file
        if name == NORMAL and width == 3 and (np.abs(np.linalg.norm(floats, axis=1) - 1) < _UNIT).all():
            attributes["NORMAL"] = content.add(floats, _ARRAY)
        elif name == TEXTURE and width == 2:
            floats[:, 1] = 1 - floats[:, 1]
            attributes["TEXCOORD_0"] = content.add(floats, _ARRAY)
        elif width in _SHAPES:
            attributes[_free(name, attributes)] = content.add(floats, _ARRAY)
        else:
            for component in range(width):
                column = np.ascontiguousarray(floats[:, component])
                attributes[_free(f"{name}_{component}", attributes)] = content.add(column, _ARRAY)
    return rounded


def _free(name: str, taken: dict[str, int]) -> str:
    label = "_" + re.sub(r"\W", "_", name.upper(), flags=re.ASCII)
    while label in taken:
        label += "_"
    return label


def _write_container(file: BinaryIO, scene: dict[str, Any], content: _Content) -> None:
    text = json.dumps(scene, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + content.size
    if total > _MAX_BYTES:
        raise FormatError(f"expected at most {number(_MAX_BYTES)} bytes for GLB, got {number(total)}")
    file.write(struct.pack("<4sII", _MAGIC, _VERSION, total))
    file.write(struct.pack("<I4s", len(text), b"JSON") + text)
    file.write(struct.pack("<I4s", content.size, b"BIN\0"))
    for array in content.arrays:
        file.write(array.tobytes())
