"""Sections 3.3 and 7.5 of docs/format.md: which points are valid."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import StreamError
from .fields import Fields
from .header import Block
from .range_coder import Model

__all__ = ["Masks", "decode_mask", "no_holes", "read_masks"]

GROUP = 16
MARGIN = 2  # points beside a mask that contexts see

Mask = NDArray[np.bool_]


class Masks(NamedTuple):
    """The value of integer points at holes; for each block which points are valid, and which holes are kept."""

    hole: int
    valid: list[Mask]
    kept: list[Mask]


def no_holes(blocks: list[Block]) -> Masks:
    """What no section says: all points are valid."""
    shapes = [(block.rows, block.columns) for block in blocks]
    return Masks(0, [np.ones(shape, bool) for shape in shapes], [np.zeros(shape, bool) for shape in shapes])


def read_masks(payload: bytes, blocks: list[Block], with_kept: bool) -> Masks:
    """The masks, from the payload of the section of masks, or of kept masks."""
    fields = Fields(payload)
    hole = fields.number("q")
    _, every, none = no_holes(blocks)
    valid = [~_read_marked(fields, points, 0) for points in every]
    kept = [_read_marked(fields, ~mask, 1) for mask in valid] if with_kept else none
    fields.finish()
    return Masks(hole, valid, kept)


def _read_marked(fields: Fields, possible: Mask, mark: int) -> Mask:
    """Their number, and which of the possible points they are: those with the mark in a mask that may follow."""
    count, marked = fields.varint(), np.zeros_like(possible)
    if count and (mark == 0 or count < np.count_nonzero(possible)):
        marked = decode_mask(fields.take(fields.varint()), *possible.shape) == mark
    elif count:
        marked = possible
    if np.count_nonzero(marked) != count or (marked & ~possible).any():
        raise StreamError(f"expected a mask with {count} points marked, got {np.count_nonzero(marked)}")
    return marked


def decode_mask(data: bytes, rows: int, columns: int) -> Mask:
    """Section 7.5.

    Parameters
    ----------
    data : bytes
    rows, columns : int

    Returns
    -------
    bool, shape (row, column)
        True where a 1 is coded.
    """
    model = Model(data)
    above2, above = ([0] * (columns + 2 * MARGIN) for _ in range(2))
    last = 0
    found = []
    for _ in range(rows):
        here = [0] * (columns + 2 * MARGIN)
        for first in range(MARGIN, columns + MARGIN, GROUP):
            n = min(GROUP, columns + MARGIN - first)
            around = above2[first - 2 : first + n + 2] + above[first - 2 : first + n + 2] + here[first - 2 : first]
            if min(around) == max(around):
                last = model.bit("group", around[0], last)
                if last:
                    here[first : first + n] = around[:1] * n
                    continue
            for c in range(first, first + n):
                here[c] = model.bit("point", *above2[c - 1 : c + 2], *above[c - 2 : c + 3], *here[c - 2 : c])
        found.append(np.array(here[MARGIN : MARGIN + columns], bool))
        above2, above = above, here
    model.finish()
    return np.stack(found)
