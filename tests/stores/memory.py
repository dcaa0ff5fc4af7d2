"""A bucket in the memory of this process: what a test of servers needs of one, without a program beside it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING
from unittest.mock import patch

import pytest

if TYPE_CHECKING:
    from obstore.store import MemoryStore

    from lodestream.stores.connections import Limits, Place

__all__ = ["ADDRESS", "memory"]

#: Of the bucket.
ADDRESS = "s3://memory/data"


@pytest.fixture
def memory() -> Iterator[str]:
    """The address of an empty bucket, which all stores that are opened while the test runs share."""
    pytest.importorskip("obstore")
    from obstore.store import MemoryStore

    bucket = MemoryStore()

    def connected(place: Place, limits: Limits, stalled: float, seconds: float) -> MemoryStore:
        return bucket

    with patch("lodestream.stores.bucket.connected", connected):
        yield ADDRESS
