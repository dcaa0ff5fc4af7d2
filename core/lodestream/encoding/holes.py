"""Choose the values of a surface that are worth coding, and values in place of the others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scratch import IN_MEMORY, Room, rows_at_once
from ..surface import Block

__all__ = ["Arrays", "filled", "given_arrays", "given_channel", "known_values", "valid_points"]

#: Of one block: its points, then each attribute, shape (row, column, channel).
Arrays = list[NDArray[Any]]


def given_arrays(block: Block) -> Arrays:
    """Return points and attributes of a block as the user gave them, shape (row, column, channel); views."""
    arrays = (block.points, *block.attributes.values())
    return [array if array.ndim == 3 else array[..., np.newaxis] for array in arrays]


def given_channel(block: Block, channel: int) -> NDArray[Any]:
    """Return one channel of a block as the user gave it, shape (row, column), a view.

    Raises
    ------
    IndexError
        If the block has not so many channels.
    """
    for array in given_arrays(block):
        if channel < array.shape[2]:
            return array[..., channel]
        channel -= array.shape[2]
    raise IndexError(channel)


def filled(block: Block, room: Room = IN_MEMORY) -> Arrays:
    """Return points and attributes of a block with filled holes, finite everywhere.

    C-contiguous, shape (row, column, channel).

    What has no holes is not copied; large copies go where there is room.
    """
    arrays = []
    for number, array in enumerate(given_arrays(block)):
        known = [known_values(array[..., k], block, not number and k < 3) for k in range(array.shape[2])]
        if not all(mask is None or mask.all() for mask in known):
            from .fill import fill_channel  # only where there is one

            copy = room.empty(array.shape, array.dtype)
            for rows in rows_at_once(array.shape):
                copy[rows] = array[rows]
            array = copy
            for channel, mask in enumerate(known):
                if mask is not None and not mask.all():
                    fill_channel(array[..., channel], mask, block.closed, room)
        arrays.append(np.ascontiguousarray(array))
    return arrays


def known_values(values: NDArray[Any], block: Block, coordinate: bool) -> NDArray[np.bool_] | None:
    """Return a mask of the values of a channel that are worth coding, bool, shape (row, column); None: all are.

    A valid point may lack an attribute, and a hole that is kept may have some of its coordinates; the residual gives
    both back. Numbers that lie further out than all valid ones are left to it as well.

    Parameters
    ----------
    values : array, shape (row, column)
        The channel as it was given.
    block : Block
        Whose channel it is.
    coordinate : bool
        Whether the channel is a coordinate of the points.
    """
    if values.dtype.kind != "f" or (coordinate and block.kept is None):
        return block.mask
    valid: NDArray[np.bool_] = np.isfinite(values)
    if block.mask is not None:
        valid &= block.mask
    if block.kept is None or not valid.any():
        return valid
    low, high = values[valid].min(), values[valid].max()
    with np.errstate(invalid="ignore"):  # of signalling NaN
        valid |= block.kept & (values >= low) & (values <= high)
    return valid


def valid_points(blocks: Sequence[Block], points: Sequence[NDArray[Any]], room: Room = IN_MEMORY) -> NDArray[Any]:
    """Return the valid points of all blocks, shape (row, column) or (row, column, channel).

    Parameters
    ----------
    blocks : sequence of Block
    points : for each block, shape (row, column, channel)
        As `filled` returns them. Those of one block without holes are not copied.
    room : Room
        Where large arrays go.
    """
    flat = blocks[0].points.ndim == 2
    if len(blocks) == 1 and blocks[0].mask is None:
        valid = points[0]
    else:
        count = sum(array.shape[0] * array.shape[1] - b.holes for b, array in zip(blocks, points, strict=True))
        valid, done = room.empty((count, 1, points[0].shape[2]), points[0].dtype), 0
        for block, array in zip(blocks, points, strict=True):
            for rows in rows_at_once(array.shape):
                strip = array[rows]
                chosen = strip.reshape(-1, strip.shape[2]) if block.mask is None else strip[block.mask[rows]]
                valid[done : done + len(chosen), 0] = chosen
                done += len(chosen)
    return valid[..., 0] if flat else valid
