"""Cutting blocks into patches, and assembling the grids of patches into grids of blocks, at any level."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .connectivity import Patch
from .layout import Layout

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
    """Group the patches, with their numbers, by each of ``count`` blocks; both may be tens of thousands."""
    by_block: list[list[tuple[int, Patch]]] = [[] for _ in range(count)]
    for number, patch in enumerate(patches):
        by_block[patch.block].append((number, patch))
    return list(by_block)


def _node_positions(layout: Layout, grid: int, axis: int, level: int) -> NDArray[np.int64]:
    """Return the samples of a grid's axis at which the nodes of a level lie, ascending; int64, shape (node,).

    They are evenly spaced except the last one, which may be the last sample of the axis.
    """
    stride, count = 1, layout.grids[grid].shape[axis]
    last = count - 1
    for finer in range(layout.levels, level, -1):
        step = layout.steps(grid, finer)[axis]
        if step.midpoints:
            if not step.tail and 2 * (step.run - 1) < count - 1:  # a midpoint lies beyond the last node of the run
                last = 2 * (step.run - 1) * stride
            stride, count = 2 * stride, step.coarse
    positions = np.arange(0, count * stride, stride, dtype=np.int64)
    positions[-1] = last
    return positions


def level_positions(patches: Numbered, count: int, layout: Layout, level: int, shape: Shape) -> Positions:
    """Return the rows and columns of a block, of this shape and these patches, at which a level's nodes lie."""
    rows, columns = (np.zeros(length, np.bool_) for length in shape)
    for number, patch in patches:
        down, right = patch_positions(patch, layout, level, number, count, shape)
        rows[down], columns[right] = True, True
    return np.flatnonzero(rows), np.flatnonzero(columns)


def patch_positions(patch: Patch, layout: Layout, level: int, number: int, count: int, shape: Shape) -> Positions:
    """Return the rows and columns of its block at which the nodes of a patch (``number`` of ``count``) lie."""
    grid = len(layout.grids) - count + number
    positions = []
    for axis, window in enumerate((patch.rows, patch.columns)):
        nodes = _node_positions(layout, grid, axis, level)
        place = window[0] + (layout.grids[grid].shape[axis] - 1 - nodes if patch.flipped[axis] else nodes)
        positions.append(place % shape[axis])  # along a closed axis, windows continue from the last sample to the first
    return positions[0], positions[1]


def _whole(patch: Patch, shape: Shape) -> bool:
    """Return whether a patch is a whole block, perhaps flipped."""
    return patch.rows == (0, shape[0]) and patch.columns == (0, shape[1])


def level_shapes(patches: Sequence[Patch], layout: Layout, level: int, shapes: Sequence[Shape]) -> list[Shape]:
    """Return rows and columns of each block's grid at a level; ``shapes`` are those of the blocks."""
    if len(patches) == len(shapes) and all(_whole(patch, shapes[patch.block]) for patch in patches):
        interfaces = len(layout.grids) - len(patches)
        return [layout.shape(interfaces + number, level) for number in range(len(shapes))]
    blocks = zip(numbered_by_block(patches, len(shapes)), shapes, strict=True)
    positions = (level_positions(members, len(patches), layout, level, shape) for members, shape in blocks)
    return [(rows.size, columns.size) for rows, columns in positions]


def assemble(
    patches: Numbered, layout: Layout, level: int, shape: Shape, grids: Sequence[NDArray[Any]]
) -> NDArray[Any]:
    """Assemble a block's grid of a level from the grids of its patches.

    Parameters
    ----------
    patches : Numbered
        The block's patches.
    shape : (int, int)
        Rows and columns of the block.
    grids : arrays (row, column, ...), one for each patch of all blocks, as stored
    """
    if len(patches) == 1 and _whole(patches[0][1], shape):
        number, patch = patches[0]
        return grids[number][:: -1 if patch.flipped[0] else 1, :: -1 if patch.flipped[1] else 1]
    rows, columns = level_positions(patches, len(grids), layout, level, shape)
    block = np.zeros((rows.size, columns.size, *grids[patches[0][0]].shape[2:]), grids[patches[0][0]].dtype)
    for number, patch in patches:
        down, right = patch_positions(patch, layout, level, number, len(grids), shape)
        block[np.ix_(np.searchsorted(rows, down), np.searchsorted(columns, right))] = grids[number]
    return block


def level_masks(
    patches: Sequence[Patch], layout: Layout, level: int, masks: Sequence[NDArray[np.bool_] | None]
) -> list[NDArray[np.bool_] | None]:
    """Return which nodes of a level are valid, bool, shape (row, column) of each block; None: all.

    A node is valid where the point of the full grid, to which ``masks`` belong, is valid.
    """
    if level == layout.levels:
        return list(masks)
    level_masks_of_blocks: list[NDArray[np.bool_] | None] = []
    for patches_of_block, mask in zip(numbered_by_block(patches, len(masks)), masks, strict=True):
        coarse = mask
        if mask is not None:
            shape = mask.shape[0], mask.shape[1]
            coarse = mask[np.ix_(*level_positions(patches_of_block, len(patches), layout, level, shape))]
        level_masks_of_blocks.append(coarse)
    return level_masks_of_blocks
