"""A stream behind a proxy that knows no WebSocket comes by plain HTTP."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lodestream as ls

from ..conftest import Run
from ..proxies import plain_proxy
from ..scripted import Answer, document, problem
from ..stream.test_resume import Terrain, follow


@pytest.fixture(params=[False, True], ids=["sync", "async"])
def asynchronous(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


REFUSALS = {
    "passes it on as a GET": None,
    "400": Answer(400, b"Bad Request"),
    "403": Answer(403, b"<html>no</html>", {"Content-Type": "text/html"}),
    "403 in JSON": document({"code": "FORBIDDEN", "message": "no"}, 403),
    "a code that is none": document({"code": ["no-token"]}, 403),
    "404 as the server says it": problem(404, "not-found", "expected a path that /docs lists"),
    "426": Answer(426, b"", {"Upgrade": "h2c"}),
    "501": Answer(501, b""),
    "200": Answer(200, b"<html>welcome</html>"),
}


@pytest.mark.parametrize("refusal", REFUSALS.values(), ids=list(REFUSALS))
def test_a_proxy_that_knows_no_upgrade(
    surface: str, terrain: Terrain, asynchronous: bool, refusal: Answer | None
) -> None:
    with plain_proxy(surface, refusal) as proxy:
        views, stream = follow(proxy.url, asynchronous, deadline=0)
    assert stream.transport == "http"
    assert stream.ended == "complete"
    assert np.array_equal(views[-1].points, terrain)
    assert proxy.handshakes == 1, "the other transport is taken at once"
    assert proxy.passed >= 1


def test_whoever_wants_a_websocket_is_told(surface: str, asynchronous: bool) -> None:
    with plain_proxy(surface) as proxy, pytest.raises(ls.RemoteError, match="opened as a WebSocket"):
        follow(proxy.url, asynchronous, deadline=0, transport="ws")
    with plain_proxy(surface, Answer(501)) as proxy, pytest.raises(ls.RemoteError, match="501"):
        follow(proxy.url, asynchronous, deadline=0, transport="ws")


def test_a_surface_comes_by_one_request_of_one_connection(surface: str, asynchronous: bool) -> None:
    with plain_proxy(surface) as proxy:
        follow(proxy.url, asynchronous, transport="http")
    assert (proxy.connections, proxy.handshakes, proxy.passed) == (1, 0, 1)


def test_a_surface_that_is_none_is_none_behind_a_proxy(server: str, asynchronous: bool) -> None:
    with (
        plain_proxy(f"{server}/v1/surfaces/0123456789abcdef0123") as proxy,
        pytest.raises(ls.NotFoundError) as caught,
    ):
        follow(proxy.url, asynchronous, deadline=0)
    assert "by WebSocket" not in str(caught.value)
    assert "/docs" not in str(caught.value)


@pytest.mark.parametrize("code", ["no-token", "bad-token"])
def test_what_the_server_says_of_a_token_is_its_last_word(surface: str, asynchronous: bool, code: str) -> None:
    with plain_proxy(surface, problem(403, code, "because")) as proxy, pytest.raises(ls.RemoteError, match="because"):
        follow(proxy.url, asynchronous, deadline=0)
    assert (proxy.handshakes, proxy.passed) == (1, 0)


def test_pull_behind_a_proxy(surface: str, terrain: Terrain, run: Run, tmp_path: Path) -> None:
    with plain_proxy(surface) as proxy:
        code, _, stderr = run("pull", proxy.url, tmp_path / "o.npy")
    assert code == 0, stderr
    # The container is at the address of the surface: the first request without a handshake has it.
    assert (proxy.handshakes, proxy.passed) == (1, 1)
    assert np.array_equal(np.load(tmp_path / "o.npy"), terrain)
