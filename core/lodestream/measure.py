"""How far a picture is from the original: measured on the values as they are handed out."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["distances", "extent_of"]

_ROWS = 256  # rows compared at a time, so that what is in between stays small


def distances(original: NDArray[Any], picture: NDArray[Any], geometric: int) -> tuple[float, float]:
    """RMS and maximum distance between corresponding points.

    Parameters
    ----------
    original, picture : array, shape (row, column) or (row, column, channel)
        The distance is that of the first ``geometric`` channels; of heights it is the difference.

    Returns
    -------
    (float, float)
        In the surface's unit.
    """
    total, worst = 0.0, 0.0
    for start in range(0, original.shape[0], _ROWS):
        a, b = original[start : start + _ROWS], picture[start : start + _ROWS]
        if a.ndim == 3:
            a, b = a[..., :geometric], b[..., :geometric]
        delta = _difference(a, b)
        squares = delta * delta if delta.ndim == 2 else np.einsum("ijk,ijk->ij", delta, delta)
        total += float(squares.sum())
        worst = max(worst, float(squares.max()))
    return math.sqrt(total / (original.shape[0] * original.shape[1])), math.sqrt(worst)


def _difference(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.float64]:
    if a.dtype.kind in "iu" and a.dtype.itemsize == 8:
        # Neighbours beyond 2**53 are the same float64: subtract before converting.
        larger = a >= b
        wide: NDArray[np.float64] = np.where(larger, a - b, b - a).astype(np.uint64).astype(np.float64)
        return wide
    delta: NDArray[np.float64] = a.astype(np.float64) - b.astype(np.float64)
    return delta


def extent_of(points: NDArray[Any], geometric: int) -> float:
    """Range of heights, or diagonal of the box of the points."""
    if points.ndim == 2:
        return float(points.max()) - float(points.min())
    flat = points[..., :geometric].reshape(-1, geometric)
    sides = flat.max(axis=0).astype(np.float64) - flat.min(axis=0).astype(np.float64)
    return float(np.sqrt((sides * sides).sum()))
