"""The embedded coder: one tile of one channel, bit-plane by bit-plane, through an adaptive binary range coder.

A plane takes two passes. Each goes through the tile's bands, and each band through its blocks of 8 x 8 coefficients in
raster order. The first pass visits only insignificant coefficients with a significant neighbour, for these are the bits
that lower the error most; the second visits all others. There, a block without a significant coefficient so far sends
one flag: does it get one in this plane? In a block that has, each coefficient sends its bit of the plane and, with the
first 1, its sign. ``docs/format.md`` specifies every context.

What a context sees of a coefficient are the bits known so far: of this plane for coefficients coded before it, of the
planes above for those that come later, and of the planes at and above this one for its parent.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .kernels import kernel

__all__ = [
    "BAND_FIELDS",
    "CONTEXTS",
    "code_passes",
    "new_model",
    "pass_count",
    "pass_gains",
    "reconstruction_point",
]

#: Columns of the table that describes a tile's bands to the kernels, see `code_planes`.
BAND_FIELDS = 9
(
    _OFFSET,
    _STRIDE,
    _ROWS,
    _COLUMNS,
    _FLAGS,
    _PARENT,
    _PARENT_STRIDE,
    _ROW_SHIFT,
    _COLUMN_SHIFT,
) = range(BAND_FIELDS)

_MAGNITUDE_CONTEXTS = 4 * 12 * 3
_SIGN_CONTEXTS = 9
_FLAG_CONTEXTS = 6
CONTEXTS = _MAGNITUDE_CONTEXTS + _SIGN_CONTEXTS + _FLAG_CONTEXTS
_FIRST_SIGN = _MAGNITUDE_CONTEXTS
_FIRST_FLAG = _MAGNITUDE_CONTEXTS + _SIGN_CONTEXTS

_MASK = 0xFFFFFFFF
_BOTTOM = 1 << 24
_HALF = 1 << 15
#: Class of a sum of neighbours, in halves of the plane's unit.
_SUM_CLASS = np.array(
    [0, 1, 2, 3, 4, 5, 6, 7, 7, 8, 8, 8, 9, 9, 9, 9, 9, 10, 10, 10, 10, 10, 10, 10, 10, 10, 10] + [11] * 37, np.int64
)
#: Shifts by which a context's two probabilities move, by the number of bits that it has seen.
_FAST = np.array([1, 2, 2, 3, 3, 3, 4, 4, 4, 4, 4, 4, 4, 4, 4, 4] + [4] * 240, np.int64)
_SLOW = np.array([1, 2, 2, 3, 3, 3, 4, 4, 4, 4, 4, 4, 5, 5, 5, 5] + [5] * 16 + [6] * 32 + [7] * 192, np.int64)


def pass_count(planes: int) -> int:
    """Coding passes of so many bit-planes: two each, but the highest has no first pass."""
    return 2 * planes - 1 if planes else 0


def new_model() -> NDArray[np.int32]:
    """The contexts of a tile before its first plane: int32, shape (context, 3): fast and slow probability, count."""
    model = np.full((CONTEXTS, 3), _HALF, np.int32)
    model[:, 2] = 0
    return model


@kernel
def _probability(model: NDArray[np.int32], context: int) -> int:
    """Probability of a 1 over 2**16, within 32 ... 2**16 - 32."""
    return min(max((int(model[context, 0]) + int(model[context, 1])) >> 1, 32), 65504)


@kernel
def _learn(model: NDArray[np.int32], context: int, bit: int) -> None:
    fast, slow, count = int(model[context, 0]), int(model[context, 1]), int(model[context, 2])
    target = 65535 if bit else 0
    model[context, 0] = fast + ((target - fast) >> _FAST[count])
    model[context, 1] = slow + ((target - slow) >> _SLOW[count])
    model[context, 2] = min(count + 1, 255)


@kernel
def _code(
    decoding: bool, bit: int, chance: int, low: int, width: int, place: int, data: NDArray[np.uint8]
) -> tuple[int, int, int, int]:
    """Code one bit whose chance of being 1 is ``chance`` over 2**16; returns bit, low, width, place.

    Writing, ``low`` is the interval's lower end and a carry runs back into bytes already written; reading, it is the
    distance of the data from that end. Bytes past the end of the data are zeros.
    """
    bound = (width >> 16) * chance
    if decoding:
        bit = 1 if low < bound else 0
        if bit:
            width = bound
        else:
            low -= bound
            width -= bound
        while width < _BOTTOM:
            low = low << 8
            if place < data.size:
                low |= int(data[place])
            place += 1
            width <<= 8
    else:
        if bit:
            width = bound
        else:
            low += bound
            width -= bound
        if low > _MASK:
            low &= _MASK
            back = place - 1
            while data[back] == 255:
                data[back] = 0
                back -= 1
            data[back] += np.uint8(1)
        while width < _BOTTOM:
            data[place] = low >> 24
            low = (low << 8) & _MASK
            place += 1
            width <<= 8
    return bit, low, width, place


@kernel
def _finish(low: int, width: int, place: int, data: NDArray[np.uint8]) -> int:
    """Write the fewest bytes that name a number in the interval, leave out zeros at the end; returns the length, at least 1."""
    for count in range(5):
        mask = _MASK >> (8 * count)
        value = (low + mask) & ~mask
        if value < low + width:
            if value > _MASK:
                value &= _MASK
                back = place - 1
                while data[back] == 255:
                    data[back] = 0
                    back -= 1
                data[back] += np.uint8(1)
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


@kernel
def code_passes(
    decoding: bool,
    bands: NDArray[np.int64],
    first: int,
    last: int,
    known: NDArray[np.int32],
    sign: NDArray[np.int8],
    flags: NDArray[np.uint8],
    early: NDArray[np.uint8],
    true: NDArray[np.int32],
    model: NDArray[np.int32],
    data: NDArray[np.uint8],
    costs: NDArray[np.float64],
) -> int:
    """Code the passes ``first`` down to ``last`` of one tile of one channel; plane p has the passes 2 p + 1 and 2 p.

    Parameters
    ----------
    decoding : bool
        Read ``data`` rather than write it.
    bands : int64, shape (band, `BAND_FIELDS`)
        For each band: where its first coefficient stands in the flat arrays, their stride, rows, columns, where its
        first block stands in ``flags`` (stride: blocks across + 1, with a row before), the same for the parent of the
        first coefficient, and the shifts that take a row and a column to the parent's.
    known : int32, flat
        Magnitudes as far as they are known, of all tiles, each band in a frame of zeros; updated.
    sign : int8, flat
        -1, +1, or 0 where no bit is known; updated. Where writing, +-1 must stand in ``true``'s sign.
    flags : uint8, flat
        Whether a block has a significant coefficient; updated.
    early : uint8, flat
        1 + the plane in whose first pass a coefficient was coded last; updated.
    true : int32, flat
        The coefficients with their signs, where writing; not looked at where reading.
    model : int32, see `new_model`
        Updated.
    data : uint8
        Bytes of this run of passes; where writing, long enough (see `encode_bound`).
    costs : float64, at least ``first + 1`` long
        Where writing, the bits written when each pass ended. May be empty.

    Returns
    -------
    int
        Bytes of the run, where writing.
    """
    low, width, place, bit = 0, _MASK, 0, 0
    if decoding:
        for place in range(4):
            low = (low << 8) | (int(data[place]) if place < data.size else 0)
        place = 4
    for number in range(first, last - 1, -1):
        plane, begins = number >> 1, (number & 1) == 1
        unit = 1 << plane
        for band in range(bands.shape[0]):
            offset, stride = bands[band, _OFFSET], bands[band, _STRIDE]
            rows, columns = bands[band, _ROWS], bands[band, _COLUMNS]
            parent, parent_stride = bands[band, _PARENT], bands[band, _PARENT_STRIDE]
            row_shift, column_shift = bands[band, _ROW_SHIFT], bands[band, _COLUMN_SHIFT]
            across = (columns + 7) >> 3
            for block_row in range((rows + 7) >> 3):
                for block_column in range(across):
                    block = bands[band, _FLAGS] + block_row * (across + 1) + block_column
                    if flags[block] == 0:
                        if begins:
                            continue
                        family = known[
                            parent
                            + ((block_row << 3) >> row_shift) * parent_stride
                            + ((block_column << 3) >> column_shift)
                        ]
                        context = _FIRST_FLAG + 2 * (int(flags[block - 1]) + int(flags[block - across - 1]))
                        context += 1 if (family >> plane) != 0 else 0
                        bit = 0
                        if not decoding:
                            for i in range(block_row << 3, min((block_row << 3) + 8, rows)):
                                start = offset + i * stride
                                for j in range(block_column << 3, min((block_column << 3) + 8, columns)):
                                    if abs(true[start + j]) >= unit:
                                        bit = 1
                        chance = _probability(model, context)
                        bit, low, width, place = _code(decoding, bit, chance, low, width, place, data)
                        _learn(model, context, bit)
                        if bit == 0:
                            continue
                        flags[block] = 1
                    for i in range(block_row << 3, min((block_row << 3) + 8, rows)):
                        above = offset + (i - 1) * stride
                        family_row = parent + (i >> row_shift) * parent_stride
                        for j in range(block_column << 3, min((block_column << 3) + 8, columns)):
                            north = above + j
                            at = north + stride
                            if (known[at] != 0) if begins else (early[at] == plane + 1):
                                continue
                            south = at + stride
                            total = (
                                2 * (known[north] + known[south] + known[at - 1] + known[at + 1])
                                + known[north - 1]
                                + known[north + 1]
                                + known[south - 1]
                                + known[south + 1]
                            ) >> plane
                            if begins:
                                if total == 0:
                                    continue
                                early[at] = plane + 1
                            own = known[at] >> (plane + 1)
                            family = known[family_row + (j >> column_shift)] >> plane
                            context = (
                                (min(own, 2) if own < 4 else 3) * 12 + _SUM_CLASS[min(total, 63)]
                            ) * 3 + min(family, 2)
                            if not decoding:
                                bit = (abs(true[at]) >> plane) & 1
                            chance = _probability(model, context)
                            bit, low, width, place = _code(decoding, bit, chance, low, width, place, data)
                            _learn(model, context, bit)
                            if bit == 0:
                                continue
                            known[at] += unit
                            if own == 0:
                                side = min(max(int(sign[at - 1]) + int(sign[at + 1]), -1), 1)
                                rise = min(max(int(sign[north]) + int(sign[south]), -1), 1)
                                context = _FIRST_SIGN + 3 * (side + 1) + rise + 1
                                if not decoding:
                                    bit = 1 if true[at] < 0 else 0
                                chance = _probability(model, context)
                                bit, low, width, place = _code(decoding, bit, chance, low, width, place, data)
                                _learn(model, context, bit)
                                sign[at] = -1 if bit else 1
        if costs.size:
            costs[number] = 8.0 * place + 32.0 - np.log2(float(width))
    return 0 if decoding else _finish(low, width, place, data)


@kernel
def pass_gains(
    bands: NDArray[np.int64],
    weights: NDArray[np.float64],
    passes: int,
    true: NDArray[np.int32],
    early: NDArray[np.uint8],
    errors: NDArray[np.float64],
) -> None:
    """Weighted squared error of a tile by the passes that remain, into ``errors``, of length passes + 1.

    ``weights`` are the squared norms of the bands' synthesis functions, one a band; ``early`` is that of the whole
    tile coded.
    """
    errors[:] = 0.0
    for band in range(bands.shape[0]):
        sums = np.zeros(passes + 2, np.float64)
        offset, stride = bands[band, _OFFSET], bands[band, _STRIDE]
        for i in range(bands[band, _ROWS]):
            for j in range(bands[band, _COLUMNS]):
                at = offset + i * stride + j
                value = abs(int(true[at]))
                if value == 0:
                    continue
                remaining = passes
                plane = (passes + 1) >> 1
                while (value >> plane) == 0:
                    plane -= 1
                # Nothing is known until the pass that finds the coefficient significant, in its highest plane.
                found = 2 * plane + 1 if early[at] == plane + 1 else 2 * plane
                square = float(value) * float(value)
                while remaining > found:
                    sums[remaining] += square
                    remaining -= 1
                while remaining > 0:
                    # The first pass of a lower plane tells nothing about a coefficient that is significant already.
                    known = min((remaining + 1) >> 1, plane)
                    error = float((value & ((1 << known) - 1)) - reconstruction_point(known))
                    sums[remaining] += error * error
                    remaining -= 1
        for remaining in range(passes + 1):
            errors[remaining] += weights[band] * sums[remaining]


@kernel
def reconstruction_point(plane: int) -> int:
    """What is added to a significant magnitude whose bits below ``plane`` are unknown."""
    return (7 << plane) >> 4
