"""Connections and streams that dawdle, and requests that do not end where they say."""

from __future__ import annotations

import asyncio
import gc
import json
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
import uvicorn
from starlette.types import Receive, Scope, Send
from uvicorn.server import ServerState
from websockets.exceptions import ConnectionClosed

import lodestream as ls
from lodestream.protocol.connection import State
from lodestream.protocol.messages import CODES, Credit, End, Error, Event, Open, Opened, Segments, Stop
from lodestream.transfer.sender import Sender
from lodestream_server import running_server
from lodestream_server.connections import connections
from lodestream_server.connections.cuts import Cuts
from lodestream_server.connections.slow_readers import Answers
from lodestream_server.operation.least_rate import LeastRate
from lodestream_server.operation.metrics import Metrics
from lodestream_server.operation.pace import Pace
from lodestream_server.operation.settings import Settings
from tests.server.helpers import PATIENCE, closed, eventually, hills, kept, listed, npy, push, raw_stream

SECONDS = 3.0


@pytest.fixture(scope="module")
def impatient(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, dict[str, Any]]]:
    """A server that waits for nobody, and a surface on it that no buffer takes whole."""
    data = tmp_path_factory.mktemp("data")
    # Built by one that is patient, which does not mind how busy this machine is.
    with running_server(data, workers=1) as url, httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
        made = push(http, npy(hills(700, 700)))
    # Not so short that a machine which does several other things keeps somebody waiting who is in time.
    with running_server(data, workers=1, head_seconds=SECONDS, idle_seconds=SECONDS, bye_seconds=SECONDS) as url:
        yield url, made


def connected(url: str, buffer: int | None = None) -> socket.socket:
    address = urlsplit(url)
    assert address.hostname is not None
    connection = socket.socket()
    if buffer is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer)
    connection.settimeout(PATIENCE)
    connection.connect((address.hostname, address.port))
    return connection


def all_of(connection: socket.socket) -> bytes:
    """What comes until the other side closes, or breaks the connection."""
    data = b""
    try:
        while piece := connection.recv(1 << 20):
            data += piece
    except ConnectionResetError:
        pass
    return data


def one_of(connection: socket.socket) -> bytes:
    """The next answer, whole."""
    data = b""
    while b"\r\n\r\n" not in data:
        data += connection.recv(1)
    found = re.search(rb"content-length: (\d+)", data)
    assert found is not None
    for _ in range(int(found[1])):
        data += connection.recv(1)
    return data


def status_of(answer: bytes) -> int:
    return int(answer.split(b" ", 2)[1])


def test_a_head_that_does_not_come_is_not_waited_for(impatient: tuple[str, Any]) -> None:
    with ExitStack() as held:
        waiting = [held.enter_context(connected(impatient[0])) for _ in range(3)]
        for connection, sent in zip(waiting, (b"", b"GET /hea", b"GET / HTTP/1.1\r\nHost: localhost\r\n"), strict=True):
            connection.sendall(sent)
        for connection in waiting:
            answer = all_of(connection)
            assert status_of(answer) == 408
            assert json.loads(answer.partition(b"\r\n\r\n")[2])["code"] == "idle"


def test_a_head_that_comes_byte_by_byte_is_late_too(impatient: tuple[str, Any]) -> None:
    with connected(impatient[0]) as connection:
        connection.settimeout(0.02)
        answer = b""
        for _ in range(10_000):
            try:
                connection.sendall(b"X")
                answer = connection.recv(4096)
            except TimeoutError:
                continue
            except (ConnectionResetError, BrokenPipeError):
                pass
            break
        else:
            pytest.fail("the server waits and waits")
    assert not answer or status_of(answer) == 408


def test_the_next_head_is_not_waited_for_either(impatient: tuple[str, Any]) -> None:
    with connected(impatient[0]) as connection:
        for _ in range(2):
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert status_of(one_of(connection)) == 200
        connection.sendall(b"GET /hea")
        assert status_of(all_of(connection)) == 408


def test_a_body_that_nobody_wants_any_more_is_not_waited_for(impatient: tuple[str, Any]) -> None:
    with connected(impatient[0]) as connection:
        connection.sendall(
            b"POST /v1/surfaces HTTP/1.1\r\nHost: example.org\r\nContent-Length: 1000000\r\n\r\nbeginning"
        )
        assert status_of(all_of(connection)) == 401


