"""The SHA-256 of a surface's values, with which a receiver checks that it has decoded them all correctly."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..surface import Block

__all__ = ["DIGEST", "little_endian", "values_digest"]

#: Its key in a container's metadata.
DIGEST = "values_sha256"


def values_digest(blocks: Iterable[Block]) -> str:
    """Compute the SHA-256 of all values, in hexadecimal digits.

    Values are hashed in C order, little-endian, in their own types: block by block the points, then each attribute.
    Holes are hashed with the values that they have in decoded `Block` objects.
    """
    digest = hashlib.sha256()
    for block in blocks:
        for array in (block.points, *block.attributes.values()):
            digest.update(little_endian(array))
    return digest.hexdigest()


def little_endian(array: NDArray[Any]) -> memoryview:
    """Return the bytes of an array, of any shape, that are hashed."""
    return np.ascontiguousarray(array.astype(array.dtype.newbyteorder("<"), copy=False)).data
