"""What the lattice leaves out: the difference, bit pattern by bit pattern, that restores every original value.

The bit patterns of a dtype are put in the order of the numbers they stand for, so that close numbers differ little;
the differences, modulo the size of the type, are cut into bytes of equal weight and compressed.
"""

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import CorruptStreamError

__all__ = ["difference", "restore"]


def _ordered(values: NDArray[Any]) -> NDArray[Any]:
    """Bit patterns as unsigned integers in the order of the values; a copy."""
    unsigned = np.dtype(f"u{values.dtype.itemsize}")
    bits = values.view(unsigned).copy()
    if values.dtype.kind == "f":
        sign = unsigned.type(1 << (8 * values.dtype.itemsize - 1))
        negative = (bits & sign) != 0
        bits = np.where(negative, ~bits, bits | sign)
    return bits


def _from_ordered(bits: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    if dtype.kind == "f":
        sign = bits.dtype.type(1 << (8 * dtype.itemsize - 1))
        bits = np.where((bits & sign) != 0, bits & ~sign, ~bits)
    return bits.view(dtype)


def difference(original: NDArray[Any], restored: NDArray[Any]) -> bytes:
    """What turns ``restored`` into ``original`` (same shape and dtype); empty when they agree bit for bit."""
    unsigned = np.dtype(f"u{original.dtype.itemsize}")
    original, restored = np.ascontiguousarray(original), np.ascontiguousarray(restored)
    if np.array_equal(original.view(unsigned), restored.view(unsigned)):
        return b""
    delta = _ordered(original) - _ordered(restored)
    signed = delta.view(f"i{delta.dtype.itemsize}")
    bits = 8 * delta.dtype.itemsize
    folded = (delta << delta.dtype.type(1)) ^ (signed >> (bits - 1)).view(delta.dtype)
    planes = folded.astype(folded.dtype.newbyteorder("<")).reshape(-1, 1).view(np.uint8).T
    return zlib.compress(np.ascontiguousarray(planes).tobytes(), 6)


def restore(restored: NDArray[Any], payload: bytes, offset: int) -> NDArray[Any]:
    """Undo `difference`.

    Raises
    ------
    CorruptStreamError
        When the payload, which stands at ``offset`` of the container, does not hold one difference for each value.
    """
    expected = restored.size * restored.dtype.itemsize
    inflater = zlib.decompressobj()
    try:
        data = inflater.decompress(payload, expected + 1)
    except zlib.error as error:
        raise CorruptStreamError(f"the exactness section does not decompress: {error}", offset) from None
    if len(data) != expected:
        raise CorruptStreamError(f"expected {expected} bytes of exactness, got {len(data)} or more", offset)
    planes = np.frombuffer(data, np.uint8).reshape(restored.dtype.itemsize, -1)
    unsigned = np.dtype(f"<u{restored.dtype.itemsize}")
    folded = np.ascontiguousarray(planes.T).view(unsigned).ravel().astype(unsigned.newbyteorder("="))
    one = folded.dtype.type(1)
    delta = (folded >> one) ^ (~(folded & one) + one)
    bits = _ordered(np.ascontiguousarray(restored)).ravel() + delta
    return _from_ordered(bits, restored.dtype).reshape(restored.shape)


def encode_piece(original: NDArray[Any], restored: NDArray[Any]) -> bytes:
    """See `difference`."""
    return difference(original, restored)


def decode_piece(restored: NDArray[Any], data: bytes, offset: int) -> NDArray[Any]:
    """See `restore`."""
    return restore(restored, data, offset)
