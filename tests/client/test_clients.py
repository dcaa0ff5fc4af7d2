"""Clients in programs: interrupted, in threads, beside an event loop, after a fork, at the end of the interpreter."""

from __future__ import annotations

import asyncio
import gc
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream_client import AsyncClient, Client
from lodestream_client.requests import calls
from tests.links import Fault, linked
from tests.patience import PATIENCE


class Alarm(BaseException):
    """As Ctrl-C brings a KeyboardInterrupt."""


@pytest.fixture
def silent() -> Iterator[socket.socket]:
    """A server that takes connections and says nothing."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield server


def at(server: socket.socket) -> str:
    return f"http://127.0.0.1:{server.getsockname()[1]}"


@contextmanager
def interrupted(silent: socket.socket) -> Iterator[None]:
    """A signal when the silent server has been asked something, whose handler raises `Alarm`."""
    over, waiting = threading.Event(), threading.get_ident()

    def handle(number: int, frame: FrameType | None) -> None:
        raise Alarm

    def ask() -> None:
        connection, _ = silent.accept()
        with connection:
            connection.recv(1)
            signal.pthread_kill(waiting, signal.SIGALRM)
            assert over.wait(PATIENCE)

    asked = threading.Thread(target=ask)
    before = signal.signal(signal.SIGALRM, handle)
    asked.start()
    try:
        yield
    finally:
        over.set()
        asked.join()
        signal.signal(signal.SIGALRM, before)


#: Seconds for which a stream may wait for anything: longer than a test may take.
LONG: dict[str, Any] = {"silence": 2 * PATIENCE, "close_timeout": 2 * PATIENCE, "deadline": 2 * PATIENCE}

WAITS: dict[str, Callable[[Client], object]] = {
    "a request": lambda client: client.list(),
    "an upload": lambda client: client.upload(bytes(20_000_000), name="never"),
    "a handshake": lambda client: client.connect("ab", transport="ws", **LONG),
    "an answer": lambda client: client.connect("ab", transport="http", **LONG),
}


@pytest.mark.parametrize("what", WAITS)
def test_an_interrupt_ends_a_wait_at_once(silent: socket.socket, what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calls, "TIMEOUT", 2 * PATIENCE)  # nothing else ends it
    with Client(at(silent)) as client:
        for _ in range(3):
            with pytest.raises(Alarm), interrupted(silent):
                WAITS[what](client)


def test_one_connection_for_all_requests(server: str, terrain_file: Path) -> None:
    with linked(server, Fault()) as link, Client(link.url) as client:
        made = client.upload(terrain_file, precision=0.125)
        assert made.ready
        assert made.id in {it.id for it in client.list()}
        assert client.fetch_range(made.id, 1, 4, identity=client.identify(made.id)) == b"LODE"
        with client.connect(made.id, transport="http") as stream:
            first = next(stream)
        client.delete(made.id)
        assert (first.number, stream.ended) == (0, "stopped")
        # The stream was left in the middle of an answer, whose connection is of no further use.
        assert link.connections <= 2


def test_requests_one_after_another_need_one_connection(server: str, terrain_file: Path) -> None:
    async def requests(url: str) -> None:
        async with AsyncClient(url) as client:
            made = await client.upload(terrain_file, precision=0.25)
            assert made.id in {it.id for it in await client.list()}
            await client.delete(made.id)

    with linked(server, Fault()) as link:
        with Client(link.url) as client:
            made = client.upload(terrain_file, precision=0.5)
            assert made.id in {it.id for it in client.list()}
            client.delete(made.id)
        assert link.connections == 1
        asyncio.run(requests(link.url))
        assert link.connections == 2


def test_it_works_where_an_event_loop_runs(surface: str, terrain: NDArray[np.float32]) -> None:
    async def loop() -> ls.View:
        client = Client(surface)
        assert client.get(surface).ready
        with client.connect(surface) as stream:
            *_, view = stream
        return view

    assert np.array_equal(asyncio.run(loop()).points, terrain)


def test_fifty_threads_on_one_client(surface: str, terrain: NDArray[np.float32]) -> None:
    def receive(number: int) -> bool:
        if number % 5:
            return client.get(surface).ready
        with client.connect(surface, transport="ws" if number % 2 else "http") as stream:
            *_, view = stream
        return np.array_equal(view.points, terrain)

    with Client(surface) as client, ThreadPoolExecutor(50) as pool:
        assert all(pool.map(receive, range(100)))


def test_what_is_given_is_called_in_the_thread_of_the_caller(server: str, terrain_file: Path) -> None:
    threads = set[int]()
    stages = set[str]()

    def progress(stage: str, fraction: float) -> None:
        threads.add(threading.get_ident())
        stages.add(stage)

    def note(*_: object) -> None:
        threads.add(threading.get_ident())

    with Client(server) as client:
        made = client.upload(terrain_file, precision=0.0625, local=True, progress=progress)
        client.retry(made.id, progress=progress)
        with client.connect(made.id, progress=note, sink=note) as stream:
            for _ in stream:
                pass
    assert stages >= {"encoding", "sending"}
    assert threads == {threading.get_ident()}


def test_an_error_of_what_is_called_ends_an_upload(server: str) -> None:
    def fail(stage: str, fraction: float) -> None:
        raise ZeroDivisionError

    with Client(server) as client:
        with pytest.raises(ZeroDivisionError):
            client.upload(bytes(3_000_000), progress=fail)
        assert client.list() is not None


def test_an_id_or_an_address_and_the_token_for_its_server_only(surface: str) -> None:
    server, _, name = surface.partition("/v1/surfaces/")
    for url in (server, f"{server}/", f"{server}/v1/surfaces", surface, f"{server}/v1/names/dem"):
        client = Client(url, token="secret")
        assert client.url == server
        assert "secret" not in repr(client)
        assert client.get(name).url == client.get(surface).url == surface
    for wrong in ("", "a/b", "../names/dem", "ftp://host/v1/surfaces/ab", "a b"):
        with pytest.raises(ls.OptionError):
            client.get(wrong)
    with pytest.raises(ls.OptionError):
        Client("host:8000")
    assert "secret" not in repr(AsyncClient(server, token="secret"))
    assert client._async.options_for(surface, {}).token == "secret"
    assert client._async.options_for("http://other.example/a.lode", {}).token is None


@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_what_is_no_option_of_a_stream_is_refused_in_words(kind: Any) -> None:
    client = kind("http://127.0.0.1:1")
    words = {"rms": "until_rms", "max_error": "until_max", "bytes": "max_bytes", "level": "level", "seconds": "seconds"}
    for name, keyword in words.items():
        with pytest.raises(ls.OptionError, match=rf"^expected target=lodestream.Target\({keyword}=5\), got {name}=$"):
            client.connect("ab", **{name: 5})
    with pytest.raises(ls.OptionError, match=r"expected target, transport, .*, got 'zoom'"):
        client.connect("ab", zoom=5)
    with pytest.raises(ls.OptionError, match="expected a target such as"):
        client.connect("ab", target=5)


def test_clients_and_streams_that_nobody_refers_to_are_closed(surface: str) -> None:
    with linked(surface, Fault()) as link:
        for transport in ("ws", "http"):
            client = Client(link.url)
            assert client.get(link.url).ready
            stream = client.connect(link.url, transport=transport, window=1024)
            next(stream)
            del client, stream
            gc.collect()
        until = time.monotonic() + PATIENCE
        while link.open and time.monotonic() < until:
            time.sleep(0.01)
        assert link.open == 0


def said_by(script: str, *arguments: str) -> str:
    """What a program prints that has nothing to warn of."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script, *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


