"""Differences on a line of whole numbers, coded: what is nearly uniform noise, of a width that is known beforehand.

The width follows from the lattice's step and the value's exponent. So the bits that a difference takes are counted
down from the most that the exponent of the restored value allows, in contexts; the bits themselves and the sign are
stored as they are. If the place on the line has occurred before, its last difference predicts this one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .binary_coder import INDEX, UNKNOWN, WIDEST, code_bit, finish, start
from .numba_kernels import inlined, kernel

__all__ = ["code_differences", "most_bits"]

# Contexts: whether a difference takes so many bits less than the most; specials; what is remembered of a place.
_DEEPEST = 15
_SPECIALS = 256
_WHICH = _SPECIALS + 4
_SAME = _WHICH + 16
_CLOSE_TO = _SAME + 1
_BESIDE = _CLOSE_TO + 1
_CONTEXTS = _BESIDE + 16

#: Places on the line whose last difference is remembered, in a table by their hash.
_ENTRIES = 1 << 14
#: A difference this close to the one remembered is coded as the distance from it.
_CLOSE = 8
_SPREAD = 0x9E3779B97F4A7C15 - (1 << 64)

_Ints = NDArray[np.int64]


def code_differences(
    decoding: bool,
    line: _Ints,
    differences: _Ints,
    exponents: NDArray[np.int32],
    marks: NDArray[np.uint8],
    most: int,
    specials: int,
    data: NDArray[np.uint8],
    stored: NDArray[np.uint8],
) -> tuple[int, int]:
    """Code how far values, shape (value,), are from the places on the line that a lattice restores.

    Parameters
    ----------
    decoding : bool
        Read ``data`` and ``stored``, and fill ``differences`` and ``marks``, rather than write.
    differences : int64 array of shape (value,)
        All above -2**63, whose magnitude has too many bits.
    line, exponents
        Of the restored values, as `number_line.to_line` gives them.
    marks : uint8 array of shape (value,)
        For values that are on no line their number in the piece's list, from 1; else 0.
    most : int
        What `most_bits` says.
    specials : int
        Length of that list.
    data, stored : uint8 arrays
        Decisions in contexts, at most 128 bytes a value and 64; lower bits, at most 8 bytes a value and 16. Bytes that
        are missing count as 0.

    Returns
    -------
    tuple of two int
        Bytes of ``data`` and of ``stored``, written or looked at.
    """
    model = np.full(_CONTEXTS, UNKNOWN, np.int32)
    used, size = _code(decoding, line, differences, exponents, marks, most, specials, model, data, stored)
    return int(used), int(size)


@kernel
def _length(magnitude: int) -> int:
    """Bits of a number of 0 or more, below 2**63."""
    length = 0
    for step in (32, 16, 8, 4, 2, 1):
        if magnitude >> step:
            length += step
            magnitude >>= step
    return length + (1 if magnitude else 0)


@kernel
def most_bits(differences: _Ints, exponents: NDArray[np.int32], marks: NDArray[np.uint8]) -> int:
    """The largest sum of a difference's bits and its exponent, of those that have no mark."""
    most = 0
    for i in range(differences.size):
        if marks[i] == 0 and differences[i]:
            most = max(most, _length(abs(differences[i])) + exponents[i])
    return most


@inlined
def _store(
    decoding: bool, value: int, bits: int, queue: int, queued: int, at: int, stored: NDArray[np.uint8]
) -> tuple[int, int, int, int]:
    """Put a number of at most 33 bits at the end of ``stored``, lowest bit first, or take it from there.

    ``queue`` holds the bits that do not fill a byte; returns the number, and the state.
    """
    if decoding:
        while queued < bits:
            if at < stored.size:
                queue |= int(stored[at & INDEX]) << queued
            at += 1
            queued += 8
        value = queue & ((1 << bits) - 1)
        return value, queue >> bits, queued - bits, at
    queue |= value << queued
    queued += bits
    while queued >= 8:
        stored[at & INDEX] = queue & 255
        at += 1
        queue >>= 8
        queued -= 8
    return value, queue, queued, at


