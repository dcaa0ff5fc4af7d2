"""The window that one stream has measured is the first one of the next stream from the same server."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from typing import Any

import pytest

from lodestream import Surface
from lodestream.errors import RemoteError
from lodestream.protocol.flow_control import FIRST_WINDOW
from lodestream.protocol.handshake import from_address
from lodestream.protocol.messages import BASE_CREDIT, Open
from lodestream.protocol.wire import parse
from lodestream_client import Client
from lodestream_client.errors import SilenceError
from lodestream_client.requests import addresses
from lodestream_client.stream import known_windows
from lodestream_client.stream.known_windows import KnownWindows
from tests.links import Fault, linked
from tests.patience import PATIENCE

from ..conftest import make_terrain
from .test_resume import follow
from .world import URL, World

SERVER = URL.partition("/v1/")[0]


@pytest.fixture(scope="module")
def large(server: str) -> str:
    """A surface of several windows."""
    return Client(server).upload(Surface(make_terrain(400, 300))).url


@pytest.fixture
def credits(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The first credit of each stream that is opened."""
    found, stream_url = list[int](), addresses.stream_url

    def noted(url: str, query: str | None) -> str:
        assert query is not None
        event = parse(from_address(query.removeprefix("open=")))
        assert isinstance(event, Open)
        found.append(event.credit)
        return stream_url(url, query)

    monkeypatch.setattr(addresses, "stream_url", noted)
    return found


def test_a_window_is_remembered_for_a_minute_by_scheme_host_and_port() -> None:
    known = KnownWindows()
    assert known.first(URL, 0.0) == FIRST_WINDOW
    known.remember(URL, 100_000, 1.0)
    assert known.first(f"{SERVER}/v1/surfaces/other", 60.9) == 100_000
    assert known.first(URL, 61.0) == FIRST_WINDOW
    for other in (SERVER.replace("http:", "https:"), f"{SERVER}:8001", f"{SERVER}.example"):
        assert known.first(f"{other}/v1/surfaces/x", 2.0) == FIRST_WINDOW
    known.remember(URL, 50_000, 2.0)
    assert known.first(URL, 2.0) == 50_000
    known.forget(URL)
    known.forget(URL)
    assert known.first(URL, 2.0) == FIRST_WINDOW


def test_no_more_servers_are_remembered_than_a_program_talks_to() -> None:
    known = KnownWindows()
    for number in range(1000):
        known.remember(f"http://h{number}/v1/surfaces/x", 100_000, 0.0)
    assert len(known._windows) == 256
    assert known.first("http://h999/v1/surfaces/x", 0.0) == 100_000
    assert known.first("http://h743/v1/surfaces/x", 0.0) == FIRST_WINDOW


def test_threads_may_use_it_together() -> None:
    known, failed = KnownWindows(), []

    def use(start: int) -> None:
        try:
            for number in range(start, start + 2000):
                url = f"http://h{number % 700}/v1/surfaces/x"
                known.remember(url, 70_000, 0.0)
                if known.first(url, 0.0) not in (70_000, FIRST_WINDOW):
                    failed.append(url)
                if number % 3 == 0:
                    known.forget(url)
        except BaseException as error:
            failed.append(repr(error))

    threads = [threading.Thread(target=use, args=(101 * number,)) for number in range(4)]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        sys.setswitchinterval(interval)
    assert failed == []
    assert len(known._windows) <= 256


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_process_may_be_forked_while_another_thread_uses_it(monkeypatch: pytest.MonkeyPatch) -> None:
    known, busy, go = KnownWindows(), threading.Event(), threading.Event()

    def slow(url: str) -> str:
        if threading.current_thread() is thread:
            busy.set()
            assert go.wait(PATIENCE)
        return addresses.origin(url)

    monkeypatch.setattr(known_windows, "origin", slow)
    thread = threading.Thread(target=known.remember, args=(URL, 70_000, 0.0))
    thread.start()
    assert busy.wait(PATIENCE)
    child = os.fork()
    if not child:
        signal.alarm(int(PATIENCE))  # kills a child that hangs
        known.remember(URL, 60_000, 0.0)
        os._exit(0 if known.first(URL, 0.0) == 60_000 else 1)
    go.set()
    thread.join()
    assert os.waitpid(child, 0)[1] == 0


@pytest.mark.parametrize("act", ["break", "silence"])
def test_a_stream_begins_with_what_is_known_and_forgets_it_when_the_link_fails(act: Any) -> None:
    windows = KnownWindows()
    windows.remember(URL, 100_000, 0.0)
    world = World(windows=windows).run()
    assert world.session.download is not None
    assert parse(world.session.download.opening).credit == 100_000  # type: ignore[union-attr]
    assert windows.first(URL, 1.0) == 100_000, "a stream of less than a window measures nothing"
    broken = World({20: act}, windows=windows, transport="ws").run()
    assert broken.session.ended == "complete"
    assert broken.session.connections == 2
    assert broken.session.download is not None
    assert parse(broken.session.download.opening).credit == FIRST_WINDOW  # type: ignore[union-attr]
    assert windows.first(URL, 1.0) == FIRST_WINDOW


def test_a_server_that_refuses_says_nothing_of_the_link(monkeypatch: pytest.MonkeyPatch) -> None:
    windows = KnownWindows()
    windows.remember(URL, 100_000, 0.0)
    world = World(windows=windows, transport="ws")

    def refused(_: object) -> None:
        raise RemoteError("no-surface", "there is none")

    monkeypatch.setattr(world, "perform", refused)
    with pytest.raises(RemoteError):
        world.run()
    assert windows.first(URL, 1.0) == 100_000


@pytest.mark.parametrize("asynchronous", [False, True])
def test_the_second_stream_over_a_distant_link_begins_with_a_large_window(
    large: str, windows: KnownWindows, credits: list[int], asynchronous: bool
) -> None:
    with linked(large, Fault(delay=0.05)) as link:
        for _ in range(2):
            _, stream = follow(link.url, asynchronous, transport="ws")
            assert stream.ended == "complete"
        follow(large, asynchronous, transport="ws")
    assert credits[0] == credits[2] == FIRST_WINDOW, "another port is another server"
    assert FIRST_WINDOW < credits[1] <= BASE_CREDIT


@pytest.mark.usefixtures("slow_handshakes")
def test_a_server_that_falls_silent_is_met_with_a_small_window(
    large: str, windows: KnownWindows, credits: list[int]
) -> None:
    with linked(large, lambda number: Fault(delay=0.05, cut_down=20_000 if number == 1 else None, vanish=True)) as link:
        with Client(link.url).connect(link.url, transport="ws") as stream:
            assert [view.complete for view in stream][-1]
        with (
            pytest.raises(SilenceError),
            Client(link.url).connect(link.url, transport="ws", silence=0.5, deadline=0.0) as stream,
        ):
            for _ in stream:
                pass
        with Client(link.url).connect(link.url, transport="ws") as stream:
            assert [view.complete for view in stream][-1]
    assert credits[0] == credits[2] == FIRST_WINDOW
    assert credits[1] > FIRST_WINDOW


def test_a_fixed_window_is_neither_remembered_nor_replaced(
    large: str, windows: KnownWindows, credits: list[int]
) -> None:
    windows.remember(large, 200_000, time.monotonic())
    with Client(large).connect(large, transport="ws", window=20_000) as stream:
        assert [view.complete for view in stream][-1]
    assert credits == [20_000]
    assert windows.first(large, time.monotonic()) == 200_000
