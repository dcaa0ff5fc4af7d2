"""Blocks cut into patches, and grids of patches put together to grids of blocks, at any level."""

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
    """The patches of each of so many blocks; there may be tens of thousands of both."""
    found: list[list[tuple[int, Patch]]] = [[] for _ in range(count)]
    for number, patch in enumerate(patches):
        found[patch.block].append((number, patch))
    return list(found)


def _node_positions(layout: Layout, grid: int, axis: int, level: int) -> NDArray[np.int64]:
    """Which samples of a grid's axis stand at the nodes of a level, increasing.

    They follow each other evenly, but for the last one, which may be the last sample of the axis.
    """
    stride, count = 1, layout.grids[grid].shape[axis]
    last = count - 1
    for finer in range(layout.levels, level, -1):
        step = layout.steps(grid, finer)[axis]
        if step.midpoints:
            if not step.tail and 2 * (step.run - 1) < count - 1:  # beyond the last node of the run is a midpoint
                last = 2 * (step.run - 1) * stride
            stride, count = 2 * stride, step.coarse
    positions = np.arange(0, count * stride, stride, dtype=np.int64)
    positions[-1] = last
    return positions


def level_positions(own: Numbered, count: int, layout: Layout, level: int, shape: Shape) -> Positions:
    """Which rows and columns of a block of this shape, and of these of ``count`` patches, stand at a level's nodes."""
    rows, columns = (np.zeros(length, np.bool_) for length in shape)
    for number, patch in own:
        down, right = patch_positions(patch, layout, level, number, count, shape)
        rows[down], columns[right] = True, True
    return np.flatnonzero(rows), np.flatnonzero(columns)


def patch_positions(patch: Patch, layout: Layout, level: int, number: int, count: int, shape: Shape) -> Positions:
    """Which rows and columns of its block, of this shape, the nodes of a patch (``number`` of ``count``) stand at."""
    grid = len(layout.grids) - count + number
    found = []
    for axis, window in enumerate((patch.rows, patch.columns)):
        nodes = _node_positions(layout, grid, axis, level)
        place = window[0] + (layout.grids[grid].shape[axis] - 1 - nodes if patch.flipped[axis] else nodes)
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
