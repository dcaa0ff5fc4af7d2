"""Servers that do not do as they should: every time a clear error, never a stall, never a surface silently short."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.server import ServerConnection, serve
from websockets.typing import Subprotocol

import lodestream as ls
from lodestream.errors import ProtocolError, RemoteProtocolError
from lodestream.protocol.messages import BASE_CREDIT, MAX_MESSAGE, SUBPROTOCOL, Bye, End, Error, Opened, Segments
from lodestream.protocol.wire import serialize
from lodestream_client import AsyncClient, Client, SilenceError
from tests.patience import PATIENCE

from ..asked import asked

Behaviour = Callable[[ServerConnection], None]
HEADER = serialize(Opened("ab" * 32, 10_000, 5000, 1.0, (6000, 100), (5000, 100), True))


def header_of(data: bytes, planned: int) -> bytes:
    return serialize(Opened("ab" * 32, len(data), planned, 1.0, (len(data) - 2, 2), (len(data) - 3, 1), True))


@contextmanager
def websocket_server(behave: Behaviour, subprotocol: str | None = SUBPROTOCOL) -> Iterator[str]:
    server = serve(behave, "127.0.0.1", 0, subprotocols=[Subprotocol(subprotocol)] if subprotocol else None)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.socket.getsockname()[1]}/v1/surfaces/ab"
    finally:
        server.shutdown()
        thread.join()


@contextmanager
def tcp_server(answer: bytes) -> Iterator[str]:
    """Answers whatever comes with these bytes and hangs up, once for each connection."""
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def loop() -> None:
            while True:
                try:
                    connection, _ = listener.accept()
                except OSError:
                    return
                with connection:
                    connection.recv(65536)
                    connection.sendall(answer)

        thread = threading.Thread(target=loop)
        thread.start()
        try:
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join()


def follow(url: str, asynchronous: bool, **chosen: Any) -> None:
    options: dict[str, Any] = {"close_timeout": 0.2, "deadline": 0, "transport": "ws", **chosen}
    if not asynchronous:
        with Client(url).connect(url, **options) as stream:
            for _ in stream:
                pass
        return

    async def loop() -> None:
        async with AsyncClient(url) as client, client.connect(url, **options) as stream:
            async for _ in stream:
                pass

    asyncio.run(loop())


def says(*messages: bytes | str) -> Behaviour:
    """Says this to the client, whose open is in the address, then waits until it is gone."""

    def behave(connection: ServerConnection) -> None:
        for message in messages:
            connection.send(message)
        for _ in connection:
            pass

    return behave


def hangs_up(*messages: bytes, code: int = 1000, reason: str = "") -> Behaviour:
    def behave(connection: ServerConnection) -> None:
        for message in messages:
            connection.send(message)
        connection.close(code, reason)

    return behave


@pytest.fixture(params=[False, True], ids=["sync", "async"])
def asynchronous(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.mark.usefixtures("slow_handshakes")
@pytest.mark.parametrize("first", [(), (HEADER,)])
def test_silence(asynchronous: bool, first: tuple[bytes, ...]) -> None:
    with websocket_server(says(*first)) as url, pytest.raises(SilenceError, match=r"nothing for 0\.2 seconds"):
        follow(url, asynchronous, silence=0.2)


@pytest.mark.parametrize(
    "messages",
    [
        (b"",),
        (b"\xc1",),
        (b"\x80",),
        ("text",),
        (b"\x81\xa4type\xa5party",),
        (serialize(Segments(0, b"early")),),
        (HEADER, HEADER),
        (HEADER, b"\x81\xa4type\xa8segments"),
        (HEADER, serialize(End("complete")), serialize(End("complete"))),
    ],
)
def test_garbage(asynchronous: bool, messages: tuple[bytes, ...]) -> None:
    with websocket_server(says(*messages)) as url, pytest.raises((ProtocolError, ls.StreamError)) as caught:
        follow(url, asynchronous)
    assert "\n" not in str(caught.value)


def test_more_than_was_granted(asynchronous: bool) -> None:
    flood = [serialize(Segments(0, bytes(60_000)))] * 5
    with websocket_server(says(HEADER, *flood)) as url, pytest.raises((ProtocolError, ls.StreamError)):
        follow(url, asynchronous)


def test_a_message_beyond_all_bounds(asynchronous: bool) -> None:
    with (
        websocket_server(says(bytes(MAX_MESSAGE + 1))) as url,
        pytest.raises(ProtocolError, match="an invalid WebSocket message"),
    ):
        follow(url, asynchronous)


def test_bytes_that_are_no_container(asynchronous: bool) -> None:
    with (
        websocket_server(says(HEADER, serialize(Segments(0, b"junk" * 200)))) as url,
        pytest.raises(ls.CorruptStreamError),
    ):
        follow(url, asynchronous)


@pytest.mark.parametrize("size", [0, 100, 1500])
def test_an_end_before_the_end(asynchronous: bool, container_file: Path, size: int) -> None:
    data = container_file.read_bytes()
    messages = [header_of(data, 3000)]
    messages += [serialize(Segments(0, data[:size]))] if size else []
    with (
        websocket_server(says(*messages, serialize(End("complete")))) as url,
        pytest.raises(ls.TruncatedStreamError, match="expected 3000 bytes"),
    ):
        follow(url, asynchronous)


@pytest.mark.parametrize("code", [1000, 1001, 4999])
def test_a_connection_closed_in_the_middle(asynchronous: bool, code: int) -> None:
    with (
        websocket_server(hangs_up(HEADER, code=code)) as url,
        pytest.raises(ls.TruncatedStreamError, match="closed with code"),
    ):
        follow(url, asynchronous)


def test_a_server_that_restarts(asynchronous: bool) -> None:
    with websocket_server(hangs_up(HEADER, code=1012)) as url, pytest.raises(ls.RemoteError) as caught:
        follow(url, asynchronous)
    assert caught.value.code == "restarting"


def test_a_socket_that_breaks(asynchronous: bool) -> None:
    def behave(connection: ServerConnection) -> None:
        connection.send(HEADER)
        connection.socket.shutdown(socket.SHUT_RDWR)

    with websocket_server(behave) as url, pytest.raises(ls.TruncatedStreamError, match="was lost"):
        follow(url, asynchronous)


@pytest.mark.parametrize(
    ("code", "kind"), [("not-found", ls.NotFoundError), ("bad-target", ls.OptionError), ("internal", ls.RemoteError)]
)
def test_a_refusal(asynchronous: bool, code: str, kind: type[Exception]) -> None:
    with (
        websocket_server(says(serialize(Error(code, "Title", "because")))) as url,
        pytest.raises(kind, match="because"),
    ):
        follow(url, asynchronous)


def test_another_subprotocol(asynchronous: bool) -> None:
    # The libraries refuse a subprotocol that was not offered, so what is left to see is none at all.
    with (
        websocket_server(says(), subprotocol=None) as url,
        pytest.raises(RemoteProtocolError, match="got no subprotocol"),
    ):
        follow(url, asynchronous)


def test_a_server_that_does_not_take_leave(asynchronous: bool, container_file: Path) -> None:
    data = container_file.read_bytes()
    header = header_of(data, len(data))
    slices = [serialize(Segments(at, data[at : at + 60_000])) for at in range(0, len(data), 60_000)]
    heard, left = list[bytes | str](), threading.Event()

    def behave(connection: ServerConnection) -> None:
        for message in (header, *slices, serialize(End("complete"))):
            connection.send(message)
        try:
            heard.extend(connection)
        finally:
            left.set()

    with websocket_server(behave) as url:
        follow(url, asynchronous, window=BASE_CREDIT, close_timeout=1e6)  # nor is it waited for
    assert left.wait(PATIENCE)
    assert heard[-1] == serialize(Bye())


@pytest.mark.parametrize(
    ("answer", "kind", "words"),
    [
        (b"", RemoteProtocolError, "does not answer like a Lodestream"),
        (b"SSH-2.0-OpenSSH_9.2\r\n", RemoteProtocolError, "does not answer like a Lodestream"),
        (b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n", ls.NotFoundError, "404 Not Found"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\n\r\n", ls.RemoteError, "200 OK"),
        (
            b"HTTP/1.1 403 Forbidden\r\nContent-Type: application/problem+json\r\nContent-Length: 43\r\n\r\n"
            b'{"code":"no-token","detail":"no token came"',
            ls.RemoteError,
            "403 Forbidden",
        ),
        (
            b"HTTP/1.1 403 Forbidden\r\nContent-Type: application/problem+json\r\nContent-Length: 44\r\n\r\n"
            b'{"code":"no-token","detail":"no token came"}',
            ls.RemoteError,
            "no token came",
        ),
    ],
)
def test_what_is_no_lodestream_server(asynchronous: bool, answer: bytes, kind: type[Exception], words: str) -> None:
    with tcp_server(answer) as url, pytest.raises(kind, match=words):
        follow(f"{url}/v1/surfaces/ab", asynchronous)


@pytest.mark.parametrize(
    ("answer", "kind", "words"),
    [
        (b"", RemoteProtocolError, "does not answer like a Lodestream"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\nhi", RemoteProtocolError, "expected a JSON object"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 2\r\n\r\n{}", RemoteProtocolError, "expected a list of surfaces"),
        (b"HTTP/1.1 413 Too Large\r\nContent-Length: 2\r\n\r\n[]", ls.TooLargeError, "413 Too Large"),
        (b"HTTP/1.1 503 Busy\r\nContent-Length: 0\r\n\r\n", ls.RemoteError, "503 Busy"),
        (
            b"HTTP/1.1 200 OK\r\nContent-Length: 99\r\n\r\n{",
            RemoteProtocolError,
            "does not answer like a Lodestream server",
        ),
    ],
)
def test_http_answers_that_are_none(answer: bytes, kind: type[Exception], words: str) -> None:
    with tcp_server(answer) as url:
        with pytest.raises(kind, match=words):
            Client(url).list()
        with pytest.raises(kind, match=words):
            asyncio.run(asked(url, lambda it: it.list()))


def test_a_range_that_is_ignored_is_not_obeyed() -> None:
    with (
        tcp_server(b"HTTP/1.1 200 OK\r\nContent-Length: 5\r\n\r\nwhole") as url,
        pytest.raises(RemoteProtocolError, match="Range is not supported"),
    ):
        Client(f"{url}/v1/surfaces/ab").fetch_range(f"{url}/v1/surfaces/ab", 0, 2)


def test_silence_is_settable_and_positive() -> None:
    stream = AsyncClient("http://127.0.0.1:9").connect("ab", silence=5.0)
    stream.silence = 0.5
    assert stream.silence == 0.5
    with pytest.raises(ValueError, match="positive"):
        stream.silence = 0.0
