"""A server on a real socket, and tokens, shared by the tests of a file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from lodestream_server import running_server, worker
from lodestream_server.tokens import SCOPES, TokenFile
from tests.server import slow
from tests.server.helpers import Keys


@pytest.fixture(scope="package", autouse=True)
def unwarmed() -> Iterator[None]:
    """Servers whose processes load the kernels that a build needs when it needs them, not all at their start.

    Those of the client's tests, and those that are programs of their own, do as they always do.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worker, "warm", slow.number)
        yield


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
