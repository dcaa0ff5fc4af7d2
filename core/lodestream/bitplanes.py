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
# An index known to be positive spares the compiled loop the test for one that counts from the end.
_INDEX = 0x7FFFFFFF
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
    """The contexts of a tile before its first plane: int32, flat; four each: fast and slow probability, count, 0."""
    model = np.full((CONTEXTS, 4), _HALF, np.int32)
    model[:, 2:] = 0
    return model.reshape(-1)


@kernel
def _carry(place: int, data: NDArray[np.uint8]) -> None:
    """Add 1 to the number that ends before ``place``."""
    back = place - 1
    while data[back] == 255:
        data[back] = 0
        back -= 1
    data[back] += np.uint8(1)


@kernel
def _code(
    decoding: bool,
    bit: int,
    low: int,
    width: int,
    place: int,
    data: NDArray[np.uint8],
    model: NDArray[np.int32],
    context: int,
) -> tuple[int, int, int, int]:
    """Code one bit in a context and let the context learn it; returns bit, low, width, place.

    The chance of a 1 is the mean of the context's two probabilities, over 2**16, within 32 ... 2**16 - 32. Writing,
    ``low`` is the interval's lower end and a carry runs back into bytes already written; reading, it is the distance
    of the data from that end. Bytes past the end of the data are zeros.
    """
    slot = (context << 2) & _INDEX
    fast, slow, count = int(model[slot]), int(model[slot | 1]), int(model[slot | 2])
    bound = (width >> 16) * min(max((fast + slow) >> 1, 32), 65504)
    if decoding:
        bit = 1 if low < bound else 0
        low = low if bit else low - bound
    else:
        low = low if bit else low + bound
    width = bound if bit else width - bound
    target = 65535 if bit else 0
    model[slot] = fast + ((target - fast) >> int(_FAST[count & 255]))
    model[slot | 1] = slow + ((target - slow) >> int(_SLOW[count & 255]))
    model[slot | 2] = min(count + 1, 255)
    if width < _BOTTOM:
        if not decoding and low > _MASK:
            low &= _MASK
            _carry(place, data)
        while width < _BOTTOM:
            if decoding:
                low = low << 8
                if place < data.size:
                    low |= int(data[place & _INDEX])
            else:
                data[place & _INDEX] = low >> 24
                low = (low << 8) & _MASK
            place += 1
            width <<= 8
    return bit, low, width, place


@kernel
def _finish(low: int, width: int, place: int, data: NDArray[np.uint8]) -> int:
    """Write the fewest bytes that name a number in the interval, without zeros at the end; returns the length, >= 1."""
    for count in range(5):
        mask = _MASK >> (8 * count)
        value = (low + mask) & ~mask
        if value < low + width:
            if value > _MASK:
                value &= _MASK
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
            first_flag, across = bands[band, _FLAGS], (columns + 7) >> 3
            for top in range(0, rows, 8):
                bottom = min(top + 8, rows)
                for left in range(0, columns, 8):
                    right = min(left + 8, columns)
                    block = first_flag + (top >> 3) * (across + 1) + (left >> 3)
                    if flags[block & _INDEX] == 0:
                        if begins:
                            continue
                        family = known[(parent + (top >> row_shift) * parent_stride + (left >> column_shift)) & _INDEX]
                        context = _FIRST_FLAG + 2 * (
                            int(flags[(block - 1) & _INDEX]) + int(flags[(block - across - 1) & _INDEX])
                        )
                        context += 1 if (family >> plane) != 0 else 0
                        if not decoding:
                            seen = 0
                            for i in range(top, bottom):
                                start = offset + i * stride
                                for j in range(left, right):
                                    seen |= abs(int(true[(start + j) & _INDEX]))
                            bit = 1 if seen >= unit else 0
                        bit, low, width, place = _code(decoding, bit, low, width, place, data, model, context)
                        if bit == 0:
                            continue
                        flags[block & _INDEX] = 1
                    for i in range(top, bottom):
                        at = offset + i * stride + left
                        north, south = at - stride, at + stride
                        family_row = parent + (i >> row_shift) * parent_stride
                        # Sums of the neighbours above and below, one column back and here; they move along the row.
                        behind = int(known[(north - 1) & _INDEX]) + int(known[(south - 1) & _INDEX])
                        here = int(known[north & _INDEX]) + int(known[south & _INDEX])
                        west, value = int(known[(at - 1) & _INDEX]), int(known[at & _INDEX])
                        for j in range(left, right):
                            ahead = int(known[(north + 1) & _INDEX]) + int(known[(south + 1) & _INDEX])
                            east = int(known[(at + 1) & _INDEX])
                            total = (behind + 2 * (here + west + east) + ahead) >> plane
                            if begins:
                                visits = value == 0 and total != 0
                                early[at & _INDEX] = plane + 1 if visits else early[at & _INDEX]
                            else:
                                visits = early[at & _INDEX] != plane + 1
                            if visits:
                                own = value >> (plane + 1)
                                family = known[(family_row + (j >> column_shift)) & _INDEX] >> plane
                                context = (
                                    (min(own, 2) if own < 4 else 3) * 12 + int(_SUM_CLASS[min(total, 63)])
                                ) * 3 + min(family, 2)
                                if not decoding:
                                    bit = (abs(int(true[at & _INDEX])) >> plane) & 1
                                bit, low, width, place = _code(decoding, bit, low, width, place, data, model, context)
                                if bit:
                                    value += unit
                                    known[at & _INDEX] = value
                                    if own == 0:
                                        side = int(sign[(at - 1) & _INDEX]) + int(sign[(at + 1) & _INDEX])
                                        rise = int(sign[north & _INDEX]) + int(sign[south & _INDEX])
                                        context = _FIRST_SIGN + 3 * (min(max(side, -1), 1) + 1)
                                        context += min(max(rise, -1), 1) + 1
                                        if not decoding:
                                            bit = 1 if true[at & _INDEX] < 0 else 0
                                        bit, low, width, place = _code(
                                            decoding, bit, low, width, place, data, model, context
                                        )
                                        sign[at & _INDEX] = -1 if bit else 1
                            west, value = value, east
                            behind, here = here, ahead
                            at += 1
                            north += 1
                            south += 1
        if costs.size:
            costs[number] = 8.0 * place + 32.0 - np.log2(float(width))
    if not decoding and low > _MASK:
        low &= _MASK
        _carry(place, data)
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
