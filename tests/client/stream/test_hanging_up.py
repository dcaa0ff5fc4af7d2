"""Leaving a stream early is no error of anybody's: nothing is printed or logged, whatever is on its way."""

from __future__ import annotations

import logging
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import ClientConnection

from lodestream import Target, Tolerance
from lodestream_client import sync

from ..conftest import Run, make_terrain

#: First byte of a close frame.
CLOSE = b"\x88"


@pytest.fixture(scope="module")
def large(server: str) -> str:
    """A surface of which much is on its way while its first layers are looked at."""
    return sync.upload(server, make_terrain(700, 500)).url


class _Socket(socket.socket):
    """While somebody leaves, is late to hand over the server's close frame, which nobody waits for.

    Whoever sends waits for it, so that it has been read when the socket is closed, and not been handed over.
    """

    leaving: Event
    read: Event

    def recv(self, most: int, flags: int = 0) -> bytes:
        data = super().recv(most, flags)
        if self.leaving.is_set() and data.startswith(CLOSE):
            self.read.set()
            time.sleep(0.3)  # longer than it takes to close; where it is not, the test passes as well
        return data

    def sendall(self, *given: Any) -> None:
        super().sendall(*given)
        if self.leaving.is_set():
            self.read.wait(1)  # the message before the last is answered in another way


@pytest.fixture
def leaving(monkeypatch: pytest.MonkeyPatch) -> Iterator[Event]:
    """Set it before a stream is left."""
    event, read, make = Event(), Event(), ClientConnection.__init__

    def with_slow_socket(connection: ClientConnection, given: socket.socket, *others: Any, **options: Any) -> None:
        slow = _Socket(fileno=given.detach())
        slow.leaving, slow.read = event, read
        make(connection, slow, *others, **options)

    monkeypatch.setattr(ClientConnection, "__init__", with_slow_socket)
    yield event
    assert read.is_set(), "the close frame came while it was left"


@pytest.mark.parametrize("how", ["break", "stop"])
def test_a_close_frame_that_was_just_read_is_no_error(
    large: str, leaving: Event, caplog: pytest.LogCaptureFixture, how: str
) -> None:
    with caplog.at_level(logging.WARNING), sync.connect(large) as stream:
        for _ in stream:
            leaving.set()
            if how == "break":
                break
            stream.stop()
    assert caplog.messages == []
    assert stream.decoder.view().points.shape == (700, 500)


def test_many_streams_that_are_left_log_nothing(large: str, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        for number in range(60):
            with sync.connect(large) as stream:
                for _, _ in zip(range(number % 6 + 1), stream, strict=False):
                    pass
    assert caplog.messages == []


class _LateSocket(socket.socket):
    """Hands over what it has read a moment later, as where the thread that reads waits for a processor."""

    def recv(self, most: int, flags: int = 0) -> bytes:
        data = super().recv(most, flags)
        time.sleep(0.001)
        return data


@pytest.mark.long
def test_none_of_300_streams_to_their_end_logs_anything(
    large: str, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = ClientConnection.__init__

    def with_late_socket(connection: ClientConnection, given: socket.socket, *others: Any, **options: Any) -> None:
        make(connection, _LateSocket(fileno=given.detach()), *others, **options)

    monkeypatch.setattr(ClientConnection, "__init__", with_late_socket)
    target = Target(until_rms=Tolerance(1e-2, relative=True))
    ended = set()
    with caplog.at_level(logging.WARNING):
        for _ in range(300):
            with sync.connect(large, target=target, transport="ws") as stream:
                for _ in stream:
                    pass
            ended.add(stream.ended)
    assert caplog.messages == []
    assert ended == {"rms"}


@pytest.mark.parametrize("options", [("--roi", "10:60,10:60"), ("--max-bytes", "20000"), ("--until-max", "20")])
def test_a_pull_that_stops_early_prints_its_figures_only(
    run: Run, large: str, tmp_path: Path, caplog: pytest.LogCaptureFixture, options: tuple[str, ...]
) -> None:
    with caplog.at_level(logging.WARNING):
        for _ in range(5):
            code, _, stderr = run("pull", large, tmp_path / "out.npy", *options)
            assert code == 0, stderr
            assert all(line.startswith("lodestream: ") for line in stderr.splitlines())
            assert "Error" not in stderr
    assert caplog.messages == []
    assert np.isfinite(np.load(tmp_path / "out.npy")).all()
