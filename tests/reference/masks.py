"""Masks of holes: sections 3.3 and 7.5 of docs/format.md."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lodestream.errors import CorruptStreamError

from .fields import Fields
from .range_coder import RangeCoder, new_contexts

Mask = NDArray[np.bool_]
POINTS = 4
"""The first of the 1024 contexts of points; those of groups stand before them."""


@dataclass(frozen=True)
class Masks:
    """What the section of masks says.

    `hole` (int): the value of integer points at holes; `valid`, `kept` (list of bool (H, W)): for each block the points
    that are valid, and the holes that are kept.
    """

    hole: int
    valid: list[Mask]
    kept: list[Mask]

    @property
    def keep_any(self) -> bool:
        """Whether there is a kept hole."""
        return any(mask.any() for mask in self.kept)


def no_holes(sizes: list[tuple[int, int]]) -> Masks:
    """Make the masks of blocks of such sizes without holes."""
    return Masks(0, [np.ones(size, np.bool_) for size in sizes], [np.zeros(size, np.bool_) for size in sizes])


def decode_mask(data: bytes, rows: int, columns: int, offset: int = 0) -> Mask:
    """Decode the mask of a block.

    `data` (bytes): the range-coded string; `rows`, `columns` (int): of the block; `offset` (int): where the string
    begins in the container. Returns bool (H, W): the points that are 1. Raises CorruptStreamError if the string has
    more bytes than decoding reads.
    """
    coder = RangeCoder(data, new_contexts(POINTS + 1024))
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

    `payload` (bytes): what the frame encloses; `offset` (int): where it begins in the container; `kept` (bool): the
    section is one of kept masks; `sizes` (list of (int, int)): rows and columns of each block. Raises
    CorruptStreamError if the payload is damaged, or its counts are not those of its masks.
    """
    fields = Fields(payload, offset)
    masks = no_holes(sizes)
    hole: int = fields.number("q")
    holes = []
    for number, (rows, columns) in enumerate(sizes):
        holes.append(fields.varint())
        fields.require(holes[-1] < rows * columns, "a block has no valid point")
        if holes[-1]:
            masks.valid[number] = _counted(fields, rows, columns, rows * columns - holes[-1])
    for number, (rows, columns) in enumerate(sizes if kept else ()):
        count = fields.varint()
        if count == holes[number]:
            masks.kept[number] = ~masks.valid[number]
        elif count:
            masks.kept[number] = _counted(fields, rows, columns, count)
        if count > holes[number] or (masks.kept[number] & masks.valid[number]).any():
            raise fields.damaged("more is kept than holes")
    if kept and not masks.keep_any:
        raise fields.damaged("no hole is kept")
    fields.end()
    return Masks(hole, masks.valid, masks.kept)


def _counted(fields: Fields, rows: int, columns: int, ones: int) -> Mask:
    """Decode a mask with its length before it, and hold its number of 1s to what was told."""
    data = fields.take(fields.varint())
    if not 0 <= ones <= rows * columns:
        raise fields.damaged("more holes than points")
    mask = decode_mask(data, rows, columns, fields.offset + fields.position - len(data))
    if int(mask.sum()) != ones:
        raise fields.damaged("a mask has another number of holes than is told")
    return mask
