"""The SHA-256 of a surface's values, with which a receiver checks that it has decoded them all correctly."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..surface import Block

__all__ = ["DIGEST", "ValuesDigest", "values_digest"]

#: Its key in a container's metadata.
DIGEST = "values_sha256"


class ValuesDigest:
    """The SHA-256 of all values, which may be taken some rows at a time.

    Values are hashed in C order, little-endian, in their own types: block by block the points, then each attribute.
    Holes are hashed with the values that they have in decoded `Block` objects.
    """

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def take(self, rows: NDArray[Any]) -> None:
        """Hash the next rows of an array, shape (row, column) or (row, column, component), or all of them."""
        self._hash.update(np.ascontiguousarray(rows.astype(rows.dtype.newbyteorder("<"), copy=False)).data)

    def hexdigest(self) -> str:
        """Return the SHA-256 of what was taken, in hexadecimal digits."""
        return self._hash.hexdigest()


def values_digest(blocks: Iterable[Block]) -> str:
    """Compute the SHA-256 of all values of decoded blocks, in hexadecimal digits, see `ValuesDigest`."""
    digest = ValuesDigest()
    for block in blocks:
        for array in (block.points, *block.attributes.values()):
            digest.take(array)
    return digest.hexdigest()
