"""Streams over real sockets: credit, stop, ends, and clients that misbehave."""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import MutableMapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import msgpack
import numpy as np
import pytest
from fastapi import WebSocket
from uvicorn.protocols.utils import ClientDisconnected
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import lodestream as ls
from lodestream.planning.byte_ranges import RangeSet
from lodestream.protocol.messages import (
    BASE_CREDIT,
    CODES,
    MAX_MESSAGE,
    SUBPROTOCOL,
    Bye,
    Credit,
    End,
    Error,
    Event,
    Layer,
    Open,
    Opened,
    Segments,
    Stop,
)
from lodestream.protocol.wire import serialize
from lodestream.transfer.download import Download, Ended
from lodestream.transfer.sender import Sender
from lodestream_server import running_server
from lodestream_server.operation.metrics import Metrics
from lodestream_server.routes import streams
from tests.core.planning.test_cost import crowded
from tests.server.helpers import PATIENCE, closed, data_of, eventually, hills, npy, problem, push, raw_stream


@pytest.fixture(scope="module")
def points() -> np.ndarray[Any, np.dtype[np.float32]]:
    # Larger than the most credit there is, so that no client gets it all at once.
    return hills(420, 400)


@pytest.fixture(scope="module")
def surface(http: httpx.Client, points: np.ndarray[Any, np.dtype[np.float32]]) -> dict[str, Any]:
    made = push(http, npy(points))
    assert made["bytes"] > BASE_CREDIT + 50_000
    return made


@pytest.fixture(scope="module")
def url(server: str, surface: dict[str, Any]) -> str:
    return server + str(surface["url"])


def download(url: str, target: ls.Target | None = None, window: int = BASE_CREDIT) -> Download:
    """A whole stream through the client's driver."""
    driver = Download(target, window=window)
    with raw_stream(url) as stream:
        while driver.ended is None:
            for message in driver.data_to_send():
                stream.socket.send(message)
            driver.receive(stream.socket.recv(timeout=PATIENCE, decode=False))
        for message in driver.data_to_send():
            stream.socket.send(message)
        closed(stream, 1000)
    return driver


@pytest.mark.parametrize("window", [5000, BASE_CREDIT])
@pytest.mark.parametrize("order", ["quality", "level"])
def test_the_whole_surface_comes_bit_for_bit(url: str, points: Any, window: int, order: Any) -> None:
    driver = download(url, ls.Target(order=order), window)
    assert driver.ended == "complete"
    assert np.array_equal(driver.decoder.surface().points, points)


def test_limits_end_where_the_price_list_says(url: str, surface: dict[str, Any]) -> None:
    layer = surface["layers"][8]
    driver = download(url, ls.Target(until_rms=ls.Tolerance(layer["rms"])))
    assert (driver.ended, driver.decoder.bytes, driver.decoder.rms) == ("rms", layer["bytes"], layer["rms"])
    level = surface["levels"][4]
    driver = download(url, ls.Target(level=4))
    assert (driver.ended, driver.decoder.bytes, driver.decoder.rms) == ("level", level["bytes"], level["rms"])
    assert list(driver.decoder.points_at(4).shape) == level["shape"]


def test_the_messages_come_in_their_order(url: str, surface: dict[str, Any]) -> None:
    with raw_stream(url) as stream:
        stream.send(Open(ls.Target(max_bytes=5000)))
        events = stream.until_end()
        assert closed(stream, 1000) == "bytes"
    header = events[0]
    assert isinstance(header, Opened)
    assert (header.container, header.size) == (surface["container_sha256"], surface["bytes"])
    layers = [event for event in events if isinstance(event, Layer)]
    assert [(layer.bytes, layer.level, layer.rms, layer.max) for layer in layers] == [
        (layer["bytes"], layer["level"], layer["rms"], layer["max"])
        for layer in surface["layers"]
        if layer["bytes"] <= 5000
    ]
    assert header.planned == layers[-1].bytes
    assert {type(event) for event in events[1:-1]} == {Segments, Layer}
    assert events[-1] == End("bytes")


@pytest.mark.parametrize("credit", [0, 1, 10_000, BASE_CREDIT, BASE_CREDIT + 10_000])
def test_a_client_that_grants_no_more_gets_no_more(url: str, credit: int) -> None:
    assert gets_no_more(url, credit, credit).credit is not None


