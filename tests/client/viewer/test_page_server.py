"""The file server of `lodestream view`: the page and one container, for one browser of this machine."""

from __future__ import annotations

import contextlib
import http.client
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream import page
from lodestream.errors import RemoteProtocolError
from lodestream_client.viewer.page_server import PageServer, byte_range, serving
from lodestream_client.viewer.sources import FileSource

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
    return httpx.get(server.url + path, headers={key.replace("_", "-"): value for key, value in headers.items()})


def test_the_page_and_what_it_is_to_show(server: PageServer) -> None:
    home = get(server)
    assert (home.status_code, home.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert {key: home.headers[key] for key in page.HEADERS} == page.HEADERS
    assert get(server, "assets/main-1.js").text == "export {}"
    assert get(server, if_none_match=home.headers["etag"]).status_code == 304
    surface = {"name": "hills", "src": "surface.lode", "bytes": len(DATA)}
    assert get(server, "view.json").json() == {"surfaces": [surface], "live": True}


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
    head = httpx.head(server.url + "surface.lode")
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
        assert httpx.get(root + path).status_code == 404
    assert httpx.get(f"{server.url}../../etc/passwd").status_code == 404
    assert httpx.post(server.url + "surface.lode").status_code == 501


def test_a_name_that_leads_here_is_not_ours(server: PageServer) -> None:
    assert get(server, "surface.lode", host=f"evil.example:{server.server_port}").status_code == 421
    assert get(server, "surface.lode", host=f"localhost:{server.server_port}").content == DATA


class _Failing:
    """Has so many bytes, and no more."""

    name, size, tag = "failing", 100, "a"

    def __init__(self, has: int) -> None:
        self._has = has

    def read(self, offset: int, length: int) -> bytes:
        if offset >= self._has:
            raise RemoteProtocolError("expected more, got nothing")
        return b"x" * min(length, self._has - offset)


def test_a_source_that_fails_is_an_error_or_a_connection_cut_short(server: PageServer) -> None:
    server.source = _Failing(0)
    refused = get(server, "surface.lode")
    assert (refused.status_code, refused.text) == (502, "expected more, got nothing\n")
    server.source = _Failing(60)
    with closing(http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=10)) as connection:
        connection.request("GET", f"/{server.word}/surface.lode")
        with connection.getresponse() as response, pytest.raises(http.client.IncompleteRead) as cut:
            response.read()
    assert cut.value.partial == b"x" * 60


def test_the_body_of_a_request_is_no_request(server: PageServer) -> None:
    inner = f"GET {server.url} HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode()
    head = f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{server.server_port}\r\nContent-Length: {len(inner)}\r\n\r\n".encode()
    with socket.create_connection(("127.0.0.1", server.server_port), timeout=10) as connection:
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
