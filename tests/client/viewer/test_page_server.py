"""The file server of `lodestream open`: the page and one container, for one browser of this machine."""

from __future__ import annotations

import contextlib
import http.client
import socket
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream import page
from lodestream.errors import RemoteProtocolError
from lodestream.opening.byte_sources import FileSource
from lodestream_client.viewer import page_server
from lodestream_client.viewer.page_server import PageServer, byte_range, serving
from tests.patience import PATIENCE

DATA = bytes(range(256)) * 9


@pytest.fixture
def server(tmp_path: Path) -> Iterator[PageServer]:
    folder = tmp_path / "page"
    (folder / "assets").mkdir(parents=True)
    (folder / page.INDEX).write_text("<!doctype html><title>page</title>")
    (folder / "assets" / "main-1.js").write_text("export {}")
    container = tmp_path / "hills.lode"
    container.write_bytes(DATA)
    made = PageServer(page.assets(folder), "hills")
    made.source = FileSource(container)
    with serving(made):
        yield made


def get(server: PageServer, path: str = "", **headers: str) -> httpx.Response:
    named = {key.replace("_", "-"): value for key, value in headers.items()}
    return httpx.get(server.url + path, headers=named, timeout=PATIENCE)


def test_the_page_and_what_it_is_to_show(server: PageServer) -> None:
    home = get(server)
    assert (home.status_code, home.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert {key: home.headers[key] for key in page.HEADERS} == page.HEADERS
    assert get(server, "assets/main-1.js").text == "export {}"
    assert get(server, if_none_match=home.headers["etag"]).status_code == 304
    surface = {"name": "hills", "src": "surface.lode", "bytes": len(DATA)}
    assert get(server, "view.json").json() == {"surfaces": [surface]}


def test_while_it_is_encoded_the_page_is_there_and_the_container_is_not(server: PageServer) -> None:
    server.source, server.progress = None, 0.25
    assert get(server, "view.json").json()["surfaces"] == [{"name": "hills", "src": "surface.lode", "progress": 0.25}]
    assert get(server).status_code == 200
    assert get(server, "surface.lode").status_code == 404


def test_ranges_of_the_container(server: PageServer) -> None:
    whole = get(server, "surface.lode")
    assert (whole.status_code, whole.content, whole.headers["accept-ranges"]) == (200, DATA, "bytes")
    part = get(server, "surface.lode", range="bytes=100-299")
    assert (part.status_code, part.content) == (206, DATA[100:300])
    assert part.headers["content-range"] == f"bytes 100-299/{len(DATA)}"
    assert get(server, "surface.lode", range="bytes=-7").content == DATA[-7:]
    beyond = get(server, "surface.lode", range=f"bytes={len(DATA)}-")
    assert (beyond.status_code, beyond.headers["content-range"]) == (416, f"bytes */{len(DATA)}")
    assert get(server, "surface.lode", range="bytes=0-9", if_range='"another"').content == DATA
    assert get(server, "surface.lode", range="bytes=0-9", if_range=whole.headers["etag"]).content == DATA[:10]
    head = httpx.head(server.url + "surface.lode", timeout=PATIENCE)
    assert (head.status_code, head.headers["content-length"], head.content) == (200, str(len(DATA)), b"")


@given(st.integers(1, 50), st.integers(0, 60), st.integers(0, 60))
def test_a_range_is_what_slices_are(size: int, first: int, last: int) -> None:
    try:
        found = byte_range(f"bytes={first}-{last}", size)
    except ValueError:
        assert first >= size
        return
    if last < first:
        assert found is None
    else:
        assert found is not None
        assert list(range(size))[slice(*found)] == list(range(size))[first : last + 1]


@pytest.mark.parametrize("header", [None, "", "bytes=", "bytes=-", "bytes=a-b", "bytes=0-1,5-6", "items=0-1"])
def test_what_is_no_single_range_is_answered_with_everything(header: str | None) -> None:
    assert byte_range(header, 10) is None


def test_who_does_not_know_the_word_gets_nothing(server: PageServer) -> None:
    root = f"http://127.0.0.1:{server.server_port}"
    for path in ("/", "/surface.lode", "/view.json", f"/{'x' * len(server.word)}/surface.lode", f"/{server.word}"):
        assert httpx.get(root + path, timeout=PATIENCE).status_code == 404
    assert httpx.get(f"{server.url}../../etc/passwd", timeout=PATIENCE).status_code == 404
    assert httpx.post(server.url + "surface.lode", timeout=PATIENCE).status_code == 501


def test_a_name_that_leads_here_is_not_ours(server: PageServer) -> None:
    assert get(server, "surface.lode", host=f"evil.example:{server.server_port}").status_code == 421
    assert get(server, "surface.lode", host=f"localhost:{server.server_port}").content == DATA


class _Failing:
    """Has so many bytes, and no more."""

    place, name, size, tag, gap = "memory", "failing", 100, "a", 0

    def __init__(self, has: int) -> None:
        self._has = has

    def read(self, offset: int, length: int) -> bytes:
        if offset >= self._has:
            raise RemoteProtocolError("expected more, got nothing")
        return b"x" * min(length, self._has - offset)

    def close(self) -> None:
        pass


def test_a_source_that_fails_is_an_error_or_a_connection_cut_short(server: PageServer) -> None:
    server.source = _Failing(0)
    refused = get(server, "surface.lode")
    assert (refused.status_code, refused.text) == (502, "expected more, got nothing\n")
    server.source = _Failing(60)
    with closing(http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=PATIENCE)) as connection:
        connection.request("GET", f"/{server.word}/surface.lode")
        with connection.getresponse() as response, pytest.raises(http.client.IncompleteRead) as cut:
            response.read()
    assert cut.value.partial == b"x" * 60


