"""The mask of a surface with holes, without loss: each point in the context of those before it.

Points are coded in raster order, each by the mean of two models in the logistic domain (`binary_coder`): one that sees
the ten nearest points before it and adapts fast, and one that sees sixteen and distinguishes more. Where all that
surrounds a group of sixteen points in a row is equal, one bit says whether they are equal to that too.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .binary_coder import INDEX, UNKNOWN, WEIGHT, WIDEST, code_bit, code_mixed_bit, finish, start
from .errors import CorruptStreamError
from .kernels import kernel

__all__ = ["decode_mask", "encode_mask"]

_GROUP = 16
#: Points outside the mask that contexts see: above, and at either side.
_ABOVE = 2
_BESIDE = 3
_NEAR = 1 << 16  # first of the contexts that see ten points
_GROUPS = _NEAR + (1 << 10)  # first of those of groups: by their surroundings and the last group's answer
_WEIGHTS = _GROUPS + 4


def encode_mask(mask: NDArray[np.bool_]) -> bytes:
    """Code a mask.

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
    field[_ABOVE:, _BESIDE : _BESIDE + columns] = mask
    # A point takes at most 11 bits (a probability of 32 / 2**16), and a group of them one bit before.
    data = np.empty(64 + 2 * mask.size, np.uint8)
    length = _code(False, rows, columns, field.ravel(), field.shape[1], _model(), data)
    return data[:length].tobytes()


def decode_mask(data: bytes, shape: tuple[int, int], offset: int) -> NDArray[np.bool_]:
    """Undo `encode_mask`; takes a byte of memory for each point of ``shape`` whatever the data.

    Raises
    ------
    CorruptStreamError
        When bytes are left over; the data stand at ``offset`` of the container. Bytes missing count as 0.
    """
    rows, columns = shape
    field = _field(rows, columns)
    read = _code(True, rows, columns, field.ravel(), field.shape[1], _model(), np.frombuffer(data, np.uint8).copy())
    if len(data) > read:
        raise CorruptStreamError(f"expected a mask of at most {read} bytes, got {len(data)}", offset + read)
    return field[_ABOVE:, _BESIDE : _BESIDE + columns].astype(np.bool_)


def _field(rows: int, columns: int) -> NDArray[np.uint8]:
    return np.zeros((rows + _ABOVE, columns + 2 * _BESIDE), np.uint8)


def _model() -> NDArray[np.int32]:
    model = np.full(_WEIGHTS + 2, UNKNOWN, np.int32)
    model[_WEIGHTS:] = WEIGHT
    return model


@kernel
def _code(
    decoding: bool,
    rows: int,
    columns: int,
    field: NDArray[np.uint8],
    stride: int,
    model: NDArray[np.int32],
    data: NDArray[np.uint8],
) -> int:
    """Code all points of the flat ``field`` (with its margins); returns the bytes written, or those looked at."""
    width = WIDEST
    low, place = (start(data), 4) if decoding else (0, 0)
    last = 0
    for row in range(rows):
        first = (row + _ABOVE) * stride + _BESIDE
        for left in range(0, columns, _GROUP):
            count = min(_GROUP, columns - left)
            at = first + left
            around = int(field[(at - 1) & INDEX])
            surrounded = around
            for j in range(at - 2, at + count + 2):
                above = int(field[(j - stride) & INDEX]) + int(field[(j - 2 * stride) & INDEX])
                surrounded += above
            surrounded += int(field[(at - 2) & INDEX])
            bit = 0
            if surrounded == 0 or surrounded == 2 * (count + 4) + 2:
                if not decoding:
                    bit = 1
                    for j in range(at, at + count):
                        if int(field[j & INDEX]) != around:
                            bit = 0
                            break
                slot = _GROUPS + 2 * around + last
                bit, low, width, place = code_bit(decoding, bit, low, width, place, data, model, slot)
                last = bit
            if bit:
                if decoding:
                    for j in range(at, at + count):
                        field[j & INDEX] = around
                continue
            # Seven points of the row above and five of the one above that move on with the point.
            up, far = at - stride, at - 2 * stride
            above, further, before = 0, 0, 0
            for j in range(-3, 3):
                above = 2 * above + int(field[(up + j) & INDEX])
            for j in range(-2, 2):
                further = 2 * further + int(field[(far + j) & INDEX])
            for j in range(-4, 0):
                before = 2 * before + int(field[(at + j) & INDEX])
            for j in range(count):
                above = ((above << 1) | int(field[(up + j + 3) & INDEX])) & 127
                further = ((further << 1) | int(field[(far + j + 2) & INDEX])) & 31
                wide = (further << 11) | (above << 4) | before
                near = _NEAR + ((((further >> 1) & 7) << 7) | (((above >> 1) & 31) << 2) | (before & 3))
                if not decoding:
                    bit = int(field[(at + j) & INDEX])
                bit, low, width, place = code_mixed_bit(
                    decoding, bit, low, width, place, data, model, wide, near, _WEIGHTS
                )
                if decoding:
                    field[(at + j) & INDEX] = bit
                before = ((before << 1) | bit) & 15
    return place if decoding else finish(low, width, place, data)
