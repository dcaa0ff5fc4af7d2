"""Chunks of residual by offsets from multiples of a step: section 9.3 of docs/format.md."""

from struct import Struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .fields import Fields
from .range_coder import RangeCoder, new_contexts

FIRST, LISTED, WHICH, OFF, NEW = 0, 16, 17, 81, 97
CONTEXTS = NEW + 46
HIGHEST = 0x7F7FFFFF
"""The place of the largest finite float32."""

_float, _integer = Struct("<f"), Struct("<I")


def value_at(place: int) -> float:
    """Give the float32 at a place."""
    pattern = min(place, HIGHEST) if place >= 0 else 0x80000000 | min(-1 - place, HIGHEST)
    value: float = _float.unpack(_integer.pack(pattern))[0]
    return value


def place_of(value: float) -> int:
    """Give the place of the nearest float32; of what is not finite the highest."""
    try:
        pattern: int = _integer.unpack(_float.pack(value))[0]
    except OverflowError:
        return HIGHEST
    m = pattern & 0x7FFFFFFF
    if m > HIGHEST:
        return HIGHEST
    return -1 - m if pattern >> 31 else m


def read_offsets(values: NDArray[Any], fields: Fields, bits: int) -> NDArray[Any]:
    """Restore the float32 values (n,) of a chunk; `bits` is B, and `fields` stand behind the first byte."""
    step = fields.number("d")
    if not 0 < step < float("inf"):
        raise fields.damaged("a step of offsets is not above 0")
    coder = RangeCoder(fields.take(fields.left), new_contexts(CONTEXTS))
    wide = values.astype(np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        bases = (np.rint(wide / step) * step).tolist()
    pattern = values.view(np.uint32).astype(np.int64)
    start = np.where(pattern >> 31 == 1, -1 - (pattern & 0x7FFFFFFF), pattern) - ((1 << bits) >> 1)
    intervals: list[tuple[float, float]] = []
    history = 0
    restored = []
    bit, tree = coder.bit, coder.tree
    for place, base in zip(start.tolist(), bases, strict=True):
        rank = -1
        if intervals:
            if bit(FIRST + history):
                history = min(history + 1, 15)
                rank = 0
            else:
                history = 0
                if bit(LISTED):
                    rank = min(tree(WHICH, 6), len(intervals) - 1)
        if rank >= 0:
            low, high = intervals.pop(rank)
            place = place_of(base + 0.5 * (low + high)) + tree(OFF + 8 * (rank > 0), 3) - 4
        else:
            w = tree(NEW, min(bits, 4))
            for j in range(4, bits):
                w = 2 * w + bit(NEW + 12 + j)
            place += w
        value = value_at(place)
        bottom = 0.5 * (value + value_at(place - 1)) - base
        top = 0.5 * (value + value_at(place + 1)) - base
        if rank >= 0:
            bottom, top = max(bottom, low), min(top, high)
            if bottom > top:
                bottom = top = value - base
        elif len(intervals) == 64:
            intervals.pop()
        intervals.insert(0, (bottom, top))
        restored.append(place)
    if coder.surplus:
        raise fields.damaged("a chunk of offsets has more bytes than decoding reads")
    found = np.clip(np.array(restored, np.int64), -(1 << 31), (1 << 31) - 1)
    return np.where(found < 0, 0x80000000 | (-1 - found), found).astype(np.uint32).view(np.float32)
