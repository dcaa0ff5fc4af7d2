"""Properties of recognised grids besides their nodes: cells, poles, joints, and a description in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..surface import Block, Closed
from .cells import pack_cells
from .grid import Grid
from .joining import SIDES, on_border
from .patchwork import Quads

__all__ = ["RecognisedBlock", "describe_cells", "join_blocks", "poles_of", "shape_words", "with_tips"]


@dataclass(frozen=True, slots=True)
class RecognisedBlock:
    """One grid of a mesh.

    Attributes
    ----------
    vertices : int64 array of shape (H, W)
        Vertex of the mesh at each node; -1 at holes.
    closed : (bool, bool)
        Which axes wrap.
    rows : mapping of str to int64 arrays of shape (H, W)
        For each attribute of corners the row of its values at each node; -1 at holes.
    faces, poles
        The metadata of this block, see `lodestream.mesh`.
    """

    vertices: NDArray[np.int64]
    closed: Closed
    rows: Mapping[str, NDArray[np.int64]]
    faces: Mapping[str, Any]
    poles: tuple[Mapping[str, str], ...]


def describe_cells(grid: Grid, quads: Quads) -> dict[str, Any]:
    """Describe how faces go round, which cells with valid corners have none, and how they are cut in two."""
    faces: dict[str, Any] = {"reversed": True} if grid.reversed else {}
    there = grid.corners >= 0
    full = there.copy()
    for axis in (0, 1):
        following = np.roll(full, -1, axis)
        full &= following
        if not grid.closed[axis]:
            full = full[:-1] if axis == 0 else full[:, :-1]
    missing = full & (grid.faces < 0)
    if missing.any():
        faces["left_out"] = pack_cells(missing)
    cut = (grid.faces >= 0) & quads.cut[grid.faces]
    if not cut.any():
        return faces
    # A diagonal joins the first and third corners of its quad.
    node_vertices = quads.corners.reshape(-1)[grid.corners[: cut.shape[0], : cut.shape[1]]]
    rows = quads.corners[grid.faces]
    main = cut & ((rows[..., 0] == node_vertices) | (rows[..., 2] == node_vertices))
    anti = cut & ~main
    mostly_main = bool(main.sum() >= anti.sum())
    faces["diagonal"] = "main" if mostly_main else "anti"
    crossed = anti if mostly_main else main
    if crossed.any():
        faces["crossed"] = pack_cells(crossed)
    return faces


def with_tips(corners: NDArray[np.int32], faces: NDArray[np.int32], side: str) -> NDArray[np.int32]:
    """Return the corners of a grid in which each node of a fan's side is that of the triangle in its row or column.

    `corners` are half-edges, int32 of shape (H, W), `faces` int32 of shape (H or H - 1,
    W or W - 1); -1: none.
    """
    corners = corners.copy()
    line, beside = corners[SIDES[side]], faces[SIDES[side]]
    beside = np.concatenate([beside, beside[-1:]])[: len(line)]
    line[beside >= 0] = 4 * beside[beside >= 0]
    return corners


def poles_of(
    vertices: NDArray[np.int64], closed: Closed, points: NDArray[Any], kinds: Mapping[str, str]
) -> tuple[Mapping[str, str], ...]:
    """Return the sides of a grid that are collapsed to a point; ``kinds`` are those that are one vertex.

    `vertices` has shape (H, W), -1 for none; `points` shape (V, C).
    """
    poles = []
    for side, place in SIDES.items():
        line = vertices[place]
        if side in kinds:
            poles.append({"side": side, "kind": kinds[side]})
        elif not closed["column" in side] and len(line) > 2 and (line >= 0).all():
            places = points[line]
            if (places == places[0]).all():
                poles.append({"side": side, "kind": "repeated"})
    return tuple(poles)


def join_blocks(
    blocks: Sequence[RecognisedBlock], grids: Sequence[Grid], points: NDArray[Any]
) -> tuple[list[RecognisedBlock], int]:
    """Record for each block whether its border is joined to others, or to itself.

    `points` has shape (V, C). The second result is the number of vertices that will be joined because they lie at the
    same place, although the mesh has them as different vertices.
    """
    borders = [_border(block, grid) for block, grid in zip(blocks, grids, strict=True)]
    shared = np.bincount(np.concatenate(borders), minlength=1) > 1
    result, among = [], []
    for block, border in zip(blocks, borders, strict=True):
        joined = bool(shared[border].any())
        if joined:
            among.append(border)
        if joined != (len(blocks) > 1):
            block = replace(block, faces={**block.faces, "joined": joined})
        result.append(block)
    if not among:
        return result, 0
    together = np.unique(np.concatenate(among))
    with np.errstate(invalid="ignore"):  # a signalling NaN becomes a quiet one
        places = points[together] + 0  # 0 and -0 are one place
    return result, len(together) - len(np.unique(places, axis=0))


def _border(block: RecognisedBlock, grid: Grid) -> NDArray[np.int64]:
    """Return the vertices on the border of a block, int64, shape (vertex,), each node and each pole once."""
    border = on_border(grid.faces >= 0, block.vertices.shape)
    poles = []
    for pole in block.poles:
        if pole["kind"] != "repeated":
            border[SIDES[pole["side"]]] = False
            poles.append(block.vertices[SIDES[pole["side"]]][0])
    border &= block.vertices >= 0
    return np.concatenate([block.vertices[border], np.unique(poles).astype(np.int64)])


def shape_words(blocks: Sequence[Block], poles: int) -> str:
    """Describe blocks, such as "torus, 96 x 24" or "6 blocks, 33 x 33 each"; ``poles`` counts collapsed sides."""
    if len(blocks) == 1:
        closed = sum(blocks[0].closed)
        kind = ("grid", ("cylinder", "cap", "sphere")[poles if closed == 1 else 0], "torus")[closed]
        return f"{kind}, {_by(blocks[0].shape)}"
    sizes = sorted({block.shape for block in blocks}, key=lambda shape: (shape[0] * shape[1], shape))
    if len(sizes) == 1:
        return f"{len(blocks)} blocks, {_by(sizes[0])} each"
    return f"{len(blocks)} blocks, {_by(sizes[0])} to {_by(sizes[-1])}"


def _by(shape: tuple[int, int]) -> str:
    """Format rows and columns, such as "96 x 24"."""
    return f"{shape[0]} x {shape[1]}"