def test_the_rest_of_a_body_that_was_answered_is_not_waited_for_either(impatient: tuple[str, Any]) -> None:
    with connected(impatient[0]) as connection:
        connection.sendall(b"POST /nothing HTTP/1.1\r\nHost: localhost\r\nContent-Length: 60000\r\n\r\n")
        assert status_of(one_of(connection)) == 404
        try:
            for _ in range(1000):
                connection.sendall(b"x")
                time.sleep(0.02)
        except (ConnectionResetError, BrokenPipeError):
            return
        pytest.fail("the server waits and waits")


def test_an_answer_that_nobody_takes_is_given_up(impatient: tuple[str, dict[str, Any]]) -> None:
    url, made = impatient
    address = f"/v1/containers/{made['container_sha256']}.lode"
    with connected(url, buffer=4096) as connection:
        # Several times over, so that no system's buffers hold it all.
        connection.sendall(f"GET {address} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode() * 8)

        def given_up() -> bool:
            try:
                connection.send(b"GET / HTTP/1.1\r\n")
            except OSError:
                return True
            return False

        eventually(given_up, "the connection to be closed")
    eventually(lambda: not opened(made["container_sha256"]), "the file to be closed")


def opened(name: str) -> bool:
    folder = Path("/proc/self/fd")
    if not folder.exists():
        pytest.skip("this system does not list open files in /proc")
    for link in folder.iterdir():
        try:
            if name in str(link.readlink()):
                return True
        except OSError:
            continue
    return False


def test_an_answer_that_is_taken_slowly_comes_whole(impatient: tuple[str, dict[str, Any]]) -> None:
    url, made = impatient
    address = f"/v1/containers/{made['container_sha256']}.lode"
    with connected(url, buffer=16384) as connection:
        connection.sendall(f"GET {address} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
        data = bytearray()
        while piece := connection.recv(4096):
            data += piece
    assert len(data.partition(b"\r\n\r\n")[2]) == made["bytes"]


def test_an_answer_that_is_taken_too_slowly_is_cut(tmp_path: Path) -> None:
    with (
        running_server(tmp_path, workers=1) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        made = push(http, npy(hills(700, 700)))
    # No client reads so fast.
    with (
        running_server(tmp_path, workers=1, idle_seconds=0.2, least_rate=10**15) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        request = f"GET /v1/containers/{made['container_sha256']}.lode HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
        with connected(url, buffer=4096) as connection:
            connection.sendall(request * 8)
            came = 0

            def cut() -> bool:
                nonlocal came
                came += len(connection.recv(2048))
                return 'kind="slow-answer"' in http.get("/metrics").text

            # It reads all the time, and never stops for as long as the limit says.
            eventually(cut, "the connection to be cut")
            # What the system had taken before comes fast through a larger buffer.
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
            with suppress(ConnectionResetError):
                while piece := connection.recv(1 << 20):
                    came += len(piece)
        assert came < 8 * made["bytes"]
        # What fits into the system's buffers waits for nobody.
        assert http.get(made["url"]).status_code == 200


class Slow:
    """A transport and a loop whose clock stands until a test moves it."""

    def __init__(self) -> None:
        self.now, self.unsent, self.closing, self.aborted = 0.0, 0, False, False
        self.timers: list[tuple[float, Callable[[], None]]] = []
        self.told: list[bool] = []

    def time(self) -> float:
        return self.now

    def call_later(self, seconds: float, work: Callable[[], None]) -> None:
        self.timers.append((self.now + seconds, work))

    def get_write_buffer_size(self) -> int:
        return self.unsent

    def get_extra_info(self, name: str) -> socket.socket:
        closed = socket.socket()
        closed.close()
        return closed

    def is_closing(self) -> bool:
        return self.closing

    def write(self, data: bytes) -> None:
        self.unsent += len(data)

    def close(self) -> None:
        self.closing = True

    def abort(self) -> None:
        self.aborted = True

    def advance(self, seconds: float) -> None:
        self.now += seconds
        due = [timer for timer in self.timers if timer[0] <= self.now]
        self.timers = [timer for timer in self.timers if timer[0] > self.now]
        for _, work in due:
            work()


def watched(rate: int, seconds: float = 10.0) -> tuple[Slow, Answers]:
    slow: Any = Slow()
    return slow, Answers(
        slow, slow, seconds, LeastRate(rate, seconds, slow.time), lambda: slow.told.append(slow.aborted)
    )


@pytest.mark.parametrize(
    ("rate", "taken", "stays"), [(100, 1000, True), (100, 990, False), (0, 1, True), (0, 0, False)]
)
@pytest.mark.parametrize("ending", [False, True])
def test_an_answer_has_a_least_rate(rate: int, taken: int, stays: bool, ending: bool) -> None:
    slow, watch = watched(rate)
    watch.write(bytes(1 << 20))
    for _ in range(20):
        slow.unsent -= taken
        # What is told to close first sends what it holds.
        slow.closing = ending
        slow.advance(10)
    assert slow.aborted is not stays
    assert slow.told == ([] if stays else [False])


def test_time_in_which_nothing_waits_for_the_client_does_not_count() -> None:
    slow, watch = watched(100)
    for _ in range(20):
        # The server has something to say only now and then, and just before the look.
        slow.advance(9)
        watch.write(bytes(5000))
        slow.advance(1)
        assert not slow.aborted
        slow.unsent = 0
        watch.write(b"x")
        slow.unsent = 0
    slow.unsent = 0
    watch.write(bytes(5000))
    watch.write(bytes(5000))  # what is added while something waits changes nothing
    slow.advance(10)
    slow.advance(10)
    assert slow.aborted


def test_time_in_which_the_server_is_held_up_does_not_count() -> None:
    slow, watch = watched(100)
    watch.write(bytes(1 << 20))
    for _ in range(5):
        slow.advance(100)  # the look comes late
        assert not slow.aborted
    slow.advance(10)
    assert slow.aborted


def test_a_silent_client_is_closed_with_a_reason(impatient: tuple[str, dict[str, Any]]) -> None:
    url, made = impatient
    silent: list[tuple[list[Event], str]] = [
        ([], "No open came"),
        ([Open(credit=100)], "Neither credit nor stop"),
        ([Open(ls.Target(level=0))], "Neither bye nor another open came"),
    ]
    with ExitStack() as held:
        streams = []
        for messages, _ in silent:
            streams.append(held.enter_context(raw_stream(url + made["url"])))
            for message in messages:
                streams[-1].send(message)
        for stream, (_, words) in zip(streams, silent, strict=True):
            event = stream.receive()
            while not isinstance(event, Error):
                event = stream.receive()
            assert event.code == "idle"
            assert words in event.detail
            assert closed(stream, CODES["idle"].close).startswith("idle")


def test_a_stream_whose_client_speaks_now_and_then_outlives_the_clocks(impatient: tuple[str, dict[str, Any]]) -> None:
    url, made = impatient
    with raw_stream(url + made["url"]) as stream:
        stream.send(Open(credit=1))
        assert isinstance(stream.receive(), Opened)
        over = time.monotonic() + 1.5 * SECONDS
        while time.monotonic() < over:  # longer in all than a head or a silence may take
            assert isinstance(stream.receive(), Segments)
            with pytest.raises(TimeoutError):
                stream.socket.recv(timeout=0.03)
            stream.send(Credit(1))
        stream.send(Stop())
        assert stream.until_end()[-1] == End("stopped")
        assert closed(stream, 1000) == "stopped"


def test_a_body_longer_than_it_says_is_cut_there(http: httpx.Client, server: str) -> None:
    body = npy(hills(9, 8, seed=31))
    with connected(server) as connection:
        head = f"POST /v1/surfaces HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(body)}\r\n\r\n".encode()
        connection.sendall(head + body + b"and more of it, which is no request\r\n\r\n")
        answer = all_of(connection)
    assert status_of(answer) in (200, 202)
    document = json.loads(answer.partition(b"\r\n\r\n")[2].partition(b"HTTP/1.1")[0])
    assert document["upload_bytes"] == len(body)
    # What followed was taken for a request, and was none.
    assert b"HTTP/1.1 400" in answer


def test_a_body_shorter_than_it_says_is_nothing(http: httpx.Client, server: str, data: Path) -> None:
    before = listed(http)
    with connected(server) as connection:
        connection.sendall(b"POST /v1/surfaces HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\nshort")
        connection.shutdown(socket.SHUT_WR)
        all_of(connection)
    eventually(lambda: not kept(data, "scratch/incoming"), "the upload's folder to be removed")
    assert listed(http) == before


@pytest.mark.parametrize(
    "head",
    [
        b"POST /v1/surfaces HTTP/1.1\r\nHost: localhost\r\nContent-Length: 5\r\nContent-Length: 6\r\n\r\nhello",
        b"POST /v1/surfaces HTTP/1.1\r\nHost: localhost\r\nContent-Length: -5\r\n\r\nhello",
        b"POST /v1/surfaces HTTP/1.1\r\nHost: localhost\r\nContent-Length: five\r\n\r\nhello",
        b"POST /v1/surfaces HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\nZZ\r\nhello\r\n",
        b"POST /v1/surfaces HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: gzip\r\n\r\nhello",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nHost: example.org\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: localhost\r\nX: a\0b\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n\r\n",
    ],
)
def test_what_is_no_request_is_refused(impatient: tuple[str, Any], head: bytes) -> None:
    with connected(impatient[0]) as connection:
        with suppress(ConnectionResetError, BrokenPipeError):  # it may be refused before all of it was sent
            connection.sendall(head)
        answer = all_of(connection)
    assert not answer or 400 <= status_of(answer) < 500


@pytest.mark.parametrize("method", ["GET", "HEAD", "POST", "DELETE"])
@pytest.mark.parametrize(
    ("version", "framing"),
    [
        ("1.1", "Content-Length: 5\r\nTransfer-Encoding: chunked"),
        ("1.1", "Transfer-Encoding: Chunked\r\nContent-Length: 0"),
        ("1.1", "transfer-encoding: chunked\r\nX: y\r\ncontent-length: 5, 5"),
        ("1.0", "Content-Length: 5\r\nTransfer-Encoding: chunked"),
        ("1.0", "Transfer-Encoding: chunked"),
    ],
)
def test_a_body_whose_length_is_told_in_two_ways_is_refused(
    http: httpx.Client, server: str, method: str, version: str, framing: str
) -> None:
    before = listed(http)
    head = f"{method} /v1/surfaces HTTP/{version}\r\nHost: localhost\r\n{framing}\r\n\r\n".encode()
    with connected(server) as connection:
        # Which of the two a proxy takes decides where it sees the next request: here nobody sees one.
        connection.sendall(head + b"0\r\n\r\nGET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        answer = all_of(connection)
    assert len(re.findall(rb"HTTP/1.1 \d", answer)) == 1
    assert status_of(answer) == 400
    assert b"connection: close" in answer.lower()
    body = answer.partition(b"\r\n\r\n")[2]
    if method == "HEAD":
        assert body == b""
    else:
        document = json.loads(body)
        assert document["code"] == "bad-request"
        assert "Transfer-Encoding" in document["detail"]
    assert listed(http) == before


@pytest.mark.parametrize(
    "header",
    [
        "bytes=" + ",".join(f"{number}-{number}" for number in range(10_000)),
        "bytes=" + "0-," * 10_000 + "0-",
        "bytes=" + ",".join(["-1"] * 10_000),
    ],
)
def test_ten_thousand_ranges_cost_no_more_than_the_file(impatient: tuple[str, dict[str, Any]], header: str) -> None:
    url, made = impatient
    address = f"/v1/containers/{made['container_sha256']}.lode"
    with connected(url) as connection:
        with suppress(ConnectionResetError, BrokenPipeError):  # it may be refused before all of it was sent
            connection.sendall(
                f"GET {address} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\nRange: {header}\r\n\r\n".encode()
            )
        answer = all_of(connection)
    # Whether the server's buffer for heads holds it depends on how the network cuts it.
    assert status_of(answer) in (200, 400)
    assert len(answer) <= made["bytes"] + 2000


def test_a_reset_while_an_answer_ends_is_no_error_of_the_server(tmp_path: Path) -> None:
    ended = list[BaseException | None]()

    async def answered() -> None:
        loop, client = asyncio.get_running_loop(), socket.socket()

        async def app(scope: Scope, receive: Receive, send: Send) -> None:
            await receive()
            try:
                await send({"type": "http.response.start", "status": 413, "headers": [(b"content-length", b"1")]})
                await send({"type": "http.response.body", "body": b"x", "more_body": True})
                # With an answer that nobody has read this is a reset, of which the loop has not heard at the next line.
                client.close()
                await send({"type": "http.response.body", "body": b"", "more_body": False})
            except Exception as error:
                ended.append(error)
            else:
                ended.append(None)

        settings = Settings(data=tmp_path, workers=1)
        kind, _ = connections.connections(settings, Cuts(Metrics()), Pace())
        config = uvicorn.Config(app, http=kind, lifespan="off", log_config=None)
        config.load()
        listening = await loop.create_server(lambda: kind(config, ServerState(), {}), "127.0.0.1", 0)
        async with listening:
            client.setblocking(False)
            await loop.sock_connect(client, listening.sockets[0].getsockname())
            await loop.sock_sendall(client, b"POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 100000\r\n\r\n1")
            async with asyncio.timeout(PATIENCE):
                while not ended:
                    await asyncio.sleep(0.01)

    asyncio.run(answered())
    assert ended == [None]


def test_a_connection_too_many_is_told_to_come_back(tmp_path: Path) -> None:
    with running_server(tmp_path, workers=1, max_connections=3) as url:
        held = [connected(url) for _ in range(3)]
        try:
            for connection in held:
                connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
                assert status_of(one_of(connection)) == 200
            with connected(url) as connection:
                answer = all_of(connection)
            assert status_of(answer) == 503
            assert b"retry-after: " in answer.lower()
            assert json.loads(answer.partition(b"\r\n\r\n")[2])["code"] == "busy"
        finally:
            for connection in held:
                connection.close()

        def room() -> bool:
            with suppress(httpx.TransportError):  # what is refused may be cut before it has asked
                return httpx.get(f"{url}/healthz", trust_env=False, timeout=PATIENCE).status_code == 200
            return False

        eventually(room, "room again")


@pytest.mark.long
def test_a_plan_that_takes_long_is_no_silence_of_the_client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    receive = Sender.receive

    def slow(self: Sender, message: bytes) -> Event:
        if self.state is State.ENDED:
            time.sleep(1.0)
        return receive(self, message)

    monkeypatch.setattr(Sender, "receive", slow)
    with (
        running_server(tmp_path, workers=1, bye_seconds=0.5) as url,
        httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http,
    ):
        address = url + push(http, npy(hills()))["url"]

        def answered() -> bool:
            with suppress(ConnectionClosed), raw_stream(address) as stream:
                stream.send(Open(ls.Target(level=0), 9000))
                while not isinstance(stream.receive(), End):
                    pass
                stream.send(Open(ls.Target(first=((0, 5), (0, 5)))))
                return isinstance(stream.receive(), Opened)
            return False

        # On a machine that does much else, the other open may come too late some time; not always.
        eventually(answered, "the answer to another open")


def test_nothing_of_connections_is_kept_when_they_have_ended(tmp_path: Path) -> None:
    def watches() -> int:
        gc.collect()
        kinds = (Answers, connections._Http, connections._Stream)
        return sum(issubclass(type(item), kinds) for item in gc.get_objects())  # `isinstance` asks weak proxies

    # Patient: what is kept until the next look at a connection would be kept for longer than this waits.
    with running_server(tmp_path, workers=1, idle_seconds=10 * PATIENCE) as url:
        with httpx.Client(base_url=url, trust_env=False, timeout=PATIENCE) as http:
            surface = push(http, npy(hills()))
        before = watches()
        for _ in range(5):
            assert httpx.get(url + surface["url"], trust_env=False, timeout=PATIENCE).status_code == 200
            with raw_stream(url + surface["url"]) as stream:
                stream.send(Open(credit=100_000))
                stream.until_end()
                closed(stream, 1000)
            with raw_stream(url + surface["url"]) as stream:
                stream.socket.socket.close()
        eventually(lambda: watches() <= before, "nothing to be kept of the connections")
