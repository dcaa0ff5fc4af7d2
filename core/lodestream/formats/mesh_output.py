"""The mesh of a surface as the formats for meshes write it, and what they say about the rest."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError, FormatWarning
from ..heights import coordinates
from ..mesh import weld
from ..surface import Block, Surface
from .source import number

__all__ = ["Output", "check_count", "exact_float", "notes", "output_of", "warn_left_out", "write_lines"]

#: Largest magnitude of integers that each type holds without rounding, in order of preference.
_EXACT = {"f4": 2**24, "f8": 2**53}

_LINES = 1 << 16

#: With fewer points, the edge that closes a curve would lie on one that is there already.
_MIN_CLOSED = 3


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
    for channel in range(3, first.points.shape[2] if first.points.ndim == 3 else 0):
        values = [block.points[:, :, channel].reshape(-1) for block in surface.blocks]
        attributes[f"attribute_{channel - 3}"] = np.concatenate(values)[welded.source]
    for name, array in first.attributes.items():
        values = [block.attributes[name].reshape(-1, *array.shape[2:]) for block in surface.blocks]
        attributes[name] = np.concatenate(values)[welded.source]
    edges = _edges(surface.blocks, welded.source)
    return Output((x, y, z), attributes, welded.quads, welded.triangles, edges, welded.joined)


def _coordinates(surface: Surface, block: Block) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    points = block.points
    if points.ndim == 2:
        return *coordinates(surface), points
    flat = points.shape[2] == 2
    return points[:, :, 0], points[:, :, 1], np.zeros(block.shape, points.dtype) if flat else points[:, :, 2]


def _edges(blocks: tuple[Block, ...], source: NDArray[np.int64]) -> NDArray[np.int64]:
    """Edges of the blocks that are curves, over the vertices, whose points are `source`."""
    result = [np.empty((0, 2), np.int64)]
    start = 0
    for block in blocks:
        count = block.shape[0] * block.shape[1]
        if 1 in block.shape:
            wraps = block.closed[0 if block.shape[1] == 1 else 1] and count >= _MIN_CLOSED
            one = np.arange(count if wraps else count - 1)
            ends = np.stack((one, (one + 1) % count), axis=-1)
            if block.mask is not None:
                ends = ends[block.mask.reshape(-1)[ends].all(axis=1)]
            result.append(np.searchsorted(source, ends + start))
        start += count
    return np.concatenate(result)


def exact_float(values: NDArray[Any], name: str, kind: str) -> NDArray[Any]:
    """Values in the smallest type of floats that holds them; floats as they are.

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


def warn_left_out(kind: str, names: Iterable[str], why: str = "for which it has no place") -> None:
    """Warn of attributes that a file does not have."""
    listed = ", ".join(names)
    if listed:
        warnings.warn(f"{kind} is written without {listed}, {why}", FormatWarning, stacklevel=3)


def notes(metadata: Mapping[str, Any]) -> dict[str, str]:
    """What a file may say about a surface in words: name, unit and CRS, each on one line."""
    found = {key: metadata[key] for key in ("name", "unit", "crs") if isinstance(metadata.get(key), str)}
    return {key: " ".join(value.split())[: 1 << 14] for key, value in found.items() if value.strip()}


def check_count(count: int, most: int, kind: str) -> None:
    """Refuse more vertices than a format can number."""
    if count > most:
        raise FormatError(f"expected at most {number(most)} vertices for {kind}, got {number(count)}")


def write_lines(file: BinaryIO, keyword: str, columns: Sequence[NDArray[Any]]) -> None:
    """Write a line of text for each index of arrays of one length: the keyword, if any, and numbers that read back."""
    template = " ".join([*[keyword] * bool(keyword), *(_spell(column.dtype) for column in columns)]) + "\n"
    for start in range(0, len(columns[0]), _LINES):
        block = [column[start : start + _LINES].tolist() for column in columns]
        flat: list[float] = [0] * (len(block) * len(block[0]))
        for index, column in enumerate(block):
            flat[index :: len(block)] = column
        file.write((template * len(block[0]) % tuple(flat)).encode("ascii"))


def _spell(dtype: np.dtype[Any]) -> str:
    """Choose the shortest of the usual spellings that reads back as the same number."""
    if dtype.kind in "iu":
        return "%d"
    return "%.9g" if dtype.itemsize == 4 else "%r"
