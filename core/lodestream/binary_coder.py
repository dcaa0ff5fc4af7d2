"""An adaptive binary range coder whose probabilities come from contexts, a single one or two mixed.

A *context* is an integer: its probability of a 1 over 2**20 and, in the lowest 8 bits, its adaptation count (1 to 127).
After each bit the probability moves towards 0 or 2**20 - 1 by the part `_RATES` of the distance, and the count grows by
1. Two contexts are mixed in the logistic domain: the probability is `_SQUASH` of the sum of both `_STRETCH`, each times
its weight; each weight then grows by its `_STRETCH` times the prediction error.

Everything is an integer below 2**36 in magnitude and right shifts round down, so that every machine codes alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .numba_kernels import bare_kernel, inlined

__all__ = ["INDEX", "UNKNOWN", "WEIGHT", "WIDEST", "code_bit", "code_mixed_bit", "finish", "start"]

#: Width of the interval at the start.
WIDEST = 0xFFFFFFFF
#: An index known to be positive spares the compiled loop the test for one that counts from the end.
INDEX = 0x7FFFFFFF
#: A context at the start: a probability of one half, and an adaptation count of 1.
UNKNOWN = (1 << 27) | 1
#: Either weight at the start, over 2**16.
WEIGHT = 1 << 15

_BOTTOM = 1 << 24
_SUREST = 127
_HEAVIEST = 1 << 18
_ONE = (1 << 20) - 1

#: By what part a context with the adaptation count n moves, over 2**16: 2**16 / (n + 3/2), rounded down.
_RATES = np.array([2**17 // (2 * n + 3) for n in range(_SUREST + 1)], np.int32)

#: 2**16 / (1 + exp(-i / 4)), rounded, for i = 0 to 32.
# fmt: off
_LOGISTIC = [
    32768, 36843, 40793, 44511, 47911, 50941, 53581, 55834, 57724, 59287, 60565,
    61598, 62428, 63090, 63615, 64030, 64357, 64614, 64816, 64974, 65097, 65194,
    65269, 65328, 65374, 65410, 65438, 65459, 65476, 65489, 65500, 65508, 65514,
]
# fmt: on


def _squash_table() -> NDArray[np.uint16]:
    anchors = np.array([65536 - value for value in _LOGISTIC[:0:-1]] + _LOGISTIC, np.int64)
    whole, part = np.divmod(np.arange(4096), 64)
    table = (anchors[whole] * (64 - part) + anchors[whole + 1] * part) >> 6
    chances: NDArray[np.uint16] = np.clip(table, 32, 65504).astype(np.uint16)
    return chances


#: Probability over 2**16 of x in 1/256: entry x + 2048, between the anchors of `_LOGISTIC` in a straight line, rounded
#: down.
_SQUASH = _squash_table()
#: The inverse: for the highest 12 bits of a probability, the least x with _SQUASH[x + 2048] >= 16 p + 8, within +-2047.
_STRETCH = np.clip(np.searchsorted(_SQUASH, 16 * np.arange(4096) + 8) - 2048, -2047, 2047).astype(np.int16)


@bare_kernel
def start(data: NDArray[np.uint8]) -> int:
    """The reader's ``low`` before the first bit: the first four bytes, zeros past the end."""
    low = 0
    for place in range(4):
        low = (low << 8) | (int(data[place]) if place < data.size else 0)
    return low


@bare_kernel
def _carry(place: int, data: NDArray[np.uint8]) -> None:
    """Add 1 to the number that ends before ``place``."""
    back = place - 1
    while data[back] == 255:
        data[back] = 0
        back -= 1
    data[back] += np.uint8(1)


@bare_kernel
def _shift(decoding: bool, low: int, width: int, place: int, data: NDArray[np.uint8]) -> tuple[int, int, int]:
    """Move bytes until the interval is wide enough again; returns low, width, place."""
    if not decoding and low > WIDEST:
        low &= WIDEST
        _carry(place, data)
    while width < _BOTTOM:
        if decoding:
            low = low << 8
            if place < data.size:
                low |= int(data[place & INDEX])
        else:
            data[place & INDEX] = low >> 24
            low = (low << 8) & WIDEST
        place += 1
        width <<= 8
    return low, width, place


