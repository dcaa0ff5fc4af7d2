"""What plain files of the same size show: the beginning of an array, and an overview."""

from __future__ import annotations

import io
import zlib
from bisect import bisect_left

import numpy as np
from numpy.typing import NDArray

from .terrain import bilinear

__all__ = ["beginning", "overview"]


def beginning(heights: NDArray[np.int16], size: int) -> NDArray[np.float64]:
    """Return an array (H, W) from the first `size` bytes of its NPY file.

    Rows from the top, NaN where none have arrived.
    """
    whole = io.BytesIO()
    np.save(whole, heights)
    header = whole.tell() - heights.nbytes
    count = min(max(size - header, 0) // heights.itemsize, heights.size)
    shown = np.full(heights.size, np.nan)
    shown[:count] = heights.ravel()[:count]
    return shown.reshape(heights.shape)


def overview(heights: NDArray[np.int16], size: int) -> tuple[NDArray[np.float64], int]:
    """Return the finest overview that fits into `size` bytes, interpolated to the full grid, and its reduction factor.

    The heights are (H, W), and so is the result. An overview of factor f contains the rounded means of f x f points,
    stored like in a cloud-optimised GeoTIFF: differences along the rows, then deflate. File headers are not counted.
    Between the means the surface is interpolated bilinearly.
    """
    factors = range(1, max(heights.shape))
    factor = factors[bisect_left(factors, True, hi=len(factors) - 1, key=lambda it: _stored_size(heights, it) <= size)]
    means, centres = _means(heights, factor)
    places = [
        np.interp(np.arange(points), centre, np.arange(len(centre)))
        for points, centre in zip(heights.shape, centres, strict=True)
    ]
    grid = np.pad(means.astype(np.float64), ((0, 1), (0, 1)), mode="edge")  # two rows and columns at least
    return bilinear(grid, places[0][:, None], places[1]), factor


def _stored_size(heights: NDArray[np.int16], factor: int) -> int:
    means, _ = _means(heights, factor)
    return len(zlib.compress(np.diff(means, axis=1, prepend=np.int16(0)).tobytes()))


def _means(heights: NDArray[np.int16], factor: int) -> tuple[NDArray[np.int16], list[NDArray[np.float64]]]:
    # Blocks at the end may be smaller.
    values, centres = heights.astype(np.float64), []
    for axis, points in enumerate(heights.shape):
        starts = np.arange(0, points, factor)
        counts = np.minimum(factor, points - starts)
        sums = np.add.reduceat(values, starts, axis=axis)
        values = sums / (counts[:, None] if axis == 0 else counts)
        centres.append(starts + (counts - 1) / 2)
    return np.rint(values).astype(np.int16), centres