def test_what_is_granted_beyond_what_the_server_keeps_is_forgotten(
    tmp_path: Path, points: np.ndarray[Any, np.dtype[np.float32]]
) -> None:
    with (
        running_server(tmp_path, workers=1, stream_memory=80_000) as server,
        httpx.Client(base_url=server, trust_env=False, timeout=PATIENCE) as http,
    ):
        most = BASE_CREDIT + 10_000  # an eighth of the memory beside what every stream has
        assert gets_no_more(server + str(push(http, npy(points))["url"]), 2**40, most).credit == most


def gets_no_more(url: str, credit: int, granted: int) -> Opened:
    with raw_stream(url) as stream:
        stream.send(Open(credit=credit))
        events: list[Event] = [stream.receive()]
        while data_of(events) < granted:
            events.append(stream.receive())
        # What is left to say without credit is said before the answer to a stop.
        stream.send(Stop())
        rest = stream.until_end()
        assert data_of(events) == granted
        assert data_of(rest) == 0
        assert rest[-1] == End("stopped")
        closed(stream, 1000)
    assert isinstance(events[0], Opened)
    return events[0]


def test_each_grant_is_answered_by_as_much(url: str) -> None:
    with raw_stream(url) as stream:
        stream.send(Open(credit=100))
        events: list[Event] = []
        total = 0
        for grant in (100, 1, 70_000, 33, 5000):
            if total:
                stream.send(Credit(grant))
            total += grant
            while data_of(events) < total:
                events.append(stream.receive())
            assert data_of(events) == total
        stream.send(Stop())
        assert data_of(stream.until_end()) == 0


def test_stop_takes_effect_within_the_credit(url: str) -> None:
    window = 32 * 1024
    with raw_stream(url) as stream:
        stream.send(Open(credit=window))
        received = 0
        while received < window // 2:
            received += data_of([stream.receive()])
        stream.send(Stop())
        events = stream.until_end()
        assert events[-1] == End("stopped")
        assert data_of(events) <= window - received
        assert closed(stream, 1000) == "stopped"


def test_credit_and_stop_after_the_end_are_no_offence(url: str) -> None:
    with raw_stream(url) as stream:
        stream.send(Open(ls.Target(level=0)))
        while not isinstance(stream.receive(), End):
            pass
        stream.send(Credit(5))
        stream.send(Stop())
        stream.send(Bye())
        closed(stream, 1000)


@pytest.mark.parametrize(
    ("messages", "code", "words"),
    [
        ([b"garbage"], "bad-message", "MessagePack"),
        (["text"], "bad-message", "binary"),
        ([serialize(Stop())], "out-of-turn", "got stop"),
        ([serialize(Open()), serialize(Open())], "out-of-turn", "got open"),
        ([serialize(End("complete"))], "out-of-turn", "got end"),
        ([msgpack.packb({"type": "open", "version": 1})], "bad-message", "open.credit"),
        ([msgpack.packb({"type": "open", "version": 9, "credit": 1})], "unsupported-version", "version 1"),
        ([serialize(Open(ls.Target(level=50)))], "bad-target", "got 50"),
        ([serialize(Open(ls.Target(max_bytes=1)))], "bad-target", "got 1"),
        (
            [msgpack.packb({"type": "open", "version": 1, "credit": 1, "target": {"order": "best"}})],
            "bad-target",
            "best",
        ),
        ([serialize(Open(credit=0)), msgpack.packb({"type": "credit", "bytes": -1})], "bad-message", "credit.bytes"),
    ],
)
def test_what_is_not_allowed_is_answered_and_closed(
    url: str, messages: list[str | bytes], code: str, words: str
) -> None:
    with raw_stream(url) as stream:
        for message in messages:
            stream.socket.send(message)
        event = stream.receive()
        while not isinstance(event, Error):
            event = stream.receive()
        assert (event.code, event.title) == (code, CODES[code].title)
        assert words in event.detail
        assert closed(stream, CODES[code].close).startswith(code)


def test_a_message_above_the_limit_closes_the_socket(url: str) -> None:
    with raw_stream(url) as stream:
        stream.socket.send(bytes(MAX_MESSAGE + 1))
        closed(stream, 1009)


def test_a_surface_that_is_not_there_is_an_error_message(server: str, http: httpx.Client) -> None:
    failed = push(http, npy(hills())[:-1])
    for path, code in (("/v1/surfaces/0123", "not-found"), (failed["url"], "failed")):
        with raw_stream(server + path) as stream:
            event = stream.receive()
            assert isinstance(event, Error)
            assert event.code == code
            closed(stream, CODES[code].close)


