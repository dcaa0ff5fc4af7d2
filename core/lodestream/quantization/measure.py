"""Distance of a reconstruction from the original, measured on the values that a caller receives."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["distances", "extent_of"]

_ROWS_PER_STRIP = 256  # rows compared together, so that temporaries stay small


def distances(original: NDArray[Any], reconstruction: NDArray[Any], geometric: int) -> tuple[float, float]:
    """Measure RMS and maximum distance between corresponding points.

    Parameters
    ----------
    original, reconstruction : array, shape (row, column) or (row, column, channel)
        The distance is that of the first ``geometric`` channels; of heights it is the difference.

    Returns
    -------
    (float, float)
        RMS and maximum, in the surface's unit.
    """
    total, worst = _squares(original, reconstruction, geometric, 1.0)
    unit = 1.0
    if not 1e-250 < worst < 1e250:
        # The squares are too small or too large for float64: measure in a unit of the differences' own size.
        unit = _largest(original, reconstruction, geometric)
        if unit == 0.0:
            return 0.0, 0.0
        total, worst = _squares(original, reconstruction, geometric, unit)
    return unit * math.sqrt(total / (original.shape[0] * original.shape[1])), unit * math.sqrt(worst)


def _squares(original: NDArray[Any], reconstruction: NDArray[Any], geometric: int, unit: float) -> tuple[float, float]:
    """Return sum and maximum of the squared distances, in a unit; infinite where they are too large."""
    total, worst = 0.0, 0.0
    for delta in _differences(original, reconstruction, geometric):
        if unit != 1.0:
            delta /= unit
        with np.errstate(over="ignore", under="ignore"):
            squares = delta * delta if delta.ndim == 2 else np.einsum("ijk,ijk->ij", delta, delta)
            total += float(squares.sum())
        worst = max(worst, float(squares.max()))
    return total, worst


def _largest(original: NDArray[Any], reconstruction: NDArray[Any], geometric: int) -> float:
    """Return the largest magnitude of a difference."""
    return max(float(np.abs(delta).max()) for delta in _differences(original, reconstruction, geometric))


def _differences(original: NDArray[Any], reconstruction: NDArray[Any], geometric: int) -> Iterator[NDArray[np.float64]]:
    """Yield the differences strip by strip, float64, shape (row, column) or (row, column, channel)."""
    for start in range(0, original.shape[0], _ROWS_PER_STRIP):
        a, b = original[start : start + _ROWS_PER_STRIP], reconstruction[start : start + _ROWS_PER_STRIP]
        if a.ndim == 3:
            a, b = a[..., :geometric], b[..., :geometric]
        yield _difference(a, b)


def _difference(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.float64]:
    """Return a - b in float64; its magnitude if both are integers of 64 bits."""
    if a.dtype.kind in "iu" and a.dtype.itemsize == 8:
        # Neighbours beyond 2**53 are the same float64: subtract before converting.
        larger = a >= b
        wide: NDArray[np.float64] = np.where(larger, a - b, b - a).astype(np.uint64).astype(np.float64)
        return wide
    delta: NDArray[np.float64] = a.astype(np.float64) - b.astype(np.float64)
    return delta


def extent_of(points: NDArray[Any], geometric: int) -> float:
    """Return the range of heights, (row, column), or the diagonal of the box of points, (row, column, channel)."""
    if points.ndim == 2:
        return float(points.max()) - float(points.min())
    flat = points[..., :geometric].reshape(-1, geometric)
    sides = (float(high) - float(low) for low, high in zip(flat.min(axis=0), flat.max(axis=0), strict=True))
    return math.hypot(*sides)
