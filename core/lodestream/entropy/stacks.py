"""Arrays of grids that lie in one piece, for one call of a kernel: blocks of a surface may be many and small."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

__all__ = ["Stacks"]

_Array = NDArray[np.int32]


class Stacks:
    """Arrays of coefficients, of which those of one width that follow each other in memory are one plane.

    Parameters
    ----------
    origins : int64, shape (band, 3)
        Of each band of a table: its tile, and its first row and column in the array of its grid.
    of_grid : int64, shape (band,), one for each grid
        The numbers of its bands.
    arrays : int32 arrays, shape (row, column), one for each grid; None of grids that are passed over

    Attributes
    ----------
    planes : list of int32, shape (row, column), and int64, shape (band,)
        Each plane, and the numbers of its bands in the table, in order.
    origins : int64, shape (band, 3)
        The same in its plane.
    """

    def __init__(
        self, origins: NDArray[np.int64], of_grid: Sequence[NDArray[np.int64]], arrays: Sequence[_Array | None]
    ) -> None:
        self.planes: list[tuple[_Array, NDArray[np.int64]]] = []
        self.origins = origins
        stack: list[_Array] = []
        bands: list[NDArray[np.int64]] = []
        for array, numbers in zip(arrays, of_grid, strict=True):
            if array is None:
                continue
            rows = _rows_between(stack[0], array) if stack else None
            if rows is None or rows < _height(stack):
                self._add(stack, bands)
                stack, bands = [], []
            elif len(numbers):
                if self.origins is origins:
                    self.origins = origins.copy()
                self.origins[numbers, 1] += rows
            stack.append(array)
            bands.append(numbers)
        self._add(stack, bands)

    def _add(self, stack: list[_Array], bands: list[NDArray[np.int64]]) -> None:
        """Take the arrays of a stack for one plane."""
        if len(stack) == 1:
            self.planes.append((stack[0], bands[0]))
        elif stack:
            shape = _height(stack), stack[0].shape[1]
            plane = np.lib.stride_tricks.as_strided(stack[0], shape, stack[0].strides)
            self.planes.append((plane, np.sort(np.concatenate(bands))))


def _height(stack: list[_Array]) -> int:
    """Return the rows from the first array of a stack to the end of its last one."""
    last = _rows_between(stack[0], stack[-1])
    assert last is not None
    return last + len(stack[-1])


def _rows_between(first: _Array, other: _Array) -> int | None:
    """Return how many rows after the first row of ``first`` that of another array begins; None if none does."""
    alike = first.base is not None and other.base is first.base and other.strides == first.strides
    if other is not first and not (alike and other.shape[1] == first.shape[1] and first.strides[0] > 0):
        return None
    rows, rest = divmod(_address(other) - _address(first), first.strides[0] or 1)
    return None if rest else rows


def _address(array: _Array) -> int:
    """Return the address of an array's first element."""
    address: int = array.__array_interface__["data"][0]
    return address
