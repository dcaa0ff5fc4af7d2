"""Write OBJ of any surface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...surface import Surface
from ..attributes import COLOR, NORMAL, TEXTURE
from ..mesh_output import Output, extra_channels, output_of, words_of, write_lines
from ..notes import warn_left_out

__all__ = ["write"]

_ROWS = 1 << 16

#: Numbers that may follow the coordinates of a point.
_COLUMNS = 3


def write(surface: Surface, file: BinaryIO) -> None:
    """Write the welded mesh: points, quads, then triangles; or lines of curves. Every number reads back as it was.

    Colours follow x, y and z (integers of 8 bits from 0 to 1), as do three channels beyond the third; normals and
    places in a texture are named by the corners of faces, so that a point may have several. Other attributes have no
    place in OBJ, nor have normals and places in a texture of a curve. Name, unit and CRS are comments.
    """
    mesh = output_of(surface)
    colors, used = _colors(mesh, list(extra_channels(surface.blocks[0]).values()))
    cornered = bool(len(mesh.quads) or len(mesh.triangles))
    others = {key: mesh.attributes[key] for key in (TEXTURE, NORMAL) if cornered and _is_vector(mesh, key)}
    warn_left_out("OBJ", [name for name in mesh.attributes if name not in used | others.keys()])
    for key, text in words_of("OBJ", surface).items():
        file.write(f"# {key} {text}\n".encode())
    places = np.unique(mesh.joined)
    write_lines(file, "v", [column[places] for column in (*mesh.coordinates, *colors)])
    for keyword, key in (("vt", TEXTURE), ("vn", NORMAL)):
        if key in others:
            write_lines(file, keyword, list(others[key].T))
    numbers = np.searchsorted(places, mesh.joined)
    middle = {0: "", 1: "/%d" if TEXTURE in others else "//%d", 2: "/%d/%d"}[len(others)]
    for faces in (mesh.quads, mesh.triangles):
        _write_corners(file, faces, numbers, middle, len(others))
    _write_corners(file, mesh.edges, numbers, "", 0, "l")


def _colors(mesh: Output, channels: Sequence[str]) -> tuple[list[NDArray[Any]], set[str]]:
    """Return three columns to write after the coordinates, or none, and the names of their attributes."""
    color = mesh.attributes.get(COLOR)
    if color is not None and color.ndim == 2 and color.shape[1] in (3, 4):
        values = color[:, :3]
        if color.shape[1] == 4 and not (color[:, 3] == (255 if color.dtype == np.uint8 else 1)).all():
            warn_left_out("OBJ", ["the fourth component of color"])
        if values.dtype == np.uint8:
            values = (values / 255).astype(np.float32)
        return list(values.T), {COLOR}
    if len(channels) == _COLUMNS:
        return [mesh.attributes[name] for name in channels], set(channels)
    return [], set()


def _is_vector(mesh: Output, key: str) -> bool:
    values = mesh.attributes.get(key)
    return values is not None and values.ndim == 2 and values.shape[1] == (3 if key == NORMAL else 2)


def _write_corners(
    file: BinaryIO, faces: NDArray[np.int64], places: NDArray[np.int64], middle: str, others: int, keyword: str = "f"
) -> None:
    """Write faces whose corners name a place and, `others` times, the vertex itself."""
    line = " ".join([keyword] + [f"%d{middle}"] * faces.shape[1]) + "\n"
    for start in range(0, len(faces), _ROWS):
        block = faces[start : start + _ROWS]
        numbers = np.stack([places[block], *[block] * others], axis=-1) + 1
        file.write((line * len(block) % tuple(numbers.reshape(-1).tolist())).encode("ascii"))
