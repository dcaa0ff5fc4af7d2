"""Surfaces that a server cannot make ready for a reason of its own: an end with the reason, and another attempt."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lodestream.errors import NotFoundError, RemoteError, RemoteProtocolError
from lodestream_client import Client
from lodestream_client.requests.api import Description
from lodestream_server import running_server

from ..asked import asked
from ..conftest import Run
from ..files import running

REASON = "the kernels could not be loaded"


@dataclass
class Fake:
    """A server with one surface, whose state is the next of a list at every answer."""

    states: list[str]
    url: str = ""
    requests: list[tuple[str, str]] = field(default_factory=list)
    waits: set[str] = field(default_factory=set)

    def answer(self, method: str, path: str) -> tuple[int, dict[str, Any]]:
        self.requests.append((method, path.partition("?")[0]))
        self.waits |= {path.partition("?")[2]} if method == "GET" else set()
        if path.startswith(("/v1/surfaces/none", "/v1/formats")):  # it does not say what it reads, as an older server
            return 404, {"code": "not-found", "detail": "no such surface", "status": 404}
        state = self.states.pop(0) if len(self.states) > 1 else self.states[0]
        reason = REASON if state in ("waiting", "failed") else None
        surface = {"id": "ab", "url": "/v1/surfaces/ab", "state": state, "reason": reason, "progress": 0.5}
        return 202 if method == "POST" and state != "ready" else 200, surface

    @property
    def surface(self) -> str:
        return f"{self.url}/v1/surfaces/ab"


@contextmanager
def fake(*states: str) -> Iterator[Fake]:
    told = Fake(list(states))

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.rfile.read(int(self.headers.get("content-length") or 0))
            status, document = told.answer(self.command, self.path)
            body = json.dumps(document).encode()
            self.send_response(status)
            self.send_header("content-type", "application/json")
            self.send_header("content-length", str(len(body)))
            self.send_header("location", "/v1/surfaces/ab")
            self.end_headers()
            self.wfile.write(body)

        do_POST = do_GET  # noqa: N815

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    told.url = f"http://127.0.0.1:{server.server_address[1]}"
    with running(server):
        yield told


def ask(what: str, server: Fake, asynchronous: bool) -> Description:
    if what == "upload":
        return (
            asyncio.run(asked(server.url, lambda it: it.upload(b"file")))
            if asynchronous
            else Client(server.url).upload(b"file")
        )
    return (
        asyncio.run(asked(server.surface, lambda it: it.retry(server.surface)))
        if asynchronous
        else Client(server.surface).retry(server.surface)
    )


@pytest.mark.parametrize("state", ["waiting", "failed"])
@pytest.mark.parametrize("states", [(), ("queued", "building")], ids=["at once", "later"])
@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
@pytest.mark.parametrize("what", ["upload", "retry"])
def test_upload_and_retry_end_with_the_reason(
    state: str, states: tuple[str, ...], asynchronous: bool, what: str
) -> None:
    with fake(*states, state) as server:
        with pytest.raises(RemoteError, match=REASON) as caught:
            ask(what, server, asynchronous)
        assert caught.value.code == state
        assert (server.surface in str(caught.value)) == (state != "failed")
        upload = [("GET", "/v1/formats"), ("POST", "/v1/surfaces")]
        first = upload if what == "upload" else [("POST", "/v1/surfaces/ab/retry")]
        assert server.requests == first + [("GET", "/v1/surfaces/ab")] * len(states)
        assert server.waits <= {"", "wait=20"}


@pytest.mark.parametrize("asynchronous", [False, True], ids=["sync", "async"])
def test_retry_waits_until_the_surface_is_ready(asynchronous: bool) -> None:
    told: list[tuple[str, float]] = []

    def progress(stage: str, fraction: float) -> None:
        told.append((stage, fraction))

    with fake("queued", "building", "ready") as server:
        if asynchronous:
            made = asyncio.run(asked(server.surface, lambda it: it.retry(server.surface, progress=progress)))
        else:
            made = Client(server.surface).retry(server.surface, progress=progress)
        assert (made.ready, made.url, made.id) == (True, server.surface, "ab")
        assert told == [("building", 0.5)] * 2
        assert server.waits == {"wait=1"}, "the progress is asked for every second"
    with fake("queued") as server:
        assert Client(server.surface).retry(server.surface, wait=False).state == "queued"
        assert server.requests == [("POST", "/v1/surfaces/ab/retry")]
        with pytest.raises(NotFoundError, match="no such surface"):
            Client(f"{server.url}/v1/surfaces/none").retry(f"{server.url}/v1/surfaces/none")
    with fake("asleep") as server, pytest.raises(RemoteProtocolError, match="'asleep'"):
        Client(server.surface).retry(server.surface)


def test_states_are_told_to_those_who_only_look() -> None:
    with fake("waiting") as server:
        found = Client(server.surface).get(server.surface)
        assert (found.state, found.ready, found.details["reason"]) == ("waiting", False, REASON)
        assert Client(server.url).upload(np.eye(4), wait=False).state == "waiting"


def test_the_command_retry(run: Run) -> None:
    with fake("queued", "ready") as server:
        assert run("retry", server.surface) == (0, f"{server.surface}\n", "")
    with fake("queued") as server:
        code, out, _ = run("retry", server.surface, "--no-wait", "--json")
        assert (code, json.loads(out)["state"], json.loads(out)["url"]) == (0, "queued", server.surface)
    with fake("queued", "waiting") as server:
        code, out, err = run("retry", server.surface)
        assert (code, out) == (1, "")
        assert err == f"lodestream: {server.surface} is waiting: {REASON}\n"
    assert run("retry", "http://host")[0] == 2


def test_push_says_that_a_surface_waits(run: Run, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.eye(5))
    with fake("queued", "waiting") as server:
        code, out, err = run("push", tmp_path / "a.npy", server.url)
        assert (code, out) == (1, "")
        assert err == f"lodestream: {server.surface} is waiting: {REASON}\n"
        assert f"waiting {REASON}" in run("info", server.surface)[1]


def test_a_server_whose_limit_was_raised(run: Run, tmp_path: Path) -> None:
    points = np.arange(30.0).reshape(5, 6)
    with running_server(tmp_path / "data", workers=1, max_vertices=29) as server:
        with pytest.raises(RemoteError, match="at most 29 vertices") as caught:
            Client(server).upload(points)
        assert caught.value.code == "waiting"
        (waiting,) = Client(server).list()
        assert waiting.url in str(caught.value)
        code, out, err = run("retry", waiting.url)
        assert (code, out, err.count("\n")) == (1, "", 1)
        assert f"{waiting.url} is waiting: " in err
    with running_server(tmp_path / "data", workers=1) as server:
        (still,) = Client(server).list()
        assert still.state == "waiting"
        assert run("retry", still.url) == (0, f"{still.url}\n", "")
        assert Client(still.url).retry(still.url).details["errors"] == "checked"
