"""Which sides the blocks of a surface share: found on lattice coordinates, so that a side is one to the bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..grid.connectivity import Arrangement, Interface, LatticeBlock, Patch, Side, arrange, stored, whole_patch
from ..quantization.lattice import Lattice
from ..scratch import IN_MEMORY, Room, rows_at_once
from ..surface import Block

__all__ = ["arranged", "lines", "may_share", "unshared"]


def lines(array: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return first row, last row, first column, last column of an array, shape (row, column, ...); views."""
    return array[0], array[-1], array[:, 0], array[:, -1]


def may_share(block: Block, points: NDArray[Any]) -> bool:
    """Return whether one block might share a side with itself, or have a pole: whether any points of its outline agree.

    Parameters
    ----------
    block : Block
    points : finite, shape (row, column, channel)
        Of the block, holes filled.
    """
    rows, columns = block.shape
    if min(rows, columns) < 2:
        return False
    outline = np.concatenate([points[0], points[-1], points[1:-1, 0], points[1:-1, -1]])[:, :3]
    outline = outline + outline.dtype.type(0)  # -0.0 and 0.0 are one place
    return len(np.unique(outline, axis=0)) < len(outline) or block.mask is not None


def unshared(blocks: Sequence[Block]) -> Arrangement:
    """Return the arrangement of blocks that share no sides."""
    return Arrangement(tuple(whole_patch(k, block.shape, block.closed) for k, block in enumerate(blocks)), ())


def arranged(
    blocks: Sequence[Block], points: Sequence[NDArray[Any]], lattices: Sequence[Lattice], room: Room = IN_MEMORY
) -> Arrangement | None:
    """Return the patches and interfaces of blocks; None of one block that is one patch without interfaces.

    Parameters
    ----------
    blocks : sequence of Block
    points : for each block, finite, shape (row, column, channel)
        Holes filled.
    lattices : of each coordinate
    room : Room
        Where large arrays go.
    """
    sources = []
    for block, array in zip(blocks, points, strict=True):
        coordinates = room.empty((*block.shape, len(lattices)), np.int32)
        for rows in rows_at_once(coordinates.shape):
            for k, lattice in enumerate(lattices):
                coordinates[rows, :, k] = lattice.coordinates(array[rows, :, k])
            if block.mask is not None:
                coordinates[rows][~block.mask[rows]] = 0  # whatever stands under holes agrees
        sources.append(LatticeBlock(coordinates, block.closed, block.mask))
    arrangement = arrange(sources, len(lattices))
    patches, interfaces = [], list(arrangement.interfaces)
    for patch in arrangement.patches:
        sides = list(patch.sides)
        for place in _poles(patch, sources[patch.block]):
            sides[place] = Side(len(interfaces), False)
            interfaces.append(Interface(1, False, False))
        first, last, left, right = sides
        clamped = [a or s is not None for a, s in zip(patch.clamped, sides, strict=True)]
        patches.append(
            replace(patch, sides=(first, last, left, right), clamped=(clamped[0], clamped[1], clamped[2], clamped[3]))
        )
    if len(patches) == 1 and not interfaces and patches[0].flipped == patches[0].stops == (False, False):
        return None
    return Arrangement(tuple(patches), tuple(interfaces))


def _poles(patch: Patch, source: LatticeBlock) -> list[int]:
    """Return which of a patch's four sides are one point, and shared with no other patch."""
    window = stored(patch, source.coordinates)
    valid = lines(np.ones(patch.shape, np.bool_) if source.mask is None else stored(patch, source.mask))
    poles = []
    for place, line in enumerate(lines(window)):
        wraps = patch.closed[place // 2]  # such an axis has no ends
        pole = not wraps and len(line) > 1 and valid[place].all() and (line == line[0]).all()
        if patch.sides[place] is None and pole:
            poles.append(place)
    return poles