def test_a_program_ends_whatever_is_open(surface: str, silent: socket.socket) -> None:
    script = """\
import sys, threading
from lodestream_client import Client
client = Client(sys.argv[1])
streams = [client.connect(sys.argv[1], transport=transport, window=1024) for transport in ("ws", "http")]
for stream in streams:
    next(stream)
threading.Thread(target=Client(sys.argv[2]).list, daemon=True).start()
print(client.get(sys.argv[1]).state)
"""
    assert said_by(script, surface, at(silent)) == "ready\n"


@pytest.mark.skipif(not hasattr(signal, "SIGCHLD"), reason="processes are not forked here")
def test_a_client_works_after_a_fork_on_both_sides(surface: str) -> None:
    script = """\
import os, sys, warnings
from lodestream_client import Client
warnings.simplefilter("ignore", DeprecationWarning)  # of forking beside threads, which is what is tried
client = Client(sys.argv[1])
stream = client.connect(sys.argv[1], transport="ws", window=1024)
views = [next(stream)]
child = os.fork()
if child == 0:
    with client.connect(sys.argv[1]) as other:
        *_, view = other
    print(client.get(sys.argv[1]).state, other.ended)
    try:
        list(stream)
    except RuntimeError as error:
        print(error)
    stream.close()
    sys.exit(0)
status = os.waitpid(child, 0)[1]
assert status == 0, status
with stream:
    views += stream
print(client.get(sys.argv[1]).state, stream.ended)
"""
    refused = "expected a stream of this process, got one that was opened before a fork"
    assert said_by(script, surface).splitlines() == ["ready complete", refused, "ready complete"]


@pytest.mark.parametrize("token", ["secret\n", "sec ret", "secr\u00e9t"])
def test_a_token_that_no_header_can_hold_is_not_shown(token: str) -> None:
    with pytest.raises(ls.OptionError, match="expected a token without spaces, line ends") as failure:
        Client("http://127.0.0.1:9", token=token)
    assert "sec" not in str(failure.value)


def test_what_is_no_text_is_no_surface() -> None:
    with pytest.raises(ls.OptionError, match="expected the id or the URL of a surface, which are texts, got bytes"):
        Client("http://127.0.0.1:9").get(b"ab")  # type: ignore[arg-type]
