"""Frames of a stream: how many may come, and which of them set no clock back."""

from __future__ import annotations

import fcntl
import gc
import socket
import struct
import termios
import threading
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from websockets.exceptions import ConnectionClosed

import lodestream as ls
from lodestream.protocol.messages import Credit, End, Error, Event, Open
from lodestream.protocol.wire import serialize
from lodestream_server import running, running_server
from lodestream_server.connections import connections
from tests.server.connections.sockets import CLOSE, CONTINUATION, PING, PONG, Frames, Place, frame, handshake
from tests.server.helpers import PATIENCE, Keys, Raw, eventually, hills, in_time, npy, push, raw_stream


@pytest.fixture(scope="module")
def surface(http: httpx.Client) -> dict[str, Any]:
    return push(http, npy(hills(200, 190)))


def stream_of(connection: socket.socket) -> Any:
    """The other side of a connection to a server of this process; those of other tests may still be there."""
    # Not by `isinstance`, which asks weak proxies.
    found = [item for item in gc.get_objects() if issubclass(type(item), connections._Stream)]
    (stream,) = (each for each in found if not each.disconnected and each.client == connection.getsockname())
    return stream


def unread(connection: socket.socket, transport: Any) -> bool:
    """Whether something that was sent over a connection was not read on its other side yet."""
    questions = ((connection, termios.TIOCOUTQ), (transport.get_extra_info("socket"), termios.FIONREAD))
    return any(struct.unpack("i", fcntl.ioctl(each.fileno(), what, bytes(4))) != (0,) for each, what in questions)


def opened(url: str, buffer: int | None = None) -> socket.socket:
    place = Place.of(url)
    connection = socket.socket()
    if buffer is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
    connection.settimeout(PATIENCE)
    connection.connect((place.host, place.port))
    connection.sendall(handshake(place))
    head = b""
    while not head.endswith(b"\r\n\r\n"):
        head += connection.recv(1)
    return connection


def cut_by(connection: socket.socket, pieces: Iterable[bytes]) -> bool:
    """Whether the other side breaks the connection while these are sent and nothing is read."""
    try:
        for piece in pieces:
            connection.sendall(piece)
    except (ConnectionResetError, BrokenPipeError):
        return True
    return False


def test_of_pongs_that_nobody_takes_the_last_one_waits(
    tmp_path: Path, keys: Keys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "_FRAMES", 1e9)
    # Somebody without a token, whose open is waited for.
    monkeypatch.setattr(running, "_PING_INTERVAL", PATIENCE)  # of no ping that the server itself sends
    settings: dict[str, Any] = {"workers": 1, "token_file": keys.folder / "tokens.json", "head_seconds": PATIENCE}
    with running_server(tmp_path, **settings) as url, opened(f"{url}/v1/surfaces/{'0' * 20}", 4096) as connection:
        transport = stream_of(connection).transport
        number, most = 0, 0
        while number < 100_000:
            connection.sendall(b"".join(frame(b"%0125d" % each, PING) for each in range(number, number + 500)))
            number += 500
            most = max(most, transport.get_write_buffer_size())
        assert 1 << 16 <= most < 1 << 17
        for count in (0, 3):  # of which one read of the server brings all
            connection.sendall(b"".join(frame(b"%0125d" % each, PING) for each in range(number, number + count)))
            number += count
            eventually(lambda: not unread(connection, transport), "all to be read by the server")
        found, last, answered = Frames(), -1, 0
        while last != number - 1:  # in their order, and the last one of all
            data = connection.recv(1 << 20)
            assert data
            for opcode, payload in found.feed(data):
                assert opcode == PONG
                assert int(payload) > last
                last, answered = int(payload), answered + 1
        assert answered < number


def test_who_leaves_before_it_has_read_its_pongs_is_answered(
    tmp_path: Path, keys: Keys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "_FRAMES", 1e9)
    monkeypatch.setattr(running, "_PING_INTERVAL", PATIENCE)
    settings: dict[str, Any] = {"workers": 1, "token_file": keys.folder / "tokens.json", "head_seconds": PATIENCE}
    with running_server(tmp_path, **settings) as url, opened(f"{url}/v1/surfaces/{'0' * 20}", 4096) as connection:
        stream = stream_of(connection)
        while stream.writable.is_set():
            connection.sendall(frame(b"%0125d" % 0, PING) * 500)
        eventually(lambda: not unread(connection, stream.transport), "all to be read by the server")
        connection.sendall(frame(b"last", PING) + frame(struct.pack(">H", 1000), CLOSE))  # which one read brings
        eventually(lambda: not unread(connection, stream.transport), "the end to be read by the server")
        found, frames = Frames(), list[tuple[int, bytes]]()
        while data := connection.recv(1 << 20):
            frames += found.feed(data)
    assert frames[-2:] == [(PONG, b"last"), (CLOSE, struct.pack(">H", 1000))]


