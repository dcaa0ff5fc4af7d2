"""Stores of each kind: fixtures that return what makes a new, empty one."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import pytest

from lodestream.stores import Store, open_store
from tests.stores.emulators import Emulator

__all__ = ["PLACES", "Place", "bucket_of_azure", "bucket_of_s3", "folder"]

#: The fixtures, by name.
PLACES = ("folder", "bucket_of_s3", "bucket_of_azure")

Place = Callable[[], Store]


@pytest.fixture
def folder(tmp_path: Path) -> Place:
    """Make stores in folders that do not exist yet."""
    numbers = itertools.count()
    return lambda: open_store(tmp_path / "stores" / str(next(numbers)))


@pytest.fixture
def bucket_of_s3(s3: Emulator) -> Place:
    """Make stores in a bucket of S3."""
    return lambda: open_store(s3.address())


@pytest.fixture
def bucket_of_azure(azure: Emulator) -> Place:
    """Make stores in a container of Azure."""
    return lambda: open_store(azure.address())