def test_another_subprotocol_is_refused_with_a_reason(url: str) -> None:
    for offered in (None, ["lodestream.v2"]):
        with pytest.raises(InvalidStatus) as refused:
            connect(url.replace("http", "ws", 1) + "/stream", subprotocols=offered, proxy=None)  # type: ignore[arg-type]
        response = refused.value.response
        assert response.status_code == 426
        document = json.loads(response.body or b"")
        assert document["code"] == "unsupported-version"
        assert SUBPROTOCOL in document["detail"]


def test_messages_are_not_deflated(url: str) -> None:
    with raw_stream(url, compression="deflate") as stream:
        assert stream.socket.protocol.extensions == []
        stream.send(Open(ls.Target(level=0)))
        stream.until_end()


def test_many_clients_at_once_get_the_same(url: str, points: Any) -> None:
    with ThreadPoolExecutor(8) as pool:
        drivers = list(pool.map(lambda window: download(url, window=window), [3000, 20_000, 100_000, BASE_CREDIT] * 2))
    assert all(driver.ended == "complete" for driver in drivers)
    assert all(np.array_equal(driver.decoder.surface().points, points) for driver in drivers[:2])


def test_a_request_that_opens_no_websocket_is_told_so(url: str, http: httpx.Client) -> None:
    for answer in (http.get(f"{url}/stream"), http.head(f"{url}/stream"), http.get("/v1/surfaces/none/stream")):
        assert answer.status_code == 426
        assert (answer.headers["upgrade"], answer.headers["connection"]) == ("websocket", "upgrade")
    assert problem(http.get(f"{url}/stream")) == (426, "no-websocket")


def test_a_surface_deleted_under_a_stream_goes_on_to_its_end(server: str, http: httpx.Client) -> None:
    made = push(http, npy(hills(90, 80, seed=5)))
    driver = Download(window=1000)
    with raw_stream(server + made["url"]) as stream:
        while driver.ended is None:
            for message in driver.data_to_send():
                stream.socket.send(message)
            driver.receive(stream.socket.recv(timeout=PATIENCE, decode=False))
            if driver.answer is not None and driver.decoder.bytes:
                http.delete(made["url"])
        for message in driver.data_to_send():
            stream.socket.send(message)
        closed(stream, 1000)
    assert np.array_equal(driver.decoder.surface().points, hills(90, 80, seed=5))


