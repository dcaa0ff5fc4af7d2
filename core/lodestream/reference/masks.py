"""Masks of holes: sections 3.3 and 7.5 of docs/format.md."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import CorruptStreamError
from .fields import Fields
from .range_coder import RangeCoder

Mask = NDArray[np.bool_]
POINTS = 4
"""The first of the 1024 contexts of points; those of groups stand before them."""


@dataclass(frozen=True)
class Masks:
    """What the section of masks says.

    Attributes
    ----------
    hole : int
        The value of integer points at holes.
    valid, kept : list of bool (H, W) or None
        For each block the points that are valid, None if all are; and the holes that are kept, None if none is.
    """

    hole: int
    valid: list[Mask | None]
    kept: list[Mask | None]


def decode_mask(data: bytes, rows: int, columns: int, offset: int = 0) -> Mask:
    """Decode the mask of a block.

    Parameters
    ----------
    data : bytes
        The range-coded string.
    rows, columns : int
        Of the block.
    offset : int
        Where the string begins in the container.

    Returns
    -------
    bool (H, W)
        The points that are 1.

    Raises
    ------
    CorruptStreamError
        The string has more bytes than decoding reads.
    """
    coder = RangeCoder(data, POINTS + 1024)
    bit = coder.bit
    last = 0
    # Three rows with two zeros before them and, so that every window of a group is whole, eighteen behind.
    above, near, row = (bytearray(columns + 20) for _ in range(3))
    mask = np.empty((rows, columns), np.bool_)
    for i in range(rows):
        row = bytearray(columns + 20)
        for left in range(2, columns + 2, 16):
            right = min(left + 16, columns + 2)
            v = row[left - 1]
            same = bytes([v]) * (right - left + 4)
            if row[left - 2] == v and near[left - 2 : right + 2] == same and above[left - 2 : right + 2] == same:
                last = bit(2 * v + last)
                if last:
                    row[left:right] = same[4:]
                    continue
            for j in range(left, right):
                far = above[j - 1] << 2 | above[j] << 1 | above[j + 1]
                mid = near[j - 2] << 4 | near[j - 1] << 3 | near[j] << 2 | near[j + 1] << 1 | near[j + 2]
                row[j] = bit(POINTS + (far << 7 | mid << 2 | row[j - 2] << 1 | row[j - 1]))
        mask[i] = np.frombuffer(row, np.uint8)[2 : columns + 2]
        above, near = near, row
    if coder.surplus:
        raise CorruptStreamError("a mask has more bytes than decoding reads", offset)
    return mask


def read_masks(payload: bytes, offset: int, kept: bool, sizes: list[tuple[int, int]]) -> Masks:
    """Read the payload of the section of masks.

    Parameters
    ----------
    payload : bytes
        What the frame encloses.
    offset : int
        Where it begins in the container.
    kept : bool
        The section is one of kept masks.
    sizes : list of (int, int)
        Rows and columns of each block.

    Raises
    ------
    CorruptStreamError
        The payload is damaged, or its counts are not those of its masks.
    """
    fields = Fields(payload, offset)
    hole: int = fields.number("q")
    valid: list[Mask | None] = []
    holes = []
    for rows, columns in sizes:
        holes.append(fields.varint())
        valid.append(_counted(fields, rows, columns, rows * columns - holes[-1]) if holes[-1] else None)
    saved: list[Mask | None] = []
    for (rows, columns), count, mask in zip(sizes, holes, valid, strict=True):
        keeps = fields.varint() if kept else 0
        if keeps > count:
            raise fields.damaged("more holes are kept than there are")
        if keeps == 0 or mask is None:
            saved.append(None)
        elif keeps == count:
            saved.append(~mask)
        else:
            saved.append(_counted(fields, rows, columns, keeps))
            if (saved[-1] & mask).any():
                raise fields.damaged("a valid point is a kept hole")
    if kept and all(mask is None for mask in saved):
        raise fields.damaged("no hole is kept")
    fields.end()
    return Masks(hole, valid, saved)


def _counted(fields: Fields, rows: int, columns: int, ones: int) -> Mask:
    """Decode a mask with its length before it, and hold its number of 1s to what was told."""
    data = fields.take(fields.varint())
    if not 0 <= ones <= rows * columns:
        raise fields.damaged("more holes than points")
    mask = decode_mask(data, rows, columns, fields.offset + fields.position - len(data))
    if int(mask.sum()) != ones:
        raise fields.damaged("a mask has another number of holes than is told")
    return mask
