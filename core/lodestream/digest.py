"""The fingerprint of a surface's values, by which a receiver knows that it has just these."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable

import numpy as np

from .surface import Block

__all__ = ["DIGEST", "values_digest"]

#: Its key in a container's metadata.
DIGEST = "values_sha256"


def values_digest(blocks: Iterable[Block]) -> str:
    """SHA-256, in hexadecimal digits, of all values.

    They are taken in C order and little-endian, in their own types: block by block the points, then each attribute.
    Holes have the values that `Block`s out of a container have there.
    """
    digest = hashlib.sha256()
    for block in blocks:
        for array in (block.points, *block.attributes.values()):
            little = array.astype(array.dtype.newbyteorder("<"), copy=False)
            digest.update(np.ascontiguousarray(little).data)
    return digest.hexdigest()
