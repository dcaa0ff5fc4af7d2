"""The embedded coder: one tile of one channel, bit-plane by bit-plane, through an adaptive binary range coder.

A plane takes two passes. Each goes through the tile's bands, and each band through its blocks of 8 x 8 coefficients in
raster order. The first pass visits only insignificant coefficients with a significant neighbour, for these are the bits
that lower the error most; the second visits all others. There, a block without a significant coefficient so far sends
one flag: does it get one in this plane? In a block that has, each coefficient sends its bit of the plane and, with the
first 1, its sign.

What a context sees of a coefficient are the bits known so far: of this plane for coefficients coded before it, of the
planes above for those that come later, and of the planes at and above this one for its parent and what is around that.
All of it is counted in units of the plane (bits below are shifted out); what lies outside the tile's band is 0. The
contexts, in this order (see `binary_coder` for their probabilities):

- *Across*, of a coefficient's bit: ((m 5 + h) 5 + v) 4 + kind. m is the class of its own magnitude so far, in units of
  the next higher plane: 0, 1, 2 (for 2 and 3), 3 (for 4 and more). h and v are the sums of the two neighbours in its
  row and of those in its column, at most 4. kind is the band's: 1 for details along the columns' axis plus 2 for
  details along the rows' axis.
- *Around*, (m 7 + r) 6 + f, for m = 0 and 1 only, mixed with the former with two weights for each m. r is the `_CLASS`
  of the sum of the sixteen coefficients at distance two, the four in the same row or column counted twice; f is that of
  four times the parent plus its four neighbours, at most 5.
- *Signs*, a 1 is negative: (3 (x + 1) + y + 1) 4 + kind. x is the sign of the sum of the signs known of the neighbours
  in the row, y of those in the column.
- With a trellis, in plane 0, *across* and *around* for m = 0 and 1 are other ones, of the quantiser that the index is
  for: that follows from the parity of all before it, so plane 0 has no first pass there.
- *Flags*: (3 b + a) 3 + f. b counts the blocks to the left and above that have a significant coefficient, a those to
  the right and below; f is the largest of the parents of the block's coefficients, at most 2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .band_fields import (
    COLUMN_SHIFT,
    COLUMNS,
    FLAGS,
    KIND,
    OFFSET,
    PARENT,
    PARENT_STRIDE,
    ROW_SHIFT,
    ROWS,
    STRIDE,
)
from .binary_coder import INDEX, UNKNOWN, WEIGHT, WIDEST, code_bit, code_mixed_bit, finish, start
from .numba_kernels import bare_kernel, inlined, kernel
from .trellis import ODD, TRANSITIONS

__all__ = [
    "BLOCK",
    "CONTEXTS",
    "SUMS",
    "code_passes",
    "new_model",
    "pass_count",
    "pass_gains",
    "reconstruction_point",
]

#: Rows and columns of a block.
BLOCK = 8
#: What is summed up around the coefficients of a block's row, see `_look`.
SUMS = 3 * BLOCK

_KINDS = 4
_ACROSS_CONTEXTS = 4 * 5 * 5 * _KINDS
_AROUND_CONTEXTS = 2 * 7 * 6
_SIGN_CONTEXTS = 9 * _KINDS
_FLAG_CONTEXTS = 27
# Behind the contexts stand the weights.
_FIRST_AROUND = _ACROSS_CONTEXTS
_FIRST_SIGN = _FIRST_AROUND + _AROUND_CONTEXTS
_FIRST_FLAG = _FIRST_SIGN + _SIGN_CONTEXTS
CONTEXTS = _FIRST_FLAG + _FLAG_CONTEXTS
# Of a trellis, behind the weights: across and around for either quantiser and m = 0 and 1, and their weights.
_TRELLIS_ACROSS = CONTEXTS + 4
_TRELLIS_AROUND = _TRELLIS_ACROSS + 2 * _ACROSS_CONTEXTS // 2
_TRELLIS_WEIGHTS = _TRELLIS_AROUND + 2 * _AROUND_CONTEXTS
_TRELLIS_END = _TRELLIS_WEIGHTS + 8

#: Class of a sum; 17 stands for all that is more.
_CLASS = np.array([0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 4, 4, 5, 5, 5, 5, 5, 6], np.uint8)


def pass_count(planes: int) -> int:
    """Coding passes of so many bit-planes: two each, but the highest has no first pass."""
    return 2 * planes - 1 if planes else 0


def new_model(trellis: bool = False) -> NDArray[np.int32]:
    """The contexts of a tile before its first plane, see `binary_coder`, and the weights: int32, flat."""
    model = np.full(_TRELLIS_END if trellis else _TRELLIS_ACROSS, UNKNOWN, np.int32)
    model[CONTEXTS:_TRELLIS_ACROSS] = model[_TRELLIS_WEIGHTS:] = WEIGHT
    return model


@inlined
def _look(known: NDArray[np.int32], at: int, stride: int, sums: NDArray[np.uint32]) -> None:
    """Sums of what is known around each of the eight coefficients from ``at`` on, apart from their row; below 2**32.

    Into ``sums``: 0-7 the two neighbours in the column; 8-15 those and the four at the corners; 16-23 the fourteen at
    distance two, those in the column twice. Where a row has less than eight, the rest means nothing.
    """
    # Unsigned, lest an index might count from the end: the compiler then takes several of the eight at once.
    row = np.uint64(at - 2 * stride - 2)
    second, fourth, fifth = np.uint64(stride), np.uint64(3 * stride), np.uint64(4 * stride)
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    for j in range(8):
        a = row + np.uint64(j)
        b, d, e = a + second, a + fourth, a + fifth
        rise = int(known[b + two]) + int(known[d + two])
        ring = 2 * (int(known[a + two]) + int(known[e + two]))
        ring += int(known[a]) + int(known[a + one]) + int(known[a + three]) + int(known[a + four])
        ring += int(known[b]) + int(known[b + four]) + int(known[d]) + int(known[d + four])
        ring += int(known[e]) + int(known[e + one]) + int(known[e + three]) + int(known[e + four])
        sums[np.uint64(j)] = rise
        sums[np.uint64(j + 8)] = (
            rise + int(known[b + one]) + int(known[b + three]) + int(known[d + one]) + int(known[d + three])
        )
        sums[np.uint64(j + 16)] = ring


@inlined
def _all_significant(known: NDArray[np.int32], at: int, count: int) -> bool:
    """Whether the first pass would find nothing to visit in a row: no insignificant coefficient in it."""
    least = 1
    for j in range(count):
        least = min(least, int(known[np.uint64(at + j)]))
    return least != 0


@inlined
def _nothing_near(known: NDArray[np.int32], at: int, count: int, sums: NDArray[np.uint32]) -> bool:
    """Whether the first pass would find nothing to visit in a row: no significant coefficient in it or beside it."""
    found = int(known[np.uint64(at - 1)]) | int(known[np.uint64(at + count)])
    for j in range(count):
        found |= int(known[np.uint64(at + j)]) | (int(sums[np.uint64(j + 8)]) & WIDEST)
    return found == 0


@inlined
def _family(known: NDArray[np.int32], at: int, stride: int, plane: int) -> int:
    """Class of four times the parent at ``at`` plus its four neighbours."""
    total = (
        4 * (int(known[at & INDEX]) >> plane)
        + (int(known[(at - 1) & INDEX]) >> plane)
        + (int(known[(at + 1) & INDEX]) >> plane)
        + (int(known[(at - stride) & INDEX]) >> plane)
        + (int(known[(at + stride) & INDEX]) >> plane)
    )
    return min(int(_CLASS[min(total, 17)]), 5)


@inlined
def _of_state(state: int) -> tuple[int, int, int]:
    """Where across, around and their weights begin for an index that is coded in plane 0 in this state."""
    odd = int(ODD[state])
    return (
        _TRELLIS_ACROSS + odd * (_ACROSS_CONTEXTS // 2),
        _TRELLIS_AROUND + odd * _AROUND_CONTEXTS,
        _TRELLIS_WEIGHTS + 4 * odd,
    )


@bare_kernel
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
    trellis: bool,
    sums: NDArray[np.uint32],
) -> int:
    """Code the passes ``first`` down to ``last`` of one tile of one channel; plane p has the passes 2 p + 1 and 2 p.

    Parameters
    ----------
    decoding : bool
        Read ``data`` rather than write it.
    bands : int64, shape (band, `band_fields.BAND_FIELDS`)
    known : int32, flat
        Magnitudes as far as they are known, of all tiles, two zeros around each band; updated.
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
        Bytes of this run of passes; where writing, long enough: a bit in a context takes at most 11 bits.
    costs : float64, at least ``first + 1`` long
        Where writing, the bits written when each pass ended. May be empty.
    trellis : bool
        The coefficients are indices with a trellis, see `trellis`; ``model`` is one of a trellis.
    sums : uint32, shape (`SUMS`,)
        Room to work in.

    Returns
    -------
    int
        Bytes of the run, where writing.
    """
    low, width, place, bit = 0, WIDEST, 0, 0
    if decoding:
        low, place = start(data), 4
    # Sums are read through a mask, for a sum of signed and unsigned compiles to a float.
    for number in range(first, last - 1, -1):
        plane, begins = number >> 1, (number & 1) == 1
        unit = 1 << plane
        dependent = trellis and plane == 0
        if dependent and begins:
            if costs.size:
                costs[number] = 8.0 * place + 32.0 - np.log2(float(width))
            continue
        for band in range(bands.shape[0]):
            state, first_across, first_around, weights = 0, 0, _FIRST_AROUND, CONTEXTS
            if dependent:
                first_across, first_around, weights = _of_state(state)
            offset, stride, kind = bands[band, OFFSET], bands[band, STRIDE], bands[band, KIND]
            rows, columns = bands[band, ROWS], bands[band, COLUMNS]
            parent, parent_stride = bands[band, PARENT], bands[band, PARENT_STRIDE]
            row_shift, column_shift = bands[band, ROW_SHIFT], bands[band, COLUMN_SHIFT]
            first_flag, across = bands[band, FLAGS], (columns + 7) >> 3
            for top in range(0, rows, 8):
                bottom = min(top + 8, rows)
                for left in range(0, columns, 8):
                    right = min(left + 8, columns)
                    block = first_flag + (top >> 3) * (across + 1) + (left >> 3)
                    if flags[block & INDEX] == 0:
                        if begins:
                            continue
                        family = 0
                        for i in range(top >> row_shift, ((bottom - 1) >> row_shift) + 1):
                            for j in range(left >> column_shift, ((right - 1) >> column_shift) + 1):
                                family |= int(known[(parent + i * parent_stride + j) & INDEX])
                        before = int(flags[(block - 1) & INDEX]) + int(flags[(block - across - 1) & INDEX])
                        after = int(flags[(block + 1) & INDEX]) + int(flags[(block + across + 1) & INDEX])
                        slot = _FIRST_FLAG + (before * 3 + after) * 3 + min(family >> plane, 2)
                        if not decoding:
                            seen = 0
                            for i in range(top, bottom):
                                at = offset + i * stride
                                for j in range(left, right):
                                    seen |= abs(int(true[(at + j) & INDEX]))
                            bit = 1 if seen >= unit else 0
                        bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, slot)
                        if bit == 0:
                            if dependent:
                                for _ in range((bottom - top) * (right - left)):
                                    state = TRANSITIONS[state, 0]
                                first_across, first_around, weights = _of_state(state)
                            continue
                        flags[block & INDEX] = 1
                    for i in range(top, bottom):
                        at = offset + i * stride + left
                        if begins and _all_significant(known, at, right - left):
                            continue
                        _look(known, at, stride, sums)
                        if begins and _nothing_near(known, at, right - left, sums):
                            continue
                        family_row = parent + (i >> row_shift) * parent_stride
                        far_west, west = int(known[(at - 2) & INDEX]), int(known[(at - 1) & INDEX])
                        value, east = int(known[at & INDEX]), int(known[(at + 1) & INDEX])
                        for j in range(left, right):
                            far_east = int(known[(at + 2) & INDEX])
                            rise, side = (int(sums[j & 7]) & WIDEST), west + east
                            if begins:
                                visits = value == 0 and (side + (int(sums[(j & 7) + 8]) & WIDEST)) >> plane != 0
                            else:
                                visits = early[at & INDEX] != plane + 1
                            if visits:
                                if begins:
                                    early[at & INDEX] = plane + 1
                                own = value >> (plane + 1)
                                slot = min(own, 2) if own < 4 else 3
                                if not decoding:
                                    bit = (abs(int(true[at & INDEX])) >> plane) & 1
                                across_slot = (
                                    (slot * 5 + min(side >> plane, 4)) * 5 + min(rise >> plane, 4)
                                ) * 4 + kind
                                if slot > 1:
                                    bit, low, width, place = code_bit(
                                        decoding, bit, low, width, place, data, model, across_slot
                                    )
                                else:
                                    ring = ((int(sums[(j & 7) + 16]) & WIDEST) + 2 * (far_west + far_east)) >> plane
                                    around = (slot * 7 + int(_CLASS[min(ring, 17)])) * 6 + _family(
                                        known, family_row + (j >> column_shift), parent_stride, plane
                                    )
                                    bit, low, width, place = code_mixed_bit(
                                        decoding,
                                        bit,
                                        low,
                                        width,
                                        place,
                                        data,
                                        model,
                                        first_across + across_slot,
                                        first_around + around,
                                        weights + 2 * slot,
                                    )
                                if bit:
                                    value += unit
                                    known[at & INDEX] = value
                                    if own == 0:
                                        side = int(sign[(at - 1) & INDEX]) + int(sign[(at + 1) & INDEX])
                                        rise = int(sign[(at - stride) & INDEX]) + int(sign[(at + stride) & INDEX])
                                        slot = 3 * (min(max(side, -1), 1) + 1) + min(max(rise, -1), 1) + 1
                                        if not decoding:
                                            bit = 1 if true[at & INDEX] < 0 else 0
                                        bit, low, width, place = code_bit(
                                            decoding, bit, low, width, place, data, model, _FIRST_SIGN + 4 * slot + kind
                                        )
                                        sign[at & INDEX] = -1 if bit else 1
                            if dependent:
                                state = TRANSITIONS[state, value & 1]
                                first_across, first_around, weights = _of_state(state)
                            far_west, west, value, east = west, value, east, far_east
                            at += 1
        if costs.size:
            costs[number] = 8.0 * place + 32.0 - np.log2(float(width))
    return 0 if decoding else finish(low, width, place, data)


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
        offset, stride = bands[band, OFFSET], bands[band, STRIDE]
        for i in range(bands[band, ROWS]):
            for j in range(bands[band, COLUMNS]):
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
                    # The first pass of a lower plane skips a coefficient that is significant already.
                    known = min((remaining + 1) >> 1, plane)
                    error = float((value & ((1 << known) - 1)) - reconstruction_point(known))
                    sums[remaining] += error * error
                    remaining -= 1
        for remaining in range(passes + 1):
            errors[remaining] += weights[band] * sums[remaining]


@inlined
def reconstruction_point(plane: int) -> int:
    """What is added to a significant magnitude whose bits below ``plane`` are unknown."""
    return (7 << plane) >> 4
