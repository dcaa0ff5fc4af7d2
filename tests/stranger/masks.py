"""Sections 3.3 and 7.5 of the page: which points are valid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tests.stranger.coder import Model, RangeDecoder
from tests.stranger.fields import Fields
from tests.stranger.header import Block

GROUP = 16
WIDE, NEAR, GROUPS = 0, 65536, 65536 + 1024  # where the contexts of each sort begin

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Masks:
    """What stands for integer points in holes, and for each block where a point is valid, and where a hole is kept."""

    hole: int
    masks: list[Mask]
    kept: list[Mask]


def read_masks(payload: bytes, blocks: list[Block], with_kept: bool) -> Masks:
    """The section of masks, or of kept masks."""
    fields = Fields(payload)
    hole = fields.number("q")
    masks = []
    for block in blocks:
        holes = fields.varint()
        mask = np.ones((block.rows, block.columns), bool)
        if holes:
            mask = decode_mask(fields.take(fields.varint()), block.rows, block.columns)
        if int((~mask).sum()) != holes:
            raise ValueError("a mask has other holes than it says")
        masks.append(mask)
    kept = [_read_kept(fields, mask) if with_kept else np.zeros_like(mask) for mask in masks]
    fields.finish()
    return Masks(hole, masks, kept)


def _read_kept(fields: Fields, valid: Mask) -> Mask:
    count, holes = fields.varint(), int((~valid).sum())
    kept = np.full_like(valid, False)
    if count == holes:
        kept = ~valid
    elif count:
        kept = decode_mask(fields.take(fields.varint()), *valid.shape)
    if int(kept.sum()) != count or (kept & valid).any():
        raise ValueError("the kept holes are others than there are")
    return kept


def decode_mask(data: bytes, rows: int, columns: int) -> Mask:
    """The mask of a block."""
    coder, model = RangeDecoder(data), Model(GROUPS + 4, 1)
    margin = 4
    points = [[0] * (columns + 2 * margin) for _ in range(rows + 2)]  # two rows above, and four columns at each side
    last = 0
    for r in range(2, rows + 2):
        above2, above, here = points[r - 2], points[r - 1], points[r]
        for first in range(margin, columns + margin, GROUP):
            n = min(GROUP, columns + margin - first)
            around = above2[first - 2 : first + n + 2] + above[first - 2 : first + n + 2] + here[first - 2 : first]
            if all(point == around[0] for point in around):
                last = model.alone(coder, GROUPS + 2 * around[0] + last)
                if last:
                    here[first : first + n] = [around[0]] * n
                    continue
            for c in range(first, first + n):
                wide = _number(above2[c - 2 : c + 3] + above[c - 3 : c + 4] + here[c - 4 : c])
                near = _number(above2[c - 1 : c + 2] + above[c - 2 : c + 3] + here[c - 2 : c])
                here[c] = model.mixed(coder, WIDE + wide, NEAR + near, 0)
    return np.array([row[margin : margin + columns] for row in points[2:]], bool)


def _number(digits: list[int]) -> int:
    return int("".join(map(str, digits)), 2)