def test_a_stream_is_read_little_by_little(server: str, surface: dict[str, Any]) -> None:
    with opened(server + surface["url"]) as connection:
        # No more than may come at once, and a message that the others wait behind.
        connection.sendall(frame(b"x" * 100, PING) * 150 + frame(serialize(Open(credit=0))))
        found, pongs = Frames(), 0
        while pongs < 150:
            for opcode, _ in found.feed(connection.recv(1 << 16)):
                pongs += opcode == PONG
        assert len(stream_of(connection).get_buffer(-1)) <= 1024


def test_frames_that_are_no_message_are_allowed_again_with_time_and_for_messages(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, cut = [100.0], list[str]()
    monkeypatch.setattr(connections, "time", SimpleNamespace(monotonic=lambda: now[0]))
    stream: Any = connections._Stream.__new__(connections._Stream)
    stream.cuts = SimpleNamespace(note=lambda reason, client: cut.append(reason))
    stream.transport, stream.client = SimpleNamespace(abort=lambda: None), None
    stream._allowed, stream._counted, stream._is_cut = 200.0, 100.0, False
    assert all(stream._count() for _ in range(200))
    now[0] += 2
    assert all(stream._count() for _ in range(100))
    now[0] += 1000
    assert all(stream._count() for _ in range(200))
    assert not cut
    assert not stream._count()
    assert not stream._count()
    assert cut == ["frames"]


def test_a_message_in_ever_more_fragments_is_cut(
    server: str, surface: dict[str, Any], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(connections, "_FRAMES", 1e9)  # which would be too many before
    empty = frame(b"", CONTINUATION, last=False)
    with opened(server + surface["url"]) as connection:
        connection.sendall(frame(b"", last=False))
        assert cut_by(connection, [empty * 100] * 1_000_000)
    assert "connection cut: frames" in [record.getMessage() for record in caplog.records]


@pytest.mark.long
def test_an_honest_message_in_fragments_is_taken(server: str, surface: dict[str, Any]) -> None:
    message = serialize(Open(held=tuple((2 * n, 1) for n in range(1000)), container=surface["container_sha256"]))
    with raw_stream(server + surface["url"]) as stream:
        stream.socket.send([message[start : start + 100] for start in range(0, len(message), 100)])
        stream.send(Credit(1000))
        assert not isinstance(stream.receive(), Error)


def test_a_client_that_answers_everything_in_fragments_is_never_cut(server: str, surface: dict[str, Any]) -> None:
    with raw_stream(server + surface["url"]) as stream:
        stream.send(Open(credit=100))
        event = stream.receive()
        while not isinstance(event, End):
            # Several thousand frames at the pace of the server.
            stream.socket.send([b"", serialize(Credit(30))[:5], serialize(Credit(30))[5:]])
            event = stream.receive()


def test_grants_that_were_held_up_come_all_at_once(server: str, surface: dict[str, Any]) -> None:
    with raw_stream(server + surface["url"]) as stream:
        stream.send(Open(credit=0))
        for _ in range(1500):
            stream.send(Credit(1))
        assert not isinstance(stream.receive(), Error)


def test_pings_do_not_prolong_the_wait_for_open(tmp_path: Path, keys: Keys) -> None:
    settings: dict[str, Any] = {"workers": 1, "head_seconds": 0.5, "token_file": keys.folder / "tokens.json"}

    def pinged(stream: Raw) -> Event:
        pinging = threading.Event()

        def ping() -> None:
            with suppress(ConnectionClosed):  # the server may be the first
                while not pinging.wait(0.1):
                    stream.socket.ping()

        thread = threading.Thread(target=ping)
        thread.start()
        try:
            event = stream.receive()
        finally:
            pinging.set()
            thread.join()
        return event

    with running_server(tmp_path, **settings) as url:
        event = in_time(f"{url}/v1/surfaces/{'0' * 20}", pinged)
    assert isinstance(event, Error)
    assert event.code == "idle"


def test_messages_that_change_nothing_do_not_prolong_a_wait(tmp_path: Path) -> None:
    with (
        running_server(tmp_path, workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        made = push(http, npy(hills(30, 30)))
    settings: dict[str, Any] = {"workers": 1, "idle_seconds": 0.5, "bye_seconds": 0.5}
    with running_server(tmp_path, **settings) as url, raw_stream(url + made["url"]) as stream:
        stream.send(Open(ls.Target(level=0), credit=100_000))
        over = threading.Event()

        def speak() -> None:
            with suppress(ConnectionClosed):  # the server may be the first
                while not over.wait(0.05):
                    stream.send(Credit(1))  # after the end

        thread = threading.Thread(target=speak)
        thread.start()
        try:
            until, event = time.monotonic() + PATIENCE, stream.receive()
            while not isinstance(event, Error):
                assert time.monotonic() < until
                event = stream.receive()
        finally:
            over.set()
            thread.join()
        assert event.code == "idle"
