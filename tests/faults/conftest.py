from __future__ import annotations

from collections.abc import Iterator

import pytest

from .run import Session
from .shim import CannotError


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    try:
        made = Session(tmp_path_factory.mktemp("faults"))
    except CannotError as error:
        pytest.skip(str(error))
    with made:
        yield made
