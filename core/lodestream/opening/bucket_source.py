"""A container in a bucket, read in the blocks of its store."""

from __future__ import annotations

import hashlib
from typing import Any

from ..errors import InputError
from ..stores import open_store
from ..stores.connections import SCHEMES, parsed
from .byte_sources import AT_ONCE

__all__ = ["BucketSource"]

#: Bytes at the end of a container, by which it is told from another: the check of its index is among them.
_END = 4096


class BucketSource:
    """A container in a bucket; credentials, region and endpoint come from the environment, see `stores.open_store`.

    Parameters
    ----------
    address : str
        Of the object, such as ``s3://bucket/prefix/name.lode``.

    Raises
    ------
    InputError
        If it is no such address.
    UnavailableError
        If the library for buckets is not installed.
    AbsentError
        If there is no such object.
    StoreError
        If the bucket cannot be read.
    """

    def __init__(self, address: str) -> None:
        folder, _, key = address.rpartition("/")
        if not key or folder.endswith(":/"):
            example = f"{SCHEMES[parsed(address).scheme]}/NAME.lode"
            raise InputError(f"expected the address of a container, such as {example}, got that of a whole bucket")
        self.place = address
        self.name = key.removesuffix(".lode")
        self._blob = open_store(folder).open(key)
        self.size = self._blob.size
        end = self._blob.read(max(self.size - _END, 0), _END)
        self.tag = hashlib.sha256(b"%d " % self.size + end).hexdigest()
        self.gap = 0  # whole blocks are read anyway

    def __reduce__(self) -> tuple[Any, ...]:
        return BucketSource, (self.place,)

    def read(self, offset: int, length: int) -> bytes:
        """Return at most ``length`` bytes from ``offset`` on.

        Raises
        ------
        StoreError
            If they cannot be read.
        """
        return self._blob.read(offset, min(length, AT_ONCE))

    def close(self) -> None:
        """Let go of the object."""
        self._blob.close()
