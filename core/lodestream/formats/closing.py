"""Closed axes in formats for open grids: the first points are repeated at the end."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..surface import Block, Closed

__all__ = ["MIN_CLOSED", "wrapped_ends", "wraps"]

#: A closed axis of fewer points would go back the way it came.
MIN_CLOSED = 3


def wraps(block: Block) -> Closed:
    """Return along which axes the first points of a block are repeated."""
    rows, columns = (closed and length >= MIN_CLOSED for closed, length in zip(block.closed, block.shape, strict=True))
    return rows, columns


def wrapped_ends(values: NDArray[Any], block: Block) -> NDArray[Any]:
    """Return an array over the points of a block, (H, W) or (H, W, C), with the first line of closed axes repeated."""
    ends = [(0, int(wrap)) for wrap in wraps(block)]
    result: NDArray[Any] = np.pad(values, [*ends, (0, 0)][: values.ndim], mode="wrap") if any(wraps(block)) else values
    return result
