"""Values as places on a line of whole numbers, in the order of the values.

By the rule of patterns these are their bit patterns, less the zeros at the end that all patterns of a chunk have; by
the rule of decimals, their number of units of so many decimal places.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["DECIMALS", "MOST_DECIMALS", "PATTERNS", "common_zeros", "decimal_places", "from_line", "to_line"]

#: The rules, as a chunk of residual names them; their arguments are how many zeros, and how many decimal places.
PATTERNS, DECIMALS = 1, 2
MOST_DECIMALS = 15
_MAX_WHOLE_NUMBER = 2.0**53
_SAMPLE_VALUES = 64
_POWERS = np.array([10.0**places for places in range(MOST_DECIMALS + 1)])

_Ints = NDArray[np.int64]


def to_line(rule: int, argument: int, values: NDArray[Any]) -> tuple[_Ints, NDArray[np.int32]]:
    """Map finite values, shape (value,), to their places on the line.

    Returns
    -------
    places : int64 array of shape (value,)
    exponents : int32 array of shape (value,)
        Of the values, biased; 0 where places are of one width, whatever the value.
    """
    bits = 8 * values.dtype.itemsize
    if rule == DECIMALS:
        with np.errstate(over="ignore"):
            wide = np.clip(values.astype(np.float64) * 10.0**argument, -_MAX_WHOLE_NUMBER, _MAX_WHOLE_NUMBER)
        return np.rint(wide).astype(np.int64), np.zeros(values.size, np.int32)
    if values.dtype.kind != "f":
        return values.astype(np.int64) >> argument, np.zeros(values.size, np.int32)
    signed = values.view(f"i{values.dtype.itemsize}").astype(np.int64)
    magnitudes = signed & ((1 << (bits - 1)) - 1)
    exponents = (magnitudes >> (23 if bits == 32 else 52)).astype(np.int32)
    magnitudes >>= argument
    # Below -0.0, whose place is -1, patterns of negative floats run downwards: neighbours on the line differ by one.
    return np.where(signed < 0, ~magnitudes, magnitudes), exponents


def from_line(rule: int, argument: int, places: _Ints, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Map places, any int64, back to values of ``dtype``, shape (value,), the inverse of `to_line`."""
    if rule == DECIMALS:
        # A hostile chunk may name any place; honest ones are whole numbers that float64 holds.
        units = np.clip(places, -(2**53), 2**53).astype(np.float64)
        with np.errstate(over="ignore"):
            return np.asarray((units / 10.0**argument).astype(dtype))
    if dtype.kind != "f":
        return (places << argument).astype(dtype)
    signed = np.where(places < 0, ~places, places) << argument
    top = np.int64(-(2**63)) if dtype.itemsize == 8 else np.int64(2**31)
    signed = np.where(places < 0, signed | top, signed)
    return signed.astype(f"u{dtype.itemsize}").view(dtype)


def common_zeros(values: NDArray[Any]) -> int:
    """Count trailing bits that are 0 in the patterns of all values, shape (value,): the argument of `PATTERNS`."""
    if not values.size:
        return 0
    bits = 8 * values.dtype.itemsize
    seen = int(np.bitwise_or.reduce(values.view(f"u{values.dtype.itemsize}")))
    zeros = (seen & -seen).bit_length() - 1 if seen else 0
    # The exponents are not shortened, so that contexts can use them.
    return min(zeros, 23 if bits == 32 else 52) if values.dtype.kind == "f" else min(zeros, bits - 1)


def decimal_places(values: NDArray[Any]) -> int | None:
    """Return the fewest decimal places that give all values, shape (value,), bit for bit; None if there are none."""
    if values.dtype.kind != "f" or not values.size:
        return None
    places = np.arange(MOST_DECIMALS + 1)
    # Most floats fail within a few values: all scales are tried on a sample, and all values with the first that holds.
    exact = places[_are_decimals(values[:: max(1, values.size // _SAMPLE_VALUES)], places)]
    return int(exact[0]) if exact.size and _are_decimals(values, exact[:1])[0] else None


def _are_decimals(values: NDArray[Any], places: _Ints) -> NDArray[np.bool_]:
    """Test whether each number of decimal places gives all of the values; bool, shape of ``places``."""
    scales = _POWERS[places, np.newaxis]
    unsigned = f"u{values.dtype.itemsize}"
    with np.errstate(over="ignore"):
        units = np.rint(np.clip(values.astype(np.float64) * scales, -_MAX_WHOLE_NUMBER, _MAX_WHOLE_NUMBER))
        # A zero without its sign, as a whole number has none.
        again = ((units + 0.0) / scales).astype(values.dtype)
    return np.asarray((again.view(unsigned) == values.view(unsigned)).all(axis=1))
