"""Coding of differences on a line of whole numbers: nearly uniform noise whose width is known beforehand.

The width follows from the lattice's step and the value's exponent. So the bits that a difference takes are counted
down from the most that the exponent of the restored value allows, in contexts; the bits themselves and the sign are
stored as they are. If the place on the line has occurred before, its last difference predicts this one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import kernels

__all__ = ["code_differences", "most_bits"]

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
    """Encode or decode differences of values, shape (value,), from their places on the line that a lattice restores.

    Parameters
    ----------
    decoding : bool
        Read ``data`` and ``stored``, and fill ``differences`` and ``marks``, rather than write.
    differences : int64 array of shape (value,)
        All above -2**63, whose magnitude has too many bits.
    line, exponents
        Of the restored values, as `number_line.to_line` gives them.
    marks : uint8 array of shape (value,)
        For values that are on no line their number in the chunk's list, from 1; else 0.
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
    model = np.empty(kernels.DIFFERENCES_MODEL, np.int32)
    memory = np.empty((kernels.DIFFERENCES_MEMORY, 3), np.int64)
    used = np.empty(2, np.int64)
    of_values = line, differences, exponents, marks
    kernels.differences(decoding, *of_values, most, specials, model, memory, data, stored, used)
    return int(used[0]), int(used[1])


def most_bits(differences: _Ints, exponents: NDArray[np.int32], marks: NDArray[np.uint8]) -> int:
    """Return the largest sum of a difference's bits and its exponent, of values without a mark; all (value,)."""
    return kernels.most_bits(differences, exponents, marks)
