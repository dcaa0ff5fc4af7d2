"""Whether axes of a grid lie where its two-dimensional longitudes and latitudes say."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ...scratch import IN_MEMORY
from .names import is_angle
from .values import chosen, values_of

__all__ = ["are_elsewhere"]

#: Bytes of an array that is looked at in one piece, rather than some rows at a time.
_PIECE = 1 << 25

_TURN, _POLE = 360.0, 90.0 - 1e-6


class _Found(Protocol):
    @property
    def name(self) -> str: ...

    @property
    def axis(self) -> int | None: ...

    @property
    def dims(self) -> tuple[str, ...]: ...


def are_elsewhere(
    dataset: Any, vectors: tuple[_Found, _Found], arrays: tuple[_Found, _Found], index: Mapping[str, int]
) -> bool:
    """Return whether vectors of x and y are the same quantities as arrays, and more than half a cell away.

    Vectors in other units, such as those of a projection or of a rotated pole, are other quantities. The longitudes of
    a pole say nothing. A cell is as large as the steps of the vector on both of its sides.

    Parameters
    ----------
    dataset : Dataset of xarray
    vectors, arrays : (Found, Found)
        Those of x and of y: along one axis each, and over both.
    index : mapping of str to int
        Places along other dimensions.
    """
    variables = dataset.variables
    for vector, array in zip(vectors, arrays, strict=True):
        if not _comparable(vector.name, variables[vector.name].attrs, array.name, variables[array.name].attrs):
            return False
    lines = [
        values_of(chosen(variables[it.name], index), it.dims, IN_MEMORY).array.astype(np.float64) for it in vectors
    ]
    halves = [np.abs(np.gradient(line)) / 2 if len(line) > 1 else np.full(1, np.inf) for line in lines]
    planes = [chosen(variables[it.name], index) for it in arrays]
    dims = arrays[0].dims
    height = max(1, _PIECE // (dataset.sizes[dims[1]] * 8))
    for top in range(0, dataset.sizes[dims[0]], height):
        rows = slice(top, top + height)
        x, y = (values_of(it.isel({dims[0]: rows}), dims, IN_MEMORY).array.astype(np.float64) for it in planes)
        for plane, line, half, vector, turn in zip((x, y), lines, halves, vectors, (_TURN, None), strict=True):
            away = np.abs(plane - _along(line, vector, rows))
            if turn is not None and is_angle(variables[arrays[0].name].attrs):
                away = np.abs((away + turn / 2) % turn - turn / 2)
                away[np.abs(y) >= _POLE] = 0
            with np.errstate(invalid="ignore"):  # where an array has no value
                if (away > _along(half, vector, rows)).any():
                    return True
    return False


def _along(line: NDArray[Any], found: _Found, rows: slice) -> NDArray[Any]:
    """Return a vector as it lies over some rows, shape (row, 1) or (1, column)."""
    return line[rows, None] if found.axis == 0 else line[None, :]


def _comparable(vector: str, of_vector: Mapping[str, Any], array: str, of_array: Mapping[str, Any]) -> bool:
    """Return whether two coordinates may be the same quantity: both longitudes, or of one unit or of none."""
    if str(of_vector.get("standard_name", "")).lower().startswith(("grid_", "projection_")):
        return False
    unit = str(of_vector.get("units", "")).strip().lower()
    if unit in ("", "1", "count", "index", "level"):
        return True
    return is_angle(of_vector) == is_angle(of_array)
