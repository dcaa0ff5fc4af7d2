"""LZF, the compression of PCD files: back references of up to 264 bytes within the last 8 KiB.

Source: M. Lehmann, LibLZF 3.6, the format as ``lzf_d.c`` reads it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ... import kernels
from ...errors import FormatError
from ..source import number

__all__ = ["decompress"]

#: Bytes that one call of the kernel makes.
_AT_ONCE = 1 << 22


def decompress(content: bytes, size: int) -> NDArray[np.uint8]:
    """Decompress bytes to exactly `size` bytes: uint8, shape (size,).

    Raises
    ------
    FormatError
        When they make another number of bytes, or refer to bytes before the first.
    """
    source, target, state = np.frombuffer(content, np.uint8), np.empty(size, np.uint8), np.zeros(2, np.int64)
    right = True
    while right and state[0] < source.size:
        right = bool(kernels.lzf(source, target, _AT_ONCE, state))
    if not right or state[1] != size:
        raise FormatError(f"expected LZF data that make {number(size)} bytes, got ones that are damaged or make others")
    return target
