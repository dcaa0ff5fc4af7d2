"""Blocks cut into parts, and grids of parts put together to grids of blocks, at any level."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .connectivity import Part
from .layout import Grid, Layout

__all__ = [
    "Numbered",
    "Shape",
    "assemble",
    "level_masks",
    "level_positions",
    "level_shapes",
    "numbered_by_block",
    "part_positions",
]

Shape = tuple[int, int]
#: Parts of one block, each with its number among those of all blocks.
Numbered = Sequence[tuple[int, Part]]
Positions = tuple[NDArray[np.int64], NDArray[np.int64]]


def numbered_by_block(parts: Sequence[Part], count: int) -> list[Numbered]:
    """The parts of each of so many blocks; there may be tens of thousands of both."""
    found: list[list[tuple[int, Part]]] = [[] for _ in range(count)]
    for number, part in enumerate(parts):
        found[part.block].append((number, part))
    return list(found)


def _node_positions(grid: Grid, axis: int, above: int) -> NDArray[np.int64]:
    """Which samples of a grid's axis stand at the nodes so many levels below it."""
    positions = np.arange(grid.shape[axis], dtype=np.int64)
    for below in range(above):
        step = grid.steps_at(below)[axis]
        if step.midpoints:
            run = positions[: 2 * step.run : 2]
            positions = np.concatenate([run, positions[-1:]]) if step.tail else run
    return positions


def level_positions(own: Numbered, count: int, layout: Layout, level: int, shape: Shape) -> Positions:
    """Which rows and columns of a block of this shape, and of these of ``count`` parts, stand at a level's nodes."""
    rows: set[int] = set()
    columns: set[int] = set()
    for number, part in own:
        down, right = part_positions(part, layout, level, number, count, shape)
        rows.update(down.tolist())
        columns.update(right.tolist())
    return np.array(sorted(rows), np.int64), np.array(sorted(columns), np.int64)


def part_positions(part: Part, layout: Layout, level: int, number: int, count: int, shape: Shape) -> Positions:
    """Which rows and columns of its block, of this shape, the nodes of a part (``number`` of ``count``) stand at."""
    grid = layout.grids[len(layout.grids) - count + number]
    found = []
    for axis, window in enumerate((part.rows, part.columns)):
        nodes = _node_positions(grid, axis, layout.levels - level)
        place = window[0] + (grid.shape[axis] - 1 - nodes if part.flipped[axis] else nodes)
        found.append(place % shape[axis])  # along a closed axis windows go on from the last sample to the first
    return found[0], found[1]


def _whole(part: Part, shape: Shape) -> bool:
    """Whether a part is its block as it is, perhaps turned round."""
    return part.rows == (0, shape[0]) and part.columns == (0, shape[1])


def level_shapes(parts: Sequence[Part], layout: Layout, level: int, shapes: Sequence[Shape]) -> list[Shape]:
    """Rows and columns of each block's grid at a level; ``shapes`` are the blocks'."""
    if len(parts) == len(shapes) and all(_whole(part, shapes[part.block]) for part in parts):
        curves = len(layout.grids) - len(parts)
        return [layout.shape(curves + number, level) for number in range(len(shapes))]
    owned = zip(numbered_by_block(parts, len(shapes)), shapes, strict=True)
    positions = (level_positions(own, len(parts), layout, level, shape) for own, shape in owned)
    return [(rows.size, columns.size) for rows, columns in positions]


def assemble(own: Numbered, layout: Layout, level: int, shape: Shape, grids: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """A block's grid of a level out of the grids of its parts.

    Parameters
    ----------
    own : Numbered
        The block's parts.
    shape : (int, int)
        Of the block.
    grids : arrays (row, column, ...), one for each part of all blocks, as stored
    """
    if len(own) == 1 and _whole(own[0][1], shape):
        number, part = own[0]
        return grids[number][:: -1 if part.flipped[0] else 1, :: -1 if part.flipped[1] else 1]
    rows, columns = level_positions(own, len(grids), layout, level, shape)
    whole = np.zeros((rows.size, columns.size, *grids[own[0][0]].shape[2:]), grids[own[0][0]].dtype)
    for number, part in own:
        down, right = part_positions(part, layout, level, number, len(grids), shape)
        whole[np.ix_(np.searchsorted(rows, down), np.searchsorted(columns, right))] = grids[number]
    return whole


def level_masks(
    parts: Sequence[Part], layout: Layout, level: int, masks: Sequence[NDArray[np.bool_] | None]
) -> list[NDArray[np.bool_] | None]:
    """Which nodes of a level stand for valid points: those at whose place the full grid has one."""
    found: list[NDArray[np.bool_] | None] = []
    for own, mask in zip(numbered_by_block(parts, len(masks)), masks, strict=True):
        coarse = mask
        if mask is not None and level < layout.levels:
            shape = mask.shape[0], mask.shape[1]
            coarse = mask[np.ix_(*level_positions(own, len(parts), layout, level, shape))]
        found.append(coarse)
    return found
