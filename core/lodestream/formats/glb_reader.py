"""Binary glTF 2.0 (.glb), read: the triangles of all meshes of its scene, as one mesh.

trimesh finds them. Before it does, the scene's JSON is checked for what it would skip, or take without limit.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..mesh import Mesh
from ..surface import Surface
from .attributes import COLOR, NORMAL, TEXTURE
from .meshes import check_faces, surface_of
from .notes import keep_words, listing
from .source import Source, number
from .trimesh_meshes import mesh_of, parts_of

__all__ = ["read"]

_HEAD, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
#: Nodes above one another: trimesh walks up from each of them.
_DEEPEST = 64
#: Extensions that change nothing about the points; others that a file requires might.
_HARMLESS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "EXT_texture_", "KHR_xmp")


def read(source: Source) -> Surface:
    """Read a mesh that is a structured surface: all meshes of the scene at their places, triangles only.

    Colours, normals, places in a texture and numbers of vertices are attributes, if all meshes have them. Textures and
    animations are left out.

    Raises
    ------
    FormatError
        If the file is not whole, or its faces are no grid.
    """
    content = source.path.read_bytes()
    scene, binary = _parts(content)
    notes = _check(source, scene)
    _simplify(scene)
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    plain = _HEAD.pack(b"glTF", 2, _HEAD.size + 2 * _CHUNK.size + len(text) + len(binary))
    file = io.BytesIO(plain + _CHUNK.pack(len(text), b"JSON") + text + _CHUNK.pack(len(binary), b"BIN\0") + binary)
    parts = parts_of(file, "glb")
    if not parts:
        raise FormatError("this GLB has no triangles in its scene")
    vertices = sum(len(part.vertices) for part, _ in parts)  # a mesh may be at many places
    source.check_vertices(vertices, f"{number(vertices)} vertices of all meshes in the scene")
    check_faces(source, sum(len(part.faces) for part, _ in parts))
    mesh, left_out = _joined([_placed(mesh_of(part), matrix) for part, matrix in parts])
    notes += [f"{listing(left_out)} left out, which some of the meshes lack"] * bool(left_out)
    asset = scene.get("asset")
    extras = asset.get("extras") if isinstance(asset, dict) else None
    words: dict[str, str] = {}
    for key, value in extras.items() if isinstance(extras, dict) else ():
        keep_words(words, str(key), str(value))
    return surface_of(source, Mesh(mesh.vertices, mesh.corners, mesh.attributes, notes=tuple(notes)), "glb", words)


def _parts(content: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the JSON and the binary chunk of a file.

    Raises
    ------
    FormatError
    """
    if len(content) < _HEAD.size + _CHUNK.size:
        raise FormatError(f"this GLB is cut short in its header: it has {number(len(content))} bytes")
    _, version, length = _HEAD.unpack_from(content)
    if version != 2:
        raise FormatError(f"this GLB has version {version} of glTF: export it again with version 2")
    if length != len(content):
        words = "is cut short" if len(content) < length else "goes on behind its end"
        raise FormatError(f"this GLB {words}: it says {number(length)} bytes, and has {number(len(content))}")
    chunks: dict[bytes, bytes] = {}
    place = _HEAD.size
    while place + _CHUNK.size <= length:
        size, kind = _CHUNK.unpack_from(content, place)
        place += _CHUNK.size
        if place + size > length:
            raise FormatError(
                f"this GLB is damaged: a chunk says {number(size)} bytes, and {number(length - place)} are left"
            )
        chunks.setdefault(kind, content[place : place + size])
        place += size
    try:
        scene = json.loads(chunks.get(b"JSON", b""))
    except (ValueError, RecursionError):
        scene = None
    if not isinstance(scene, dict):
        raise FormatError("this GLB is damaged: it has no chunk with a scene in JSON")
    return scene, chunks.get(b"BIN\0", b"")


def _maps(scene: dict[str, Any], key: str) -> Iterator[dict[str, Any]]:
    """Return the maps in a list of the scene.

    Raises
    ------
    FormatError
        If it is no list of maps.
    """
    items = scene.get(key, [])
    if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
        raise FormatError(f"expected {key} of the scene as a list of maps, got something else")
    return iter(items)


