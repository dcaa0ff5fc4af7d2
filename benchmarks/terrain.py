"""Terrain-like heights of any size in a file, made strip by strip."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .arrays import fractal

__all__ = ["write_terrain"]

#: Points along a side of the detail that is repeated, mirrored, and of the shape of the whole.
_DETAIL, _SHAPE = 4097, 257
_STRIP = 256


def write_terrain(path: Path, side: int) -> None:
    """Write square heights into an NPY file, int16, shape (side, side).

    Detail of 4097 x 4097 points, mirrored again and again, lies on a shape that is not repeated.
    """
    detail = fractal(min(_DETAIL, side | 1), rounded=False)
    detail = (detail / detail.max() * 8000).astype(np.float32)
    shape = fractal(_SHAPE, rounded=False)
    shape = (shape / shape.max() * 20000).astype(np.float32)
    out = np.lib.format.open_memmap(path, "w+", np.int16, (side, side))
    across = _mirrored(np.arange(side), len(detail))
    columns = np.linspace(0, _SHAPE - 1, side)
    for start in range(0, side, _STRIP):
        rows = np.arange(start, min(start + _STRIP, side))
        own = detail[_mirrored(rows, len(detail))][:, across]
        out[rows[0] : rows[-1] + 1] = np.rint(own + _between(shape, rows * (_SHAPE - 1) / max(side - 1, 1), columns))
    out.flush()


def _mirrored(places: NDArray[np.int64], length: int) -> NDArray[np.int64]:
    within = places % (2 * length - 2)
    return np.minimum(within, 2 * length - 2 - within)


def _between(
    shape: NDArray[np.float32], rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Heights between those of a coarse grid, in straight lines."""
    top, left = np.minimum(rows.astype(int), len(shape) - 2), np.minimum(columns.astype(int), len(shape) - 2)
    down = (rows - top)[:, None].astype(np.float32)
    right = (columns - left)[None, :].astype(np.float32)
    above = shape[top][:, left] * (1 - right) + shape[top][:, left + 1] * right
    below = shape[top + 1][:, left] * (1 - right) + shape[top + 1][:, left + 1] * right
    between: NDArray[np.float32] = above * (1 - down) + below * down
    return between