@inlined
def _narrowed(decoding: bool, bit: int, low: int, width: int, chance: int) -> tuple[int, int, int]:
    """The part of the interval for a bit, which is read from ``low`` where decoding; returns bit, low, width.

    A 1 has the lower part: ``chance`` over 2**16.
    """
    bound = (width >> 16) * chance
    if decoding:
        bit = 1 if low < bound else 0
        low = low if bit else low - bound
    else:
        low = low if bit else low + bound
    return bit, low, bound if bit else width - bound


@inlined
def _mixed(total: int) -> int:
    """Probability of a 1 over 2**16 for this sum of inputs times their weights."""
    return int(_SQUASH[(min(max(total >> 16, -2047), 2047) + 2048) & 4095])


@inlined
def _stretched(context: int) -> int:
    """What a context brings to a mixture."""
    return int(_STRETCH[(context >> 16) & 4095])


@inlined
def _learned(context: int, bit: int) -> int:
    """The context after a bit."""
    chance, sure = context >> 8, context & 255
    chance += (((_ONE if bit else 0) - chance) * int(_RATES[sure & _SUREST])) >> 16
    return (chance << 8) | min(sure + 1, _SUREST)


@inlined
def _weighed(weight: int, x: int, error: int) -> int:
    """A weight of an input after a bit with this prediction error."""
    return min(max(weight + ((x * error + 16384) >> 15), -_HEAVIEST), _HEAVIEST)


@inlined
def code_bit(
    decoding: bool,
    bit: int,
    low: int,
    width: int,
    place: int,
    data: NDArray[np.uint8],
    model: NDArray[np.int32],
    slot: int,
) -> tuple[int, int, int, int]:
    """Code one bit in one context, which adapts; returns bit, low, width, place.

    The coder uses the highest 16 bits of the probability, within 32 ... 2**16 - 32. Writing, ``low`` is the
    interval's lower end and a carry runs back into bytes already written; reading, it is the distance of the data from
    that end. Bytes past the end of the data are zeros.
    """
    context = int(model[slot & INDEX])
    bit, low, width = _narrowed(decoding, bit, low, width, min(max(context >> 12, 32), 65504))
    model[slot & INDEX] = _learned(context, bit)
    if width < _BOTTOM:
        low, width, place = _shift(decoding, low, width, place, data)
    return bit, low, width, place


@inlined
def code_mixed_bit(
    decoding: bool,
    bit: int,
    low: int,
    width: int,
    place: int,
    data: NDArray[np.uint8],
    model: NDArray[np.int32],
    slot: int,
    other: int,
    weights: int,
) -> tuple[int, int, int, int]:
    """Code one bit in two contexts, mixed with the two weights at ``weights``; all four adapt. See `code_bit`."""
    context, second = int(model[slot & INDEX]), int(model[other & INDEX])
    heavy, light = int(model[weights & INDEX]), int(model[(weights + 1) & INDEX])
    x, y = _stretched(context), _stretched(second)
    chance = _mixed(heavy * x + light * y)
    bit, low, width = _narrowed(decoding, bit, low, width, chance)
    error = (65536 if bit else 0) - chance
    model[weights & INDEX], model[(weights + 1) & INDEX] = _weighed(heavy, x, error), _weighed(light, y, error)
    model[slot & INDEX] = _learned(context, bit)
    model[other & INDEX] = _learned(second, bit)
    if width < _BOTTOM:
        low, width, place = _shift(decoding, low, width, place, data)
    return bit, low, width, place


@bare_kernel
def finish(low: int, width: int, place: int, data: NDArray[np.uint8]) -> int:
    """Write the fewest bytes that name a number in the interval, without zeros at the end; returns the length, >= 1."""
    if low > WIDEST:
        low &= WIDEST
        _carry(place, data)
    for count in range(5):
        mask = WIDEST >> (8 * count)
        value = (low + mask) & ~mask
        if value < low + width:
            if value > WIDEST:
                value &= WIDEST
                _carry(place, data)
            for i in range(count):
                data[place] = (value >> (24 - 8 * i)) & 255
                place += 1
            break
    while place > 1 and data[place - 1] == 0:
        place -= 1
    if place == 0:
        data[0] = 0
        place = 1
    return place
