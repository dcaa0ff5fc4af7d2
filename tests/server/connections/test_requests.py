"""Bodies of requests: in chunks, in turn, and after the answer."""

from __future__ import annotations

import itertools
import json
import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import h11
import httpx
import pytest

from tests.server.connections.sockets import Place, chunked
from tests.server.helpers import PATIENCE, eventually, hills, kept, listed, npy


def asked(url: str, data: bytes) -> socket.socket:
    place = Place.of(url)
    connection = socket.create_connection((place.host, place.port), timeout=PATIENCE)
    connection.sendall(data)
    return connection


def answers_of(connection: socket.socket) -> Iterator[h11.Response]:
    """The answers that come one after the other; of each its body has been read."""
    client = h11.Connection(h11.CLIENT)
    while True:
        client.send(h11.Request(method="GET", target="/", headers=[("host", "localhost")]))
        client.send(h11.EndOfMessage())
        while not isinstance(event := client.next_event(), h11.EndOfMessage):
            if event is h11.NEED_DATA:
                client.receive_data(connection.recv(1 << 16))
            elif isinstance(event, h11.Response):
                found = event
        yield found
        client.start_next_cycle()


def test_a_connection_goes_on_where_little_of_a_refused_body_is_to_come(http: httpx.Client, server: str) -> None:
    with asked(server, b"POST /nothing HTTP/1.1\r\nHost: localhost\r\nContent-Length: 60000\r\n\r\n") as connection:
        answers = answers_of(connection)
        answer = next(answers)
        assert answer.status_code == 404
        assert (b"connection", b"close") not in answer.headers
        connection.sendall(bytes(60_000) + b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert next(answers).status_code == 200


@pytest.mark.parametrize("length", [b"Content-Length: 100000", b"Transfer-Encoding: chunked"])
def test_an_answer_to_what_was_not_read_says_that_it_is_the_last(
    http: httpx.Client, server: str, length: bytes
) -> None:
    with asked(server, b"POST /nothing HTTP/1.1\r\nHost: localhost\r\n" + length + b"\r\n\r\n") as connection:
        answer = next(answers_of(connection))
        assert answer.status_code == 404
        assert (b"connection", b"close") in answer.headers
        assert connection.recv(1) == b""


def test_a_client_that_sends_far_too_much_sees_why_it_was_refused(http: httpx.Client, server: str) -> None:
    for content in (bytes(100 << 20), (bytes(1 << 16) for _ in range(1600))):
        answer = http.post("/v1/surfaces", content=content)
        assert answer.status_code == 413
        assert answer.json()["code"] == "too-large"


@pytest.mark.parametrize(
    "body",
    [
        b"5\r\nhello\r\n0\r\n" + b"a: b\r\n" * 50_000,
        b"1;" + b"x" * 50_000,
        b"g\r\n",
    ],
    ids=["trailers", "endless extension", "no number"],
)
def test_chunks_that_are_no_use_are_refused(http: httpx.Client, server: str, data: Path, body: bytes) -> None:
    before = listed(http)
    with asked(server, chunked()) as connection:

        def send() -> None:
            with suppress(OSError):  # it is refused before all of it was sent
                connection.sendall(body)

        sending, answer = threading.Thread(target=send), b""
        sending.start()
        with suppress(ConnectionResetError):  # after the answer
            while piece := connection.recv(1 << 16):
                answer += piece
        sending.join()
    document = json.loads(answer.partition(b"\r\n\r\n")[2])
    assert document["status"] == 400
    assert document["code"] == "bad-request"
    assert listed(http) == before
    eventually(lambda: not kept(data, "scratch/incoming"), "the upload's folder to be removed")


def test_a_head_is_answered_without_a_body_when_its_chunks_are_refused(http: httpx.Client, server: str) -> None:
    with asked(server, chunked(b"HEAD /healthz")) as connection:
        connection.sendall(b"5\r\nhello\r\n")
        assert connection.recv(1 << 16).startswith(b"HTTP/1.1 200")


def test_lines_as_chunks_are_taken(http: httpx.Client) -> None:
    content = npy(hills(50, 40, seed=77))
    pieces = (content[start : start + 24] for start in range(0, len(content), 24))
    assert http.post("/v1/surfaces", content=pieces).status_code == 202


def test_requests_that_come_together_are_answered_in_turn(http: httpx.Client, server: str) -> None:
    upload = npy(hills(50, 40, seed=78))
    head = f"POST /v1/surfaces HTTP/1.1\r\nHost: localhost\r\nContent-Length: {len(upload)}\r\n\r\n".encode()
    get, last = (f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode() for path in ("/healthz", "/nothing"))
    with asked(server, get * 200 + head + upload + get * 1000 + last) as connection:
        statuses = [answer.status_code for answer in itertools.islice(answers_of(connection), 1202)]
    assert statuses == [200] * 200 + [202] + [200] * 1000 + [404]
