"""The mesh of a surface for mesh formats, and their notes about the rest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..coordinates.height_fields import coordinates
from ..errors import FormatError
from ..mesh import weld
from ..surface import Block, Surface
from ..text import printable
from .notes import metadata_left_out, warn_left_out
from .source import number

__all__ = ["Output", "check_count", "exact_float", "extra_channels", "output_of", "words_of", "write_lines"]

#: Largest magnitude of integers that each type holds without rounding, in order of preference.
_EXACT = {"f4": 2**24, "f8": 2**53}

_LINES = 1 << 16

#: What a file may say in words, and how long it may be.
_WORDS = ("name", "unit", "crs")
_LONGEST_WORDS = 1 << 14


@dataclass(frozen=True, slots=True)
class Output:
    """A welded mesh.

    Attributes
    ----------
    coordinates : three arrays of shape (V,)
        x, y and z of the vertices, each in a type of its own.
    attributes : dict of str to arrays of shape (V,) or (V, K)
        Channels of the points beyond the third are ``attribute_0`` and so on.
    quads, triangles, edges : int64 arrays of shape (Q, 4), (T, 3) and (E, 2)
        0-based vertices; edges are those of curves.
    joined : int64 array of shape (V,)
        For each vertex, the first at its place that differs in nothing but attributes.
    """

    coordinates: tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
    attributes: dict[str, NDArray[Any]]
    quads: NDArray[np.int64]
    triangles: NDArray[np.int64]
    edges: NDArray[np.int64]
    joined: NDArray[np.int64]


def output_of(surface: Surface) -> Output:
    """Make the mesh of a surface: blocks joined where they touch, closed axes by faces, holes left open.

    Heights stand over their coordinates, planar points have z = 0.
    """
    welded = weld(surface)
    places = [_coordinates(surface, block) for block in surface.blocks]
    x, y, z = (np.concatenate([place[axis].reshape(-1) for place in places])[welded.source] for axis in range(3))
    attributes: dict[str, NDArray[Any]] = {}
    first = surface.blocks[0]
    for channel, name in extra_channels(first).items():
        values = [block.points[:, :, channel].reshape(-1) for block in surface.blocks]
        attributes[name] = np.concatenate(values)[welded.source]
    for name, array in first.attributes.items():
        values = [block.attributes[name].reshape(-1, *array.shape[2:]) for block in surface.blocks]
        attributes[name] = np.concatenate(values)[welded.source]
    return Output((x, y, z), attributes, welded.quads, welded.triangles, welded.edges, welded.joined)


def extra_channels(block: Block) -> dict[int, str]:
    """Return the channels of points beyond the third, with their names as attributes."""
    result = {}
    for channel in range(3, block.points.shape[2] if block.points.ndim == 3 else 0):
        name = f"attribute_{channel - 3}"
        while name in block.attributes:
            name += "_"
        result[channel] = name
    return result


def _coordinates(surface: Surface, block: Block) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    points = block.points
    if points.ndim == 2:
        return *coordinates(surface), points
    flat = points.shape[2] == 2
    return points[:, :, 0], points[:, :, 1], np.zeros(block.shape, points.dtype) if flat else points[:, :, 2]


def exact_float(values: NDArray[Any], name: str, kind: str) -> NDArray[Any]:
    """Return values of any shape in the smallest floating type that holds them; floats unchanged.

    Raises
    ------
    FormatError
        When integers need more bits than float64 has; `name` and the `kind` of file are for its message.
    """
    if values.dtype.kind == "f":
        return values
    low, high = (int(values.min()), int(values.max())) if values.size else (0, 0)
    for code, limit in _EXACT.items():
        if -limit <= low and high <= limit:
            return values.astype(code)
    raise FormatError(f"expected integers that a double of {kind} holds (up to 2^53), got {name} from {low} to {high}")


def words_of(kind: str, surface: Surface) -> dict[str, str]:
    """Return name, unit and CRS of a surface as texts of one line each; a note is issued of the rest.

    Parameters
    ----------
    kind : str
        What people call the format.
    surface : Surface
    """
    held = {key: surface.metadata[key] for key in _WORDS if isinstance(surface.metadata.get(key), str)}
    lines = {key: " ".join(text.split()) for key, text in held.items() if text.strip()}
    words = {key: printable(text) for key, text in lines.items()}
    changed = [f"control characters of {key}" for key, text in lines.items() if words[key] != text]
    warn_left_out(kind, changed, "which are written as Python writes them")
    long = [key for key, text in words.items() if len(text) > _LONGEST_WORDS]
    warn_left_out(kind, long, f"which is longer than {number(_LONGEST_WORDS)} characters")
    places = ("geotransform", "grid", "axes")  # the points of a mesh have places of their own
    warn_left_out(kind, metadata_left_out(surface, (*held, *places, "faces")))
    return {key: text for key, text in words.items() if key not in long}


def check_count(count: int, most: int, kind: str) -> None:
    """Refuse more vertices than a format can number.

    Raises
    ------
    FormatError
        If there are more than ``most``; ``kind`` names the format in the message.
    """
    if count > most:
        raise FormatError(f"expected at most {number(most)} vertices for {kind}, got {number(count)}")


def write_lines(file: BinaryIO, keyword: str, columns: Sequence[NDArray[Any]]) -> None:
    """Write lines of text from columns of shape (line,): the keyword, if any, and numbers that read back."""
    template = " ".join([*[keyword] * bool(keyword), *(_spell(column.dtype) for column in columns)]) + "\n"
    for start in range(0, len(columns[0]), _LINES):
        block = [column[start : start + _LINES].tolist() for column in columns]
        flat: list[float] = [0] * (len(block) * len(block[0]))
        for index, column in enumerate(block):
            flat[index :: len(block)] = column
        file.write((template * len(block[0]) % tuple(flat)).encode("ascii"))


def _spell(dtype: np.dtype[Any]) -> str:
    """Return the shortest of the usual formats that reads back as the same number."""
    if dtype.kind in "iu":
        return "%d"
    return "%.9g" if dtype.itemsize == 4 else "%r"
