"""The mesh of a surface: its blocks joined where they touch, poles as fans, holes left open."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface import Block, Surface
from .cells import unpack_cells

__all__ = ["SIDES", "Faces", "Weld", "face_map", "faces_of", "on_border", "weld"]

#: With fewer points, the faces that join the ends of a closed axis would lie on those already there.
_MIN_CLOSED = 3

#: The sides of a block, as the metadata name them, and the points on each.
SIDES: dict[str, tuple[slice | int, slice | int]] = {
    "first_row": (0, slice(None)),
    "last_row": (-1, slice(None)),
    "first_column": (slice(None), 0),
    "last_column": (slice(None), -1),
}


class Faces(NamedTuple):
    """A welded mesh, as `faces_of` gives it.

    Attributes
    ----------
    vertices : array of shape (V, 3)
        x, y, z. Heights are drawn over x and y, planar points get z = 0. The surface's type; float64 where the
        coordinates of heights are not whole.
    quads : int64 array of shape (Q, 4)
        0-based vertices of each quad, going round it.
    triangles : int64 array of shape (T, 3)
        0-based vertices of each triangle, going round it.
    attributes : dict of str to arrays of shape (V,) or (V, K)
        The blocks' attributes; channels of the points beyond the third are ``attribute_0`` and so on.
    """

    vertices: NDArray[Any]
    quads: NDArray[np.int64]
    triangles: NDArray[np.int64]
    attributes: dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Weld:
    """Which points of a surface are the vertices of its mesh, and the faces over them.

    Attributes
    ----------
    source : int64 array of shape (V,)
        For each vertex, the point that it is: its index among the points of all blocks, one block after another, each
        in row order. Increasing.
    quads : int64 array of shape (Q, 4)
        0-based vertices of each quad, going round it.
    triangles : int64 array of shape (T, 3)
        0-based vertices of each triangle, going round it.
    joined : int64 array of shape (V,)
        For each vertex, the first vertex at the same place that is the same vertex but for its attributes; itself where
        there is no other. A format whose faces name places and attributes separately, like OBJ, writes the places of
        these alone.
    """

    source: NDArray[np.int64]
    quads: NDArray[np.int64]
    triangles: NDArray[np.int64]
    joined: NDArray[np.int64]


def faces_of(surface: Surface) -> Faces:
    """Make the mesh of a surface, for the formats whose vertices carry their attributes with them.

    Blocks are welded where vertices on their sides have the same coordinates and attributes, closed axes are joined by
    faces, a collapsed side is one vertex with a fan of triangles, and cells at holes are left out; see
    `lodestream.mesh` for what the metadata say about it. Every valid point is a vertex, with a face or without.

    Raises
    ------
    InputError
        When the metadata's ``faces``, ``poles`` or ``geotransform`` are not of the form that they should have.
    """
    welded = weld(surface)
    vertices = np.concatenate([_coordinates(block, surface.metadata) for block in surface.blocks])[welded.source]
    attributes: dict[str, NDArray[Any]] = {}
    first = surface.blocks[0]
    for channel in range(3, first.points.shape[2] if first.points.ndim == 3 else 0):
        values = [block.points[:, :, channel].reshape(-1) for block in surface.blocks]
        attributes[f"attribute_{channel - 3}"] = np.concatenate(values)[welded.source]
    for name, array in first.attributes.items():
        values = [block.attributes[name].reshape(-1, *array.shape[2:]) for block in surface.blocks]
        attributes[name] = np.concatenate(values)[welded.source]
    return Faces(vertices, welded.quads, welded.triangles, attributes)


def weld(surface: Surface) -> Weld:
    """Find the vertices and faces of a surface's mesh; what `faces_of` makes it of.

    Raises
    ------
    InputError
        When the metadata's ``faces`` or ``poles`` are not of the form that they should have.
    """
    poles = _poles(surface)
    parts, start = [], 0
    for number, block in enumerate(surface.blocks):
        parts.append(_Part.of(block, start, face_map(surface.metadata, number, len(surface.blocks))))
        start += parts[-1].points.size
    joined = np.arange(start)
    _join_borders([part for part in parts if part.joins(len(parts))], joined)
    for number, side, _ in poles:
        if not parts[number].joins(len(parts)):
            row = parts[number].points[SIDES[side]]
            joined[row] = joined[row].min()
    vertex = _same_vertices(surface.blocks, joined)
    quads, triangles = [], []
    for number, part in enumerate(parts):
        degenerate = any(pole == number and kind == "degenerate" for pole, _, kind in poles)
        part_quads, part_triangles = _faces(part, joined, degenerate)
        quads.append(part_quads)
        triangles.append(part_triangles)
    return _compressed(surface.blocks, vertex, joined, np.concatenate(quads), np.concatenate(triangles))


@dataclass(frozen=True, slots=True)
class _Part:
    """A block, its points as numbers among those of all blocks, what is said of its faces, and which cells have one."""

    block: Block
    points: NDArray[np.int64]
    faces: Mapping[str, Any]
    cells: NDArray[np.bool_]

    @staticmethod
    def of(block: Block, start: int, faces: Mapping[str, Any]) -> _Part:
        height, width = block.shape
        valid = np.ones(block.shape, np.bool_) if block.mask is None else block.mask
        cells = valid.copy()
        for axis in (0, 1):
            cells &= np.roll(cells, -1, axis)
            if not _wraps(block, axis):
                cells = cells[:-1] if axis == 0 else cells[:, :-1]
        left_out = unpack_cells(faces.get("left_out"), cells.shape)
        if left_out is not None:
            cells &= ~left_out
        return _Part(block, start + np.arange(height * width).reshape(height, width), faces, cells)

    def joins(self, blocks: int) -> bool:
        """Whether its border is joined to others at the same place; `blocks` is the number of all."""
        return bool(self.faces.get("joined", blocks > 1))


def _wraps(block: Block, axis: int) -> bool:
    return block.closed[axis] and block.shape[axis] >= _MIN_CLOSED


def on_border(cells: NDArray[np.bool_], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Which nodes of a grid have fewer than four faces, from the cells that have one; fewer cells on open axes."""
    full = np.zeros(shape, np.bool_)
    full[: cells.shape[0], : cells.shape[1]] = cells
    for axis in (0, 1):
        full &= np.roll(full, 1, axis)
    return ~full