def test_the_body_of_a_request_is_no_request(server: PageServer) -> None:
    inner = f"GET {server.url} HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode()
    head = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\nContent-Length: {len(inner)}\r\n\r\n".encode()
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=PATIENCE) as connection:
        connection.sendall(head + inner)
        said = bytearray()
        with contextlib.suppress(ConnectionResetError):  # what was not read is answered by a reset
            while data := connection.recv(4096):
                said += data
    assert said.count(b"HTTP/1.1 ") == 1


def test_a_container_of_no_bytes(server: PageServer) -> None:
    server.source = _Failing(0)
    server.source.size = 0
    assert get(server, "surface.lode").content == b""


def said_to(server: PageServer, request: bytes) -> bytes:
    """All that is answered on a connection that sends these bytes and then no more."""
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=PATIENCE) as connection:
        connection.sendall(request)
        connection.shutdown(socket.SHUT_WR)
        said = bytearray()
        with contextlib.suppress(ConnectionResetError):  # what was not read is answered by a reset
            while data := connection.recv(4096):
                said += data
    return bytes(said)


def head_of(said: bytes) -> tuple[int, dict[str, str]]:
    """Status and headers of an answer, whose names are lowered; each stands once."""
    line, *fields = said.partition(b"\r\n\r\n")[0].decode().split("\r\n")
    named = [(name.lower(), value.strip()) for name, _, value in (field.partition(":") for field in fields)]
    assert len(dict(named)) == len(named)
    assert line.startswith("HTTP/1.1 ")
    return int(line.split()[1]), dict(named)


@pytest.mark.parametrize(
    ("line", "fields", "status"),
    [
        ("{path}", ["Host: {host}"], 200),
        ("{path}", ["Host: LOCALHOST:{port}"], 200),
        ("http://{host}{path}", ["Host: {host}"], 200),
        ("HTTP://localhost:{port}{path}?q", ["host:{host}"], 200),
        ("{path}", [], 421),
        ("{path}", ["Host:"], 421),
        ("{path}", ["Host: evil.example:{port}"], 421),
        ("{path}", ["Host: 127.0.0.1"], 421),
        ("{path}", ["Host: {host}", "Host: evil.example"], 421),
        ("{path}", ["Host: evil.example", "Host: {host}"], 421),
        ("{path}", ["Host: {host}", "Accept: */*", "HOST: evil.example"], 421),
        ("{path}", ["Host: {host}", " evil.example"], 421),
        ("{path}", ["Host: {host}, evil.example"], 421),
        ("{path}", ["Host: user@{host}"], 421),
        ("{path}", ["Host: {host}", "Host: {host}"], 400),
        ("{path}", ["Host: {host}", "Host : evil.example"], 400),
        ("{path}", ["Host: {host}", "no field", "Host: evil.example"], 400),
        ("{path}", ["Host: {host}", "\r", "Host: evil.example"], 400),
        ("{path}", ["Host: {host}", ": evil.example"], 400),
        ("http://evil.example{path}", ["Host: {host}"], 421),
        ("https://{host}@evil.example{path}", ["Host: {host}"], 421),
        ("http://{host}{path}", ["Host: evil.example"], 421),
        ("http://{host}{path}", [], 421),
        ("http://evil.example{path}", [], 421),
    ],
)
@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_every_name_of_the_host_is_compared(
    server: PageServer, method: str, line: str, fields: list[str], status: int
) -> None:
    names = {"host": f"127.0.0.1:{server.server_port}", "port": server.server_port, "path": f"/{server.word}/view.json"}
    lines = [f"{method} {line} HTTP/1.1", *fields, "Connection: close", "", ""]
    said = said_to(server, "\r\n".join(lines).format(**names).encode())
    told, headers = head_of(said)
    assert told == status
    assert headers.items() >= page.HEADERS.items()
    assert (b'"surfaces"' in said) is (status == 200 and method == "GET")


