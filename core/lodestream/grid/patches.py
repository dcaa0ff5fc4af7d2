"""Blocks cut into patches, and grids of patches put together to grids of blocks, at any level."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .connectivity import Patch
from .layout import Grid, Layout

__all__ = [
    "Numbered",
    "Shape",
    "assemble",
    "level_masks",
    "level_positions",
    "level_shapes",
    "numbered_by_block",
    "patch_positions",
]

Shape = tuple[int, int]
#: Patches of one block, each with its number among those of all blocks.
Numbered = Sequence[tuple[int, Patch]]
Positions = tuple[NDArray[np.int64], NDArray[np.int64]]


def numbered_by_block(patches: Sequence[Patch], count: int) -> list[Numbered]:
    """The patches of each of so many blocks; there may be tens of thousands of both."""
    found: list[list[tuple[int, Patch]]] = [[] for _ in range(count)]
    for number, patch in enumerate(patches):
        found[patch.block].append((number, patch))
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
    """Which rows and columns of a block of this shape, and of these of ``count`` patches, stand at a level's nodes."""
    positions = [patch_positions(patch, layout, level, number, count, shape) for number, patch in own]
    rows, columns = (np.unique(np.concatenate(lines)) for lines in zip(*positions, strict=True))
    return rows, columns


def patch_positions(patch: Patch, layout: Layout, level: int, number: int, count: int, shape: Shape) -> Positions:
    """Which rows and columns of its block, of this shape, the nodes of a patch (``number`` of ``count``) stand at."""
    grid = layout.grids[len(layout.grids) - count + number]
    found = []
    for axis, window in enumerate((patch.rows, patch.columns)):
        nodes = _node_positions(grid, axis, layout.levels - level)
        place = window[0] + (grid.shape[axis] - 1 - nodes if patch.flipped[axis] else nodes)
        found.append(place % shape[axis])  # along a closed axis windows go on from the last sample to the first
    return found[0], found[1]


def _whole(patch: Patch, shape: Shape) -> bool:
    """Whether a patch is its block as it is, perhaps turned round."""
    return patch.rows == (0, shape[0]) and patch.columns == (0, shape[1])


def level_shapes(patches: Sequence[Patch], layout: Layout, level: int, shapes: Sequence[Shape]) -> list[Shape]:
    """Rows and columns of each block's grid at a level; ``shapes`` are the blocks'."""
    if len(patches) == len(shapes) and all(_whole(patch, shapes[patch.block]) for patch in patches):
        interfaces = len(layout.grids) - len(patches)
        return [layout.shape(interfaces + number, level) for number in range(len(shapes))]
    owned = zip(numbered_by_block(patches, len(shapes)), shapes, strict=True)
    positions = (level_positions(own, len(patches), layout, level, shape) for own, shape in owned)
    return [(rows.size, columns.size) for rows, columns in positions]


def assemble(own: Numbered, layout: Layout, level: int, shape: Shape, grids: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """A block's grid of a level out of the grids of its patches.

    Parameters
    ----------
    own : Numbered
        The block's patches.
    shape : (int, int)
        Of the block.
    grids : arrays (row, column, ...), one for each patch of all blocks, as stored
    """
    if len(own) == 1 and _whole(own[0][1], shape):
        number, patch = own[0]
        return grids[number][:: -1 if patch.flipped[0] else 1, :: -1 if patch.flipped[1] else 1]
    rows, columns = level_positions(own, len(grids), layout, level, shape)
    whole = np.zeros((rows.size, columns.size, *grids[own[0][0]].shape[2:]), grids[own[0][0]].dtype)
    for number, patch in own:
        down, right = patch_positions(patch, layout, level, number, len(grids), shape)
        whole[np.ix_(np.searchsorted(rows, down), np.searchsorted(columns, right))] = grids[number]
    return whole


def level_masks(
    patches: Sequence[Patch], layout: Layout, level: int, masks: Sequence[NDArray[np.bool_] | None]
) -> list[NDArray[np.bool_] | None]:
    """Which nodes of a level stand for valid points, bool, shape (row, column) of each block; None: all.

    They do where the full grid, which ``masks`` are of, has a point at their place.
    """
    if level == layout.levels:
        return list(masks)
    found: list[NDArray[np.bool_] | None] = []
    for own, mask in zip(numbered_by_block(patches, len(masks)), masks, strict=True):
        coarse = mask
        if mask is not None:
            shape = mask.shape[0], mask.shape[1]
            coarse = mask[np.ix_(*level_positions(own, len(patches), layout, level, shape))]
        found.append(coarse)
    return found