def face_map(metadata: Mapping[str, Any], block: int, blocks: int) -> Mapping[str, Any]:
    """What the metadata's ``faces`` say about a block of so many; empty where they say nothing.

    Raises
    ------
    InputError
        When they are not of the form that `lodestream.mesh` describes.
    """
    faces = metadata.get("faces", {})
    if isinstance(faces, list | tuple) and len(faces) == blocks:
        faces = faces[block]
    if not isinstance(faces, Mapping) or faces.get("diagonal") not in (None, "main", "anti"):
        raise InputError(f"expected a map in the metadata's faces, or one for each of {blocks} blocks, got {faces!r}")
    return faces


def _poles(surface: Surface) -> list[tuple[int, str, str]]:
    """Block, side and kind of the poles that are one vertex."""
    result = []
    entries = surface.metadata.get("poles", [])
    try:
        for entry in entries:
            number, side, kind = int(entry["block"]), str(entry["side"]), str(entry["kind"])
            if not 0 <= number < len(surface.blocks) or side not in SIDES:
                raise KeyError(side)
            if kind in ("fan", "degenerate") and _is_point(surface.blocks[number], side):
                result.append((number, side, kind))
    except (TypeError, KeyError, ValueError):
        raise InputError(f"expected poles with block, side and kind in the metadata, got {entries!r}") from None
    return result


def _is_point(block: Block, side: str) -> bool:
    """Whether a side lies at one place still, as that of a window of the surface need not."""
    points = block.points[SIDES[side]]
    return points.ndim == 2 and bool((points[:, :3] == points[0, :3]).all())


def _join_borders(parts: list[_Part], joined: NDArray[np.int64]) -> None:
    """Let border points at the same place, in blocks of the same part of the surface, stand for the first of them."""
    together: dict[int, list[tuple[NDArray[np.int64], NDArray[Any]]]] = {}
    for part in parts:
        block = part.block
        if block.points.ndim != 3:
            continue
        border = on_border(part.cells, block.shape)
        if block.mask is not None:
            border &= block.mask
        places = block.points[border][:, :3]
        together.setdefault(int(part.faces.get("part", 0)), []).append((part.points[border], places))
    for borders in together.values():
        index = np.concatenate([points for points, _ in borders])
        joined[index] = index[_first_equal([np.concatenate([places for _, places in borders])])]


def _same_vertices(blocks: tuple[Block, ...], joined: NDArray[np.int64]) -> NDArray[np.int64]:
    """For each point, the first of those that it is joined with that has the same attributes."""
    vertex = np.arange(len(joined))
    together = np.flatnonzero(joined != vertex)
    if not together.size:
        return vertex
    together = np.union1d(together, joined[together])
    start, keys = 0, []
    for block in blocks:
        count = block.points.shape[0] * block.points.shape[1]
        inside = together[(together >= start) & (together < start + count)] - start
        arrays = [block.points, *block.attributes.values()]
        keys.append([array.reshape(count, -1)[inside] for array in arrays])
        start += count
    columns = [np.concatenate(column) for column in zip(*keys, strict=True)]
    vertex[together] = together[_first_equal([joined[together], *columns])]
    return vertex


