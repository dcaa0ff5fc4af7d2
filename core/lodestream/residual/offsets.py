"""Values that lie on one lattice stretch by stretch, each stretch with an offset, as some compressors leave them.

LERC, for example, quantises blocks of 8 x 8 heights from the least of each. Such values are
float32(n step + offset) with a whole n, and the offset is usually that of an earlier value, most often of the last one.
An offset is known as an interval, which every value with this offset narrows. A list holds the most recent offsets,
the latest first.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import kernels

__all__ = ["MOST_BITS", "code_offsets", "have_offsets", "places_of", "values_at"]

#: Maximum bits of a difference from the lattice that is no offset in the list.
MOST_BITS = 34


def have_offsets(original: NDArray[Any], restored: NDArray[Any], step: float) -> bool:
    """Return whether most values, shape (value,), have the same distance from the lattice as the value before."""
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
    """Encode or decode the places of values, shape (value,), given those that a lattice of this step restores.

    Parameters
    ----------
    decoding : bool
        Read ``data`` and fill ``places`` rather than write.
    bits : int
        Bits of the differences from the restored places, with their signs; at most `MOST_BITS`.

    Returns
    -------
    int
        Bytes written, or looked at.
    """
    model = np.empty(kernels.OFFSETS_MODEL, np.int32)
    return kernels.offsets(decoding, _bases(restored, step), places_of(restored), bits, places, model, data)


def places_of(values: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the patterns of values of any shape as int64 in the order of the values."""
    signed = values.view(np.int32).astype(np.int64)
    return np.where(signed < 0, ~(signed & 0x7FFFFFFF), signed)


def values_at(places: NDArray[np.int64]) -> NDArray[np.float32]:
    """Map places of any shape, any int64, back to float32 values, the inverse of `places_of`."""
    inside = np.clip(places, -(2**31), 2**31 - 1)
    patterns = np.where(inside < 0, ~inside | 2**31, inside)
    return patterns.astype(np.uint32).view(np.float32)


def _bases(restored: NDArray[Any], step: float) -> NDArray[np.float64]:
    """Round restored values to the lattice of this step; float64, shape (value,)."""
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        return np.asarray(np.rint(restored.astype(np.float64) / step) * step)
