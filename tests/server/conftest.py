"""A server on a real socket, shared by the tests of a file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from lodestream_server import running_server, worker
from tests.server import slow


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("server") / "data"


@pytest.fixture(scope="module")
def server(data: Path) -> Iterator[str]:
    with running_server(data, upload_bytes=1 << 20, workers=1) as url:
        yield url


@pytest.fixture(scope="module")
def http(server: str) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server, trust_env=False, timeout=60) as client:
        yield client


@pytest.fixture
def unwarmed() -> Iterator[None]:
    """Servers whose processes load the kernels that a build needs when it needs them, not all at their start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worker, "warm", slow.number)
        yield
