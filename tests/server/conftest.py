"""A server on a real socket, and tokens, shared by the tests of a file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from lodestream_server import jobs, running_server, worker
from lodestream_server.processes import ForkServer
from lodestream_server.tokens import SCOPES, TokenFile
from tests.server.helpers import Keys


class _Shared(ForkServer):
    """A fork server that outlives the server that closes it."""

    def close(self) -> None:
        """Leave it to the next server."""


@pytest.fixture(scope="package", autouse=True)
def one_fork_server() -> Iterator[None]:
    """Servers that are objects here share what has loaded the kernels: each call has a process of its own anyway.

    Those of the client's tests, and those that are programs of their own, do as they always do.
    """
    shared = _Shared(worker.warm)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jobs, "ForkServer", lambda _: shared)
        yield
    ForkServer.close(shared)


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