def _first_equal(columns: list[NDArray[Any]]) -> NDArray[np.int64]:
    """For each row of arrays side by side, the first row that is equal to it, bit for bit but for the sign of zero."""
    rows = [
        np.ascontiguousarray(column + 0 if column.dtype.kind == "f" else column)
        .reshape(len(column), -1)
        .view(np.uint8)
        .reshape(len(column), -1)
        for column in columns
    ]
    packed = np.concatenate(rows, axis=1)
    keys = packed.view(np.dtype((np.void, packed.shape[1]))).reshape(-1)
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return first[inverse.reshape(-1)]


def _faces(part: _Part, joined: NDArray[np.int64], degenerate: bool) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Quads and triangles of a block in the order of its cells, over the points of the surface."""
    rows, width = part.block.shape
    r, c = np.nonzero(part.cells)
    below, right = (r + 1) % rows, (c + 1) % width
    points, faces = part.points, part.faces
    corners = np.stack([points[r, c], points[r, right], points[below, right], points[below, c]], axis=-1)
    collapsed = np.zeros(len(corners), np.bool_)
    for k in range(4):
        collapsed |= joined[corners[:, k]] == joined[corners[:, k - 1]]
    quads, fans = corners, np.empty((0, 3), np.int64)
    folded = quads[:0]
    if collapsed.any():
        quads = corners[~collapsed]
        fans, folded = _fans(corners[collapsed], joined[corners[collapsed]])
        fans, folded = (fans[:0], folded) if degenerate else (fans, folded[:0])
    diagonal = faces.get("diagonal")
    if diagonal is not None:
        main = np.full(len(quads), diagonal == "main")
        crossed = unpack_cells(faces.get("crossed"), part.cells.shape)
        if crossed is not None:
            main ^= crossed[part.cells][~collapsed]
        quads, fans = quads[:0], np.concatenate([_halves(quads, main), fans])
    quads = np.concatenate([quads, folded]) if len(folded) else quads
    if faces.get("reversed"):
        quads, fans = quads[:, (0, 3, 2, 1)], fans[:, (0, 2, 1)]
    return quads, fans


def _halves(quads: NDArray[np.int64], main: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Two triangles for each quad, cut from its first to its third corner, or else from its second to its fourth."""
    turned = np.where(main[:, None], quads, np.roll(quads, -1, axis=1))
    return turned[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def _fans(corners: NDArray[np.int64], ends: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Cells with a collapsed edge, as triangles and as quads that name a vertex twice.

    Of the two ends of such an edge, the one in the cell's own row and column stays in the triangle. Cells that collapse
    to a line or a point have no face.
    """
    gone = np.zeros(corners.shape, np.bool_)
    for stays, goes in ((0, 1), (0, 3), (1, 2), (3, 2)):
        gone[:, goes] |= ends[:, stays] == ends[:, goes]
    single = (gone.sum(axis=1) == 1) & (ends[:, 0] != ends[:, 2]) & (ends[:, 1] != ends[:, 3])
    return corners[single][~gone[single]].reshape(-1, 3), corners[single]


def _compressed(
    blocks: tuple[Block, ...],
    vertex: NDArray[np.int64],
    joined: NDArray[np.int64],
    quads: NDArray[np.int64],
    triangles: NDArray[np.int64],
) -> Weld:
    """Number the vertices without gaps: those in faces, and the other valid points that stand for themselves."""
    quads, triangles = vertex[quads], vertex[triangles]
    used: NDArray[np.bool_] = np.equal(joined, np.arange(len(joined)))
    start = 0
    for block in blocks:
        count = block.points.shape[0] * block.points.shape[1]
        if block.mask is not None:
            used[start : start + count] &= block.mask.reshape(-1)
        start += count
    used[quads.reshape(-1)] = True
    used[triangles.reshape(-1)] = True
    source = np.flatnonzero(used)
    if len(source) == len(used):
        return Weld(source, quads, triangles, joined)
    numbers = np.cumsum(used) - 1
    return Weld(source, numbers[quads], numbers[triangles], numbers[joined[source]])


def _coordinates(block: Block, metadata: Mapping[str, Any]) -> NDArray[Any]:
    """x, y and z of the points in row order."""
    points = block.points
    rows, width = block.shape
    if points.ndim == 3:
        places = points.reshape(rows * width, -1)[:, :3]
        if places.shape[1] == 3:
            return places
        return np.concatenate([places, np.zeros((len(places), 1), places.dtype)], axis=1)
    row, column = (index.reshape(-1) for index in np.indices((rows, width)))
    x: NDArray[Any] = column
    y: NDArray[Any] = row
    transform = metadata.get("geotransform")
    if transform is not None:
        try:
            x0, x_column, x_row, y0, y_column, y_row = map(float, transform)
        except (TypeError, ValueError):
            raise InputError(f"expected a geotransform of six numbers in the metadata, got {transform!r}") from None
        x = x0 + (column + 0.5) * x_column + (row + 0.5) * x_row
        y = y0 + (column + 0.5) * y_column + (row + 0.5) * y_row
    return np.stack([x, y, points.reshape(-1)], axis=-1)
