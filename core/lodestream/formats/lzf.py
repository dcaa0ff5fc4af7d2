"""LZF, the compression of PCD files: back references of up to 264 bytes within the last 8 KiB.

Source: M. Lehmann, LibLZF 3.6, the format as ``lzf_d.c`` reads it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import FormatError
from ..numba_kernels import kernel
from .source import number

__all__ = ["decompress"]


def decompress(content: bytes, size: int) -> NDArray[np.uint8]:
    """Decompress bytes that are known to make `size` bytes.

    Raises
    ------
    FormatError
        When they make another number of bytes, or refer to bytes before the first.
    """
    target = np.empty(size, np.uint8)
    made = _decompress(np.frombuffer(content, np.uint8), target)
    if made != size:
        raise FormatError(f"expected LZF data that make {number(size)} bytes, got ones that are damaged or make others")
    return target


@kernel
def _decompress(source: NDArray[np.uint8], target: NDArray[np.uint8]) -> int:
    """Fill `target`; give the bytes made, or -1 where the data cannot be right."""
    place = made = 0
    while place < source.size:
        control = int(source[place])
        place += 1
        if control < 32:
            length = control + 1
            if place + length > source.size or made + length > target.size:
                return -1
            for offset in range(length):
                target[made + offset] = source[place + offset]
            place += length
            made += length
            continue
        length = control >> 5
        if length == 7:
            if place >= source.size:
                return -1
            length += int(source[place])
            place += 1
        if place >= source.size:
            return -1
        start = made - ((control & 31) << 8) - int(source[place]) - 1
        place += 1
        length += 2
        if start < 0 or made + length > target.size:
            return -1
        for offset in range(length):  # one by one: a reference may reach into what it makes
            target[made + offset] = target[start + offset]
        made += length
    return made
