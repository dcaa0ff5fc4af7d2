"""The SHA-256 of a surface's values, with which a receiver checks that it has decoded them all correctly."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np

from ..surface import Block

__all__ = ["DIGEST", "values_digest"]

#: Its key in a container's metadata.
DIGEST = "values_sha256"


def values_digest(blocks: Iterable[Block]) -> str:
    """SHA-256 of all values, in hexadecimal digits.

    Values are hashed in C order, little-endian, in their own types: block by block the points, then each attribute.
    Holes count with the values that they have in decoded `Block` objects.
    """
    digest = hashlib.sha256()
    for block in blocks:
        for array in (block.points, *block.attributes.values()):
            little = array.astype(array.dtype.newbyteorder("<"), copy=False)
            digest.update(np.ascontiguousarray(little).data)
    return digest.hexdigest()
