from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from .run import Session, in_memory
from .shim import CannotError


@pytest.fixture(scope="module")
def session() -> Iterator[Session]:
    with tempfile.TemporaryDirectory(dir=in_memory()) as folder:
        try:
            made = Session(Path(folder))
        except CannotError as error:
            pytest.skip(str(error))
        with made:
            yield made
