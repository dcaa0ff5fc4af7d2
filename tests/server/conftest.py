"""A server on a real socket, and tokens, shared by the tests of a file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from lodestream_server import running_server
from lodestream_server.access.tokens import SCOPES, TokenFile
from tests.patience import PATIENCE
from tests.server.helpers import Keys


@pytest.fixture(scope="session", autouse=True)
def _one_fork_server(one_fork_server: None) -> None:
    """For all of these tests."""


@pytest.fixture
def called_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """``serve`` may be called within this process: its log and its limits stay as they are."""
    monkeypatch.setattr("lodestream_server.operation.logs.configure", lambda *_: None)
    monkeypatch.setattr("lodestream_server.connections.open_files.raise_file_limit", lambda _: None)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("server") / "data"


@pytest.fixture(scope="module")
def server(data: Path) -> Iterator[str]:
    with running_server(data, upload_bytes=1 << 20, workers=1) as url:
        yield url


@pytest.fixture(scope="module")
def http(server: str) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server, trust_env=False, timeout=PATIENCE) as client:
        yield client


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    folder = tmp_path_factory.mktemp("keys")
    file = TokenFile(folder / "tokens.json")
    tokens = {scope: file.create(scope, (scope,))[0] for scope in SCOPES}
    tokens["revoked"] = file.create("revoked", ("admin",))[0]
    file.revoke("revoked")
    tokens["expired"] = file.create("expired", ("admin",), days=1e-9)[0]
    tokens["wrong"] = tokens["admin"][:-1] + ("A" if tokens["admin"][-1] != "A" else "B")
    return Keys(folder, tokens)