def _check(source: Source, scene: dict[str, Any]) -> list[str]:
    """Refuse what would be read wrongly or without limit; return what is left out, in words."""
    required = scene.get("extensionsRequired", [])
    foreign = [name for name in required if not str(name).startswith(_HARMLESS)] if isinstance(required, list) else []
    if foreign:
        raise FormatError(
            f"this GLB needs the extension {str(foreign[0])[:60]}: export it again without, so that its points are "
            "neither compressed nor packed"
        )
    if any("uri" in buffer for buffer in _maps(scene, "buffers")):
        raise FormatError("this GLB names another file, and none is opened: export it again with its buffers in it")
    views: list[Any] = [view.get("byteLength") for view in _maps(scene, "bufferViews")]
    # trimesh copies each; views of one part of a buffer are rare.
    if not all(isinstance(length, int) and length >= 0 for length in views) or sum(views) > 2 * source.size:
        raise FormatError(f"expected views of at most twice the {number(source.size)} bytes of the file, got more")
    if _depth(list(_maps(scene, "nodes"))) > _DEEPEST:
        raise FormatError(f"expected at most {_DEEPEST} nodes above one another in the scene, got more")
    for accessor in _maps(scene, "accessors"):
        count = accessor.get("count")
        # A value takes a byte at least.
        if not isinstance(count, int) or not 0 < count <= source.size or accessor.get("sparse"):
            raise FormatError(
                f"expected arrays of GLB that are stored whole in its {number(source.size)} bytes, got one of "
                f"{str(count)[:20]} values"
            )
        if "bufferView" not in accessor:
            raise FormatError("expected arrays of GLB that are stored, got one of zeros")
    primitives = [primitive for mesh in _maps(scene, "meshes") for primitive in _maps(mesh, "primitives")]
    modes = [primitive.get("mode", _TRIANGLES) for primitive in primitives]
    if _FAN in modes:
        raise FormatError("this GLB has fans of triangles: export it again as single triangles or strips")
    notes = ["lines and points of the scene left out"] * any(mode not in (_TRIANGLES, _STRIP) for mode in modes)
    notes += ["further shapes (morph targets) left out"] * any(primitive.get("targets") for primitive in primitives)
    return notes + ["textures left out"] * bool(scene.get("textures"))


def _depth(nodes: list[dict[str, Any]]) -> int:
    """Return how many nodes stand above one another at most, each counted once; more than the deepest, in circles."""
    children = [
        [child for child in listed if isinstance(child, int) and 0 <= child < len(nodes)]
        if isinstance(listed := node.get("children"), list)
        else []
        for node in nodes
    ]
    below = {child for listed in children for child in listed}
    row, seen, depth = [number for number in range(len(nodes)) if number not in below], set[int](), 0
    while row:
        depth += 1
        seen.update(row)
        row = [child for number in row for child in children[number] if child not in seen]
        row = list(dict.fromkeys(row))
    return depth if len(seen) == len(nodes) else _DEEPEST + 1


def _simplify(scene: dict[str, Any]) -> None:
    """Leave out materials, images, cameras and animations; a material is what trimesh reads places in a texture by."""
    for key in ("materials", "textures", "images", "samplers", "cameras", "animations", "skins"):
        scene.pop(key, None)
    scene["materials"] = [{}]
    for mesh in _maps(scene, "meshes"):
        for primitive in _maps(mesh, "primitives"):
            attributes = primitive.get("attributes")
            if not isinstance(attributes, dict):
                raise FormatError("expected primitives of GLB with attributes, got one without")
            primitive.pop("material", None)
            if "TEXCOORD_0" in attributes:
                primitive["material"] = 0
    for node in _maps(scene, "nodes"):
        node.pop("camera", None)


def _placed(mesh: Mesh, matrix: NDArray[np.float64]) -> Mesh:
    """Return a mesh moved to where the scene has it; as it is if it is there, which float32 holds."""
    attributes = {
        _plain(name): values[:, 0] if values.shape[1:] == (1,) else values for name, values in mesh.attributes.items()
    }
    if np.array_equal(matrix, np.eye(4)):
        return Mesh(mesh.vertices.astype(np.float32), mesh.corners, attributes)
    turn = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        determinant = np.linalg.det(turn)
    if not np.isfinite(matrix).all() or not np.isfinite(determinant):
        raise FormatError(
            "expected meshes of GLB at finite places, got one with a matrix that is not finite, or beyond"
        )
    if determinant == 0:
        raise FormatError("this GLB has a mesh that its matrix makes flat: export it again with another scale")
    if NORMAL in attributes:
        normals = attributes[NORMAL] @ np.linalg.inv(turn)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        attributes[NORMAL] = normals / np.where(length > 0, length, 1)
    corners = mesh.corners if determinant > 0 else mesh.corners[:, [0, 2, 1, 3]]
    return Mesh(mesh.vertices @ turn.T + matrix[:3, 3], corners, attributes)


def _plain(name: str) -> str:
    """Return the name of an attribute: those that are the file's own have capitals and a line before them."""
    return name if name in (COLOR, NORMAL, TEXTURE) else name.removeprefix("_").lower()


def _joined(meshes: list[Mesh]) -> tuple[Mesh, list[str]]:
    """Make one mesh of several, with the attributes that all of them have, and the names of the others."""
    before = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    corners = [
        np.where(mesh.corners >= 0, mesh.corners + start, -1) for mesh, start in zip(meshes, before[:-1], strict=True)
    ]
    kinds = [{name: (v.dtype, v.shape[1:]) for name, v in mesh.attributes.items()} for mesh in meshes]
    shared = [name for name in kinds[0] if all(kind.get(name) == kinds[0][name] for kind in kinds)]
    left_out = sorted({name for kind in kinds for name in kind} - set(shared))
    attributes = {name: np.concatenate([mesh.attributes[name] for mesh in meshes]) for name in shared}
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    return Mesh(vertices, np.concatenate(corners).astype(np.int32), attributes), left_out
