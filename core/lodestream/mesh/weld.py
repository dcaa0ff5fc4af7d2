"""The mesh of a surface: its blocks joined where they touch, poles as fans, holes left open."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..surface import Block, Surface
from .cells import unpack_cells
from .joining import NumberedBlock, join_points, numbered_blocks, poles_of, wraps

__all__ = ["Weld", "weld"]


@dataclass(frozen=True, slots=True)
class Weld:
    """The vertices of a surface's mesh as points of the surface, and the faces over them.

    Attributes
    ----------
    source : int64 array of shape (V,)
        For each vertex, the index of its point among the points of all blocks, block by block in row-major order.
        Ascending.
    quads : int64 array of shape (Q, 4)
        0-based vertices of each quad, going round it.
    triangles : int64 array of shape (T, 3)
        0-based vertices of each triangle, going round it.
    edges : int64 array of shape (E, 2)
        0-based vertices of each edge of the blocks that are curves.
    joined : int64 array of shape (V,)
        For each vertex, the first vertex at the same place that differs only in its attributes; itself where there is
        no other. A format whose faces name places and attributes separately, like OBJ, writes the places of
        these alone.
    """

    source: NDArray[np.int64]
    quads: NDArray[np.int64]
    triangles: NDArray[np.int64]
    edges: NDArray[np.int64]
    joined: NDArray[np.int64]


def weld(surface: Surface) -> Weld:
    """Find the vertices and faces of a surface's mesh.

    Blocks are welded where points on their sides are one (by `Surface.joints`, or else by their coordinates and
    attributes), closed axes are joined by faces, a collapsed side is one vertex with a fan of triangles, and cells at
    holes are left out; see `lodestream.mesh` for what the metadata say about it. Every valid point is a vertex, with a
    face or without.

    Raises
    ------
    InputError
        When the metadata's ``faces`` or ``poles`` are not of the form that they should have.
    """
    numbered = numbered_blocks(surface)
    joined, vertex, poles = join_points(surface, numbered, poles_of(surface))
    quads, triangles = [], []
    for number, block in enumerate(numbered):
        degenerate = any(pole.block == number and pole.kind == "degenerate" for pole in poles)
        block_quads, block_triangles = _faces(block, joined, degenerate)
        quads.append(block_quads)
        triangles.append(block_triangles)
    edges = np.concatenate([_edges(block) for block in numbered])
    edges = edges[joined[edges[:, 0]] != joined[edges[:, 1]]]
    return _compressed(surface.blocks, vertex, joined, np.concatenate(quads), np.concatenate(triangles), edges)


def _edges(numbered: NumberedBlock) -> NDArray[np.int64]:
    """Return the edges of a block that is a curve, int64, shape (edge, 2); no edges for other blocks."""
    block, count = numbered.block, numbered.points.size
    if 1 not in block.shape:
        return np.empty((0, 2), np.int64)
    closed = wraps(block, 0 if block.shape[1] == 1 else 1)
    first = np.arange(count if closed else count - 1)
    ends = np.stack((first, (first + 1) % count), axis=-1)
    if block.mask is not None:
        ends = ends[block.mask.reshape(-1)[ends].all(axis=1)]
    return numbered.points.reshape(-1)[ends]


def _faces(
    numbered: NumberedBlock, joined: NDArray[np.int64], degenerate: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return quads and triangles of a block in the order of its cells, over the points of the surface."""
    rows, width = numbered.block.shape
    r, c = np.nonzero(numbered.cells)
    below, right = (r + 1) % rows, (c + 1) % width
    points, faces = numbered.points, numbered.faces
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
        crossed = unpack_cells(faces.get("crossed"), numbered.cells.shape)
        if crossed is not None:
            main ^= crossed[numbered.cells][~collapsed]
        quads, fans = quads[:0], np.concatenate([_halves(quads, main), fans])
    quads = np.concatenate([quads, folded]) if len(folded) else quads
    if faces.get("reversed"):
        quads, fans = quads[:, (0, 3, 2, 1)], fans[:, (0, 2, 1)]
    return quads, fans


def _halves(quads: NDArray[np.int64], main: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Cut each quad into two triangles, from its first to its third corner, or from its second to its fourth."""
    turned = np.where(main[:, None], quads, np.roll(quads, -1, axis=1))
    return turned[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def _fans(corners: NDArray[np.int64], ends: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Convert cells with a collapsed edge into triangles, and into quads that name a vertex twice.

    Of the two ends of such an edge, the one in the cell's own row and column stays in the triangle. Cells that collapse
    to a line or a point have no face.
    """
    dropped = np.zeros(corners.shape, np.bool_)
    for stays, goes in ((0, 1), (0, 3), (1, 2), (3, 2)):
        dropped[:, goes] |= ends[:, stays] == ends[:, goes]
    single = (dropped.sum(axis=1) == 1) & (ends[:, 0] != ends[:, 2]) & (ends[:, 1] != ends[:, 3])
    return corners[single][~dropped[single]].reshape(-1, 3), corners[single]


def _compressed(
    blocks: tuple[Block, ...],
    vertex: NDArray[np.int64],
    joined: NDArray[np.int64],
    quads: NDArray[np.int64],
    triangles: NDArray[np.int64],
    edges: NDArray[np.int64],
) -> Weld:
    """Number the vertices without gaps: those in faces, and the other valid points that are not joined to others."""
    quads, triangles, edges = vertex[quads], vertex[triangles], vertex[edges]
    used: NDArray[np.bool_] = np.equal(joined, np.arange(len(joined)))
    start = 0
    for block in blocks:
        count = block.points.shape[0] * block.points.shape[1]
        if block.mask is not None:
            used[start : start + count] &= block.mask.reshape(-1)
        start += count
    used[quads.reshape(-1)] = True
    used[triangles.reshape(-1)] = True
    used[edges.reshape(-1)] = True
    source = np.flatnonzero(used)
    if len(source) == len(used):
        return Weld(source, quads, triangles, edges, joined)
    numbers = np.cumsum(used) - 1
    return Weld(source, numbers[quads], numbers[triangles], numbers[edges], numbers[joined[source]])
