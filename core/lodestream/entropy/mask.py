"""Lossless coding of the mask of a surface with holes: each point in the context of the points before it.

Points are coded in raster order, each in the context of the ten nearest points before it. Where all that surrounds a
group of sixteen points in a row is equal, one bit says whether they are equal to that too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from ..errors import CorruptStreamError

__all__ = ["decode_mask", "encode_mask"]

#: Points outside the mask that contexts see: above, and at either side.
_ROWS_ABOVE = 2
_COLUMNS_BESIDE = 2
#: Groups of points in one call of the kernel.
_GROUPS_PER_CALL = 1 << 16


def encode_mask(mask: NDArray[np.bool_]) -> bytes:
    """Code a mask without loss.

    Parameters
    ----------
    mask : bool, shape (row, column)
        True where a point is valid.

    Returns
    -------
    bytes
        At least one.
    """
    rows, columns = mask.shape
    field = _field(rows, columns)
    field[_ROWS_ABOVE:, _COLUMNS_BESIDE : _COLUMNS_BESIDE + columns] = mask
    # A point takes at most 11 bits (a probability of 32 / 2**16), and a group of them one bit before.
    data = np.empty(64 + 2 * mask.size, np.uint8)
    length = _code(False, rows, columns, field, data)
    return data[:length].tobytes()


def decode_mask(data: bytes, shape: tuple[int, int], offset: int) -> NDArray[np.bool_]:
    """Decode the data of `encode_mask`; memory is a byte for each point of ``shape``, whatever the data.

    Raises
    ------
    CorruptStreamError
        When bytes are left over; the data begin at ``offset`` of the container. Missing bytes count as 0.
    """
    rows, columns = shape
    field = _field(rows, columns)
    read = _code(True, rows, columns, field, np.frombuffer(data, np.uint8).copy())
    if len(data) > read:
        raise CorruptStreamError(f"expected a mask of at most {read} bytes, got {len(data)}", offset + read)
    return field[_ROWS_ABOVE:, _COLUMNS_BESIDE : _COLUMNS_BESIDE + columns].astype(np.bool_)


def _field(rows: int, columns: int) -> NDArray[np.uint8]:
    """Allocate the points of a mask with margins for contexts: uint8, shape (rows + 2, columns + 4)."""
    return np.zeros((rows + _ROWS_ABOVE, columns + 2 * _COLUMNS_BESIDE), np.uint8)


def _code(reading: bool, rows: int, columns: int, field: NDArray[np.uint8], data: NDArray[np.uint8]) -> int:
    """Code all points of the field; return the number of bytes written, or read."""
    model, state = np.empty(kernels.MASK_MODEL, np.int32), np.zeros(4, np.int64)
    groups = rows * -(-columns // kernels.MASK_GROUP)
    length = 0
    for first in range(0, groups, _GROUPS_PER_CALL):
        last = min(first + _GROUPS_PER_CALL, groups)
        length = kernels.mask(reading, rows, columns, first, last, field, model, data, state)
    return length
