"""Streams whose `open` stands in the address, over real sockets: answered at once, and no otherwise than a message."""

from __future__ import annotations

from base64 import urlsafe_b64encode
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx
import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed

import lodestream as ls
from lodestream.planning.byte_ranges import RangeSet
from lodestream.protocol.handshake import MAX_OPENING, to_address
from lodestream.protocol.messages import (
    CODES,
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
from tests.server.helpers import Raw, data_of, hills, npy, push, raw_stream


@pytest.fixture(scope="module")
def surface(http: httpx.Client) -> dict[str, Any]:
    return push(http, npy(hills(90, 80)))


@pytest.fixture(scope="module")
def url(server: str, surface: dict[str, Any]) -> str:
    return server + str(surface["url"])


@contextmanager
def opened(url: str, query: str | None) -> Iterator[Raw]:
    with raw_stream(url, f"?{query}") as stream:
        yield stream


def events_of(stream: Raw) -> list[Event]:
    """Everything to the end, with credit for what has come."""
    events: list[Event] = []
    while not events or not isinstance(events[-1], End):
        events.append(stream.receive())
        if isinstance(events[-1], Segments):
            stream.send(Credit(len(events[-1].data)))
    stream.send(Bye())
    with pytest.raises(ConnectionClosed) as over:
        stream.receive()
    assert over.value.rcvd is not None
    assert over.value.rcvd.code == 1000
    return events


def refusal(stream: Raw) -> Error:
    said = stream.receive()
    assert isinstance(said, Error)
    assert said.title == CODES[said.code].title
    with pytest.raises(ConnectionClosed) as over:
        stream.receive()
    assert over.value.rcvd is not None
    assert over.value.rcvd.code == CODES[said.code].close
    assert over.value.rcvd.reason.startswith(said.code)
    return said


@pytest.mark.parametrize(
    "target",
    [
        ls.Target(),
        ls.Target(max_bytes=3000),
        ls.Target(until_rms=ls.Tolerance(1e-2, True)),
        ls.Target(level=3),
        ls.Target(order="level"),
        ls.Target(region=((5, 40), (30, 61))),
    ],
    ids=repr,
)
def test_the_answer_is_that_to_the_message(url: str, target: ls.Target) -> None:
    message = Open(target, 5000)
    with opened(url, to_address(serialize(message))) as stream:
        assert stream.socket.subprotocol == SUBPROTOCOL
        by_address = events_of(stream)
    with raw_stream(url) as stream:
        stream.send(message)
        by_message = events_of(stream)
    assert isinstance(by_address[0], Opened)

    def said(events: list[Event]) -> list[str]:
        # Where one slice ends and the next begins depends on when grants come.
        return [repr(event) for event in events if not isinstance(event, Segments)]

    def slices(events: list[Event]) -> dict[int, int]:
        return {
            event.offset + place: byte
            for event in events
            if isinstance(event, Segments)
            for place, byte in enumerate(event.data)
        }

    assert said(by_address) == said(by_message)
    assert slices(by_address) == slices(by_message)


def test_credit_and_stop_hold_as_ever(url: str) -> None:
    with opened(url, to_address(serialize(Open(credit=700)))) as stream:
        events: list[Event] = [stream.receive()]
        while data_of(events) < 700:
            events.append(stream.receive())
        stream.send(Stop())
        assert data_of(stream.until_end()) == 0
    assert any(isinstance(event, Layer) for event in events)


def test_what_is_held_is_not_sent_again(url: str, surface: dict[str, Any]) -> None:
    held, container = ((0, 400), (900, 250)), str(surface["container_sha256"])
    with opened(url, to_address(serialize(Open(held=held, container=container)))) as stream:
        events = events_of(stream)
    sent = [(event.offset, event.offset + len(event.data)) for event in events if isinstance(event, Segments)]
    assert min(sent)[0] == 400
    assert not any(start < 1150 and end > 900 for start, end in sent)
    assert data_of(events) == surface["levels"][-1]["bytes"] + header_of(events).metadata[1] - 650


def header_of(events: list[Event]) -> Opened:
    assert isinstance(events[0], Opened)
    return events[0]


def test_without_the_parameter_nothing_is_taken_from_the_address(url: str) -> None:
    with opened(url, "other=1") as stream:
        assert stream.socket.subprotocol == SUBPROTOCOL
        stream.send(Open(ls.Target(max_bytes=2000)))
        assert events_of(stream)[-1] == End("bytes")


def packed(**fields: Any) -> str:
    return f"open={urlsafe_b64encode(msgpack.packb({'type': 'open', 'version': 1, 'credit': 1, **fields})).decode()}"


@pytest.mark.parametrize(
    ("query", "code", "words"),
    [
        ("open=", "bad-message", "MessagePack"),
        ("open=A", "bad-message", "base64url"),
        ("open=%00", "bad-message", "base64url"),
        ("open=gr%C3%BCn", "bad-message", "base64url"),
        ("open=wcHB", "bad-message", "MessagePack"),
        ("open=" + "A" * (MAX_OPENING + 4), "message-too-large", "2048 characters"),
        (to_address(serialize(Stop())), "out-of-turn", "must be open, and is stop"),
        (packed(version=9), "unsupported-version", "version 1"),
        (packed(credit="much"), "bad-message", "open.credit"),
        (packed(target={"level": 50}), "bad-target", "got 50"),
        (packed(held=[[0, 10]]), "bad-held", "open.container"),
        (packed(container="0" * 64), "other-container", "expected container"),
        (packed(token="secret"), "bad-message", "A token does not belong into an address"),
    ],
)
def test_what_is_wrong_is_told_as_of_a_message(url: str, query: str, code: str, words: str) -> None:
    with opened(url, query) as stream:
        said = refusal(stream)
    assert said.code == code
    assert words in said.detail


def test_an_open_before_the_end_is_out_of_turn(url: str) -> None:
    with opened(url, to_address(serialize(Open(credit=0)))) as stream:
        assert isinstance(stream.receive(), Opened)
        stream.send(Open())
        assert refusal(stream).code == "out-of-turn"


def test_a_surface_that_is_not_there_is_an_error_message(server: str) -> None:
    with opened(f"{server}/v1/surfaces/{'0' * 20}", to_address(serialize(Open()))) as stream:
        assert refusal(stream).code == "not-found"


def test_the_surface_is_whole(url: str) -> None:
    with opened(url, to_address(serialize(Open()))) as stream:
        data = b"".join(event.data for event in events_of(stream) if isinstance(event, Segments))
    decoder = ls.Decoder()
    decoder.feed(data)
    assert np.array_equal(decoder.surface().points, hills(90, 80))


def test_after_an_end_it_goes_on_with_what_was_not_sent(url: str, surface: dict[str, Any]) -> None:
    with raw_stream(url) as stream:
        stream.send(Open(ls.Target(max_bytes=3000)))
        first = [stream.receive()]
        while not isinstance(first[-1], End):
            first.append(stream.receive())
        assert first[-1] == End("bytes")
        stream.send(Open(ls.Target(first=((5, 20), (10, 30)))))
        events = events_of(stream)
    assert events[-1] == End("complete")
    sent = RangeSet()
    for event in (*first, *events):
        if isinstance(event, Segments):
            assert not list(sent.overlap(event.offset, len(event.data))), "nothing is sent twice"
            sent.add(event.offset, len(event.data))
    assert sent.covers(0, surface["levels"][-1]["bytes"])