def test_a_damaged_container_is_reported_after_what_is_whole(server: str, http: httpx.Client, data: Path) -> None:
    made = push(http, npy(hills(90, 80, seed=6)))
    path = data / "containers" / f"{made['container_sha256']}.lode"
    with raw_stream(server + made["url"]) as stream:
        stream.send(Open(credit=1000))
        received = 0
        while received < 1000:
            received += data_of([stream.receive()])
        # Nothing is read while there is no credit.
        os.truncate(path, made["bytes"] // 2)
        stream.send(Credit(BASE_CREDIT))
        events: list[Event] = [stream.receive()]
        while not isinstance(events[-1], Error):
            events.append(stream.receive())
        assert events[-1].code == "damaged"
        assert data_of(events) > 0
        closed(stream, CODES["damaged"].close)


def test_clients_that_vanish_leave_no_task_and_no_file_behind(url: str, data: Path) -> None:
    for _ in range(5):
        with raw_stream(url) as stream:
            stream.send(Open(credit=BASE_CREDIT))
            stream.receive()
            stream.socket.socket.close()
    opened = Path("/proc/self/fd")

    def none_open() -> bool:
        links = []
        for link in opened.iterdir():
            try:
                links.append(str(link.readlink()))
            except OSError:
                continue
        # Other tests of this process may have left files open until their garbage is collected.
        return not any(link.startswith(str(data / "containers")) for link in links)

    if not opened.exists():
        pytest.skip("this system does not list open files in /proc")
    assert eventually(none_open, "the containers to be closed")


def test_a_server_that_ends_tells_its_clients_to_come_back(tmp_path: Path) -> None:
    with ExitStack() as running:
        address = running.enter_context(running_server(tmp_path / "data", workers=1))
        with httpx.Client(base_url=address, trust_env=False, timeout=PATIENCE) as http:
            made = push(http, npy(hills(90, 80)))
        with raw_stream(address + made["url"]) as stream:
            stream.send(Open(credit=100))
            stream.receive()
            running.close()
            closed(stream, 1012)


def test_an_ended_download_gives_ended_last(url: str) -> None:
    driver = Download(ls.Target(level=1))
    events = []
    with raw_stream(url) as stream:
        while driver.ended is None:
            for message in driver.data_to_send():
                stream.socket.send(message)
            events += driver.receive(stream.socket.recv(timeout=PATIENCE, decode=False))
    assert events[-1] == Ended("level")


def test_what_a_client_holds_is_not_sent_again(url: str, surface: dict[str, Any], http: httpx.Client) -> None:
    container = http.get(f"{surface['url']}/container", follow_redirects=True).content
    held = ((0, 1000), (1500, 20_000), (len(container) - 40, 40), (500, 700))
    with raw_stream(url) as stream:
        stream.send(Open(held=held, container=surface["container_sha256"]))
        events: list[Event] = []
        while not events or not isinstance(events[-1], End):
            events.append(stream.receive())
            if isinstance(events[-1], Segments):
                stream.send(Credit(len(events[-1].data)))
        stream.send(Bye())
        closed(stream, 1000)
    header = events[0]
    assert isinstance(header, Opened)
    assert header.planned == surface["levels"][-1]["bytes"], "held or not"
    slices = [event for event in events if isinstance(event, Segments)]
    assert all(container[event.offset :].startswith(event.data) for event in slices)
    assert header.prefix
    planned = RangeSet([(0, header.planned), header.metadata])
    missing = RangeSet(gap for place in planned for gap in RangeSet(held).missing(*place))
    assert RangeSet((event.offset, len(event.data)) for event in slices) == missing
    assert data_of(events) == missing.total, "each byte once"
    assert [event.offset for event in slices] == sorted(event.offset for event in slices)
    told = [event.bytes for event in events if isinstance(event, Layer)]
    expected = {*(layer["bytes"] for layer in surface["layers"]), header.planned}
    assert told == sorted(size for size in expected if size > 1200)


@pytest.mark.parametrize(
    ("changes", "code", "words"),
    [
        ({"held": [[0, 10]]}, "bad-held", "open.container"),
        ({"held": [[0, 10**12]], "container": True}, "bad-held", "to byte 1000000000000"),
        ({"held": [[2 * n, 1] for n in range(4097)], "container": True}, "bad-held", "at most 4096 ranges, got 4097"),
        ({"held": [[0, 10]], "container": "0" * 64}, "other-container", "expected container"),
        ({"container": "0" * 64}, "other-container", "expected container"),
    ],
)
def test_what_cannot_be_held_is_refused(
    url: str, surface: dict[str, Any], changes: dict[str, Any], code: str, words: str
) -> None:
    fields = {"type": "open", "version": 1, "credit": 1000, **changes}
    if fields.get("container") is True:
        fields["container"] = surface["container_sha256"]
    with raw_stream(url) as stream:
        stream.socket.send(msgpack.packb(fields))
        event = stream.receive()
        assert isinstance(event, Error)
        assert event.code == code
        assert words in event.detail
        assert closed(stream, CODES[code].close).startswith(code)


def test_a_message_takes_a_sixteenth_of_the_most_credit(url: str) -> None:
    with raw_stream(url) as stream:
        stream.send(Open(credit=64 * 1024))
        received, left = [], 64 * 1024
        while left:
            event = stream.receive()
            if isinstance(event, Segments):
                assert len(event.data) <= min(left, 4 * 1024)
                left -= len(event.data)
                received.append(len(event.data))
        stream.send(Stop())
        assert data_of(stream.until_end()) == 0
    assert len(received) >= 16


@pytest.mark.parametrize("offered", [[SUBPROTOCOL], []])
def test_a_client_that_is_gone_before_the_handshakes_end_is_no_error(offered: list[str]) -> None:
    async def receive() -> dict[str, Any]:
        return {"type": "websocket.connect"}

    async def send(message: MutableMapping[str, Any]) -> None:
        sent.append(message["type"])
        raise ClientDisconnected

    sent: list[str] = []
    extensions: dict[str, Any] = {"websocket.http.response": {}}
    scope = {
        "type": "websocket",
        "path": "/",
        "query_string": b"",
        "headers": [],
        "subprotocols": offered,
        "extensions": extensions,
        "app": SimpleNamespace(state=SimpleNamespace(metrics=Metrics())),
    }
    asyncio.run(streams.stream(None, WebSocket(scope, receive, send), None, "ab"))  # type: ignore[arg-type]
    assert len(sent) == 1


def test_a_plan_of_many_chunks_is_not_made_in_the_event_loop() -> None:
    index = crowded(65_536)
    sender = Sender(index, "0" * 64)
    session: Any = streams._Session.__new__(streams._Session)
    session._sender, session._container = sender, SimpleNamespace(index=index)
    # Hardly any bytes, and no segments.
    message = serialize(Open(ls.Target(region=((1, 4), (2, 5)))))
    assert len(message) < 100
    assert session._takes_long(message)
    assert not session._takes_long(serialize(Open()))
