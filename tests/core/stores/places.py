"""Empty stores of each kind: fixtures that return what makes one."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import pytest

from lodestream.stores import Folder

__all__ = ["PLACES", "folder"]

#: The fixtures, by name.
PLACES = ("folder",)


@pytest.fixture
def folder(tmp_path: Path) -> Callable[[], Folder]:
    """Make stores in new folders, which do not exist yet."""
    numbers = itertools.count()
    return lambda: Folder(tmp_path / "stores" / str(next(numbers)))
