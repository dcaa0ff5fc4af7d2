"""Values that lie on one lattice piece by piece, each piece with an offset of its own, as some compressors leave them.

LERC, for one, quantises blocks of 8 x 8 heights from the least of each. Such values are float32(n step + offset) with
a whole n, and the offset is that of a value before, more often than not of the last one. What is known of an offset is
an interval, and every value that has it narrows it. A list holds the offsets met last, the latest first.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .binary_coder import INDEX, UNKNOWN, WIDEST, code_bit, finish, start
from .numba_kernels import inlined, strict_kernel

__all__ = ["MOST_BITS", "code_offsets", "have_offsets", "places_of", "values_at"]

#: Bits of a difference from the lattice that is no offset in the list.
MOST_BITS = 34
_LISTED = 64
#: An offset in the list gives a value to within so many places.
_CLOSE = 4
# Contexts: is it the first of the list, by how many in turn were; is it in the list; which; how far off; new ones.
_REST = 16
_WHICH = _REST + 1
_OFF = _WHICH + _LISTED
_NEW = _OFF + 2 * 8
_CONTEXTS = _NEW + 16 + MOST_BITS
#: Pattern of the largest float32.
_LARGEST = 0x7F7FFFFF


def have_offsets(original: NDArray[Any], restored: NDArray[Any], step: float) -> bool:
    """Whether most of the values, shape (value,), are off the lattice of this step by as much as the one before."""
    if original.dtype != np.float32 or not np.isfinite(step) or step <= 0 or original.size < 2:
        return False
    off = original.astype(np.float64) - _bases(restored, step)
    tolerance = 4 * float(np.spacing(np.abs(original).max()))
    return step > 16 * tolerance and 2 * int((np.abs(np.diff(off)) <= tolerance).sum()) > off.size


def code_offsets(
    decoding: bool,
    restored: NDArray[np.float32],
    step: float,
    bits: int,
    places: NDArray[np.int64],
    data: NDArray[np.uint8],
) -> int:
    """Code the places of values, shape (value,), given those that a lattice of this step restores.

    Parameters
    ----------
    decoding : bool
        Read ``data`` and fill ``places`` rather than write.
    bits : int
        Of the differences from the restored places, with their signs; at most `MOST_BITS`.

    Returns
    -------
    int
        Bytes written, or looked at.
    """
    model = np.full(_CONTEXTS, UNKNOWN, np.int32)
    return int(_code(decoding, _bases(restored, step), places_of(restored), bits, places, model, data))


def places_of(values: NDArray[np.float32]) -> NDArray[np.int64]:
    """Patterns as whole numbers in the order of the values."""
    signed = values.view(np.int32).astype(np.int64)
    return np.where(signed < 0, ~(signed & 0x7FFFFFFF), signed)


def values_at(places: NDArray[np.int64]) -> NDArray[np.float32]:
    """Undo `places_of`; places may be any numbers."""
    inside = np.clip(places, -(2**31), 2**31 - 1)
    patterns = np.where(inside < 0, ~inside | 2**31, inside)
    return patterns.astype(np.uint32).view(np.float32)


def _bases(restored: NDArray[Any], step: float) -> NDArray[np.float64]:
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        return np.asarray(np.rint(restored.astype(np.float64) / step) * step)


# A view of one number as another type would be shorter, but the compiler takes the two for different memory.


@inlined
def _place(value: float) -> int:
    """The place of the nearest float32."""
    single = float(np.float32(value))
    if not abs(single) < np.inf:
        return _LARGEST
    mantissa, exponent = math.frexp(abs(single))
    place = int(math.ldexp(abs(single), 149)) if exponent < -125 else ((exponent + 125) << 23) + int(mantissa * 2.0**24)
    return ~place if math.copysign(1.0, single) < 0.0 else place


@inlined
def _value(place: int) -> float:
    """The float32 at a place, as float64; beyond the largest one, that with its sign."""
    pattern = min(place if place >= 0 else ~place, _LARGEST)
    exponent, mantissa = pattern >> 23, pattern & 0x7FFFFF
    value = (
        math.ldexp(float(mantissa), -149) if exponent == 0 else math.ldexp(float(mantissa + 0x800000), exponent - 150)
    )
    return value if place >= 0 else -value


@strict_kernel
def _code(
    decoding: bool,
    bases: NDArray[np.float64],
    restored: NDArray[np.int64],
    bits: int,
    places: NDArray[np.int64],
    model: NDArray[np.int32],
    data: NDArray[np.uint8],
) -> int:
    width = WIDEST
    low, place = (start(data), 4) if decoding else (0, 0)
    least, most = np.zeros(_LISTED), np.zeros(_LISTED)
    listed, recent = 0, 0
    for i in range(bases.size):
        base, bit = bases[i & INDEX], 0
        own = 0 if decoding else int(places[i & INDEX])
        rank, difference = listed, 0
        if not decoding:
            for k in range(listed):
                difference = own - _place(base + 0.5 * (least[k] + most[k]))
                if -_CLOSE <= difference < _CLOSE:
                    rank = k
                    break
        if listed:
            bit = 1 if rank == 0 else 0
            bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, recent)
            recent = min(recent + 1, 15) if bit else 0
            if bit:
                rank = 0
            else:
                bit = 1 if rank < listed else 0
                bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, _REST)
                if bit:
                    node, number = 1, rank
                    for step in range(6):
                        bit = (number >> (5 - step)) & 1
                        bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, _WHICH + node)
                        node = 2 * node + bit
                    rank = min(node & 63, listed - 1)
                else:
                    rank = listed
        if rank < listed:
            expected = _place(base + 0.5 * (least[rank] + most[rank]))
            node, number = 1, difference + _CLOSE
            for step in range(3):
                bit = (number >> (2 - step)) & 1
                slot = _OFF + (8 if rank else 0) + node
                bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, slot)
                node = 2 * node + bit
            own = expected + (node & 7) - _CLOSE
        else:
            node, number = 1, own - int(restored[i & INDEX]) + (1 << bits >> 1)
            value = 0
            for step in range(bits):
                bit = (number >> (bits - 1 - step)) & 1
                slot = _NEW + (node if step < 4 else 12 + step)
                bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, slot)
                node = 2 * node + bit if step < 4 else node
                value = 2 * value + bit
            own = int(restored[i & INDEX]) + value - (1 << bits >> 1)
        places[i & INDEX] = own
        # Any offset between the midpoints to the neighbouring floats gives this value.
        near = _value(own)
        bottom = 0.5 * (near + _value(own - 1)) - base
        top = 0.5 * (near + _value(own + 1)) - base
        if rank < listed:
            bottom, top = max(bottom, least[rank]), min(top, most[rank])
            if bottom > top:
                bottom, top = near - base, near - base
        else:
            listed = min(listed + 1, _LISTED)
            rank = listed - 1
        for k in range(rank, 0, -1):
            least[k], most[k] = least[k - 1], most[k - 1]
        least[0], most[0] = bottom, top
    return place if decoding else finish(low, width, place, data)