@kernel
def _code(
    decoding: bool,
    lines: _Ints,
    differences: _Ints,
    exponents: NDArray[np.int32],
    marks: NDArray[np.uint8],
    most: int,
    specials: int,
    model: NDArray[np.int32],
    data: NDArray[np.uint8],
    stored: NDArray[np.uint8],
) -> tuple[int, int]:
    """Code all differences and marks; returns the bytes of ``data`` and those of ``stored``, read or written."""
    width = WIDEST
    low, place = (start(data), 4) if decoding else (0, 0)
    queue, queued, at = 0, 0, 0
    recent = 0
    keys, values, filled = np.zeros(_ENTRIES, np.int64), np.zeros(_ENTRIES, np.int64), np.zeros(_ENTRIES, np.bool_)
    for i in range(differences.size):
        bit = 0
        if specials:
            if not decoding:
                bit = 1 if marks[i & INDEX] else 0
            bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, _SPECIALS + recent)
            recent = (2 * recent + bit) & 3
            if bit:
                mark = 1
                while mark < specials:
                    if not decoding:
                        bit = 1 if marks[i & INDEX] > mark else 0
                    slot = _WHICH + mark
                    bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, slot)
                    if bit == 0:
                        break
                    mark += 1
                marks[i & INDEX] = mark
                differences[i & INDEX] = 0
                continue
        difference = 0 if decoding else int(differences[i & INDEX])
        line = int(lines[i & INDEX])
        entry = ((line * _SPREAD) >> 40) & (_ENTRIES - 1)
        if filled[entry & INDEX] and keys[entry & INDEX] == line:
            before = int(values[entry & INDEX])
            if not decoding:
                bit = 1 if difference == before else 0
            bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, _SAME)
            if bit:
                differences[i & INDEX] = before
                continue
            if not decoding:
                bit = 1 if before - _CLOSE <= difference < before + _CLOSE else 0
            bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, _CLOSE_TO)
            if bit:
                beside = difference - before + _CLOSE
                node = 1
                for step in range(4):
                    if not decoding:
                        bit = (beside >> (3 - step)) & 1
                    bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, _BESIDE + node)
                    node = 2 * node + bit
                difference = before - _CLOSE + (node & 15)
                differences[i & INDEX] = difference
                values[entry & INDEX] = difference
                continue
        limit = min(max(most - int(exponents[i & INDEX]), 0), 63)
        magnitude = abs(difference)
        length = 0 if decoding else _length(magnitude)
        count = limit
        while count > 0:
            if not decoding:
                bit = 1 if length < count else 0
            slot = 16 * min(limit, _DEEPEST) + min(limit - count, _DEEPEST)
            bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, slot)
            if bit == 0:
                break
            count -= 1
        if count:
            # What follows the first bit is stored: up to 32 bits at a time, highest first, and the sign at the end.
            value, rest = 1, count - 1
            while rest > 32:
                rest -= 32
                part, queue, queued, at = _store(decoding, (magnitude >> rest) & WIDEST, 32, queue, queued, at, stored)
                value = (value << 32) | part
            last = 2 * (magnitude & ((1 << rest) - 1)) + (1 if difference < 0 else 0)
            part, queue, queued, at = _store(decoding, last, rest + 1, queue, queued, at, stored)
            if decoding:
                value = (value << rest) | (part >> 1)
                difference = -value if part & 1 else value
        if decoding:
            differences[i & INDEX] = difference
        keys[entry & INDEX] = line
        values[entry & INDEX] = difference
        filled[entry & INDEX] = True
    if not decoding and queued:
        stored[at & INDEX] = queue & 255
        at += 1
    return place if decoding else finish(low, width, place, data), at