@pytest.mark.parametrize(
    ("request_head", "status"),
    [
        ("POST {path} HTTP/1.1\r\nHost: {host}", 501),
        ("<b>x</b> {path} HTTP/1.1\r\nHost: {host}", 501),
        ("GET {path} HTTP/1.1\r\nHost: {host}\r\nX: " + 70_000 * "x", 431),
        ("GET {path} HTTP/1.1\r\nHost: {host}" + 200 * "\r\nX: x", 431),
        ("GET {path} HTTP/2.0\r\nHost: {host}", 505),
        ("GET {path} HTTP/x\r\nHost: {host}", 400),
        ("GET {path} <b>x</b> HTTP/1.1\r\nHost: {host}", 400),
        ("GET", 400),
        ("GET {path}\r\nHost: {host}", 400),
        ("POST {path}", 400),
        ("GET /" + 70_000 * "x" + " HTTP/1.1\r\nHost: {host}", 414),
        ("GET /other HTTP/1.1\r\nHost: {host}", 404),
        ("GET /other HTTP/1.1\r\nHost: evil.example", 421),
        ("GET /{word}/surface.lode HTTP/1.1\r\nHost: {host}\r\nRange: bytes=9999999-", 416),
        ("GET {path} HTTP/1.1\r\nHost: {host}", 200),
        ("GET {path} HTTP/1.0\r\nHost: {host}", 200),
    ],
)
def test_every_answer_has_the_headers_of_the_page_and_no_banner(
    server: PageServer, request_head: str, status: int
) -> None:
    host, word = f"127.0.0.1:{server.server_port}", server.word
    asked = request_head.format(host=host, word=word, path=f"/{word}/view.json")
    said = said_to(server, f"{asked}\r\n\r\n".encode())
    told, headers = head_of(said)
    assert told == status
    assert headers.items() >= page.HEADERS.items()
    assert "server" not in headers
    assert b"Python" not in said
    assert b"<" not in said.partition(b"\r\n\r\n")[2]
    assert status == 200 or headers.get("content-type", "text/plain; charset=utf-8") == "text/plain; charset=utf-8"


def test_what_is_behind_a_source_fails_with_the_headers_of_the_page(server: PageServer) -> None:
    server.source = _Failing(0)
    refused = get(server, "surface.lode")
    assert refused.status_code == 502
    assert refused.headers.items() >= page.HEADERS.items()
    assert "server" not in refused.headers


def test_however_many_connect_threads_are_bounded_and_the_page_is_there(
    server: PageServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    most, lock = page_server.MOST_CONNECTIONS, threading.Lock()
    now = peak = 0

    class Counted(page_server._Handler):
        def handle(self) -> None:
            nonlocal now, peak
            with lock:
                now += 1
                peak = max(peak, now)
            try:
                super().handle()
            finally:
                with lock:
                    now -= 1

    monkeypatch.setattr(server, "RequestHandlerClass", Counted)
    place = ("127.0.0.1", server.server_port)
    with contextlib.ExitStack() as stack:
        silent = []
        for number in range(3 * most):
            silent.append(stack.enter_context(socket.create_connection(place, timeout=PATIENCE)))
            if number % 2:
                silent[-1].sendall(b"GET / HT")  # the beginning of a request is none
            if number % most == 7:
                assert get(server).status_code == 200
        # Those that have been silent for longest have made room.
        for connection in silent[:most]:
            with contextlib.suppress(ConnectionResetError):
                assert connection.recv(1) == b""
        assert get(server).status_code == 200
    assert peak == most


def test_an_answer_under_way_makes_no_room(server: PageServer) -> None:
    most = page_server.MOST_CONNECTIONS
    begun, go_on = threading.Semaphore(0), threading.Event()

    class Slow(_Failing):
        def read(self, offset: int, length: int) -> bytes:
            begun.release()
            assert go_on.wait(PATIENCE)
            return super().read(offset, length)

    server.source = Slow(100)
    asked = f"GET /{server.word}/surface.lode HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode()
    place = ("127.0.0.1", server.server_port)
    with contextlib.ExitStack() as stack:
        busy = [stack.enter_context(socket.create_connection(place, timeout=PATIENCE)) for _ in range(most)]
        for connection in busy:
            connection.sendall(asked)
            assert begun.acquire(timeout=PATIENCE)
        refused = said_to(server, b"")
        told, headers = head_of(refused)
        assert told == 503
        assert headers.items() >= page.HEADERS.items()
        assert "server" not in headers
        go_on.set()
        for connection in busy:
            said = bytearray()
            while not said.endswith(100 * b"x"):
                data = connection.recv(4096)
                assert data
                said += data
            assert head_of(bytes(said))[0] == 200
        assert get(server, "surface.lode").content == 100 * b"x"
