"""Windows with limits over a stream; one end may be of an earlier release, which knows no errors of windows."""

from __future__ import annotations

import hashlib
import math
from functools import cache
from typing import Any

import msgpack
import numpy as np
import pytest

import lodestream as ls
from lodestream.container import Index
from lodestream.planning.plan import Plan
from lodestream.planning.planner import plan
from lodestream.planning.window_errors import WindowErrors, read_window_errors, window_section
from lodestream.protocol.messages import Layer, Segments
from lodestream.protocol.wire import parse
from lodestream.transfer.download import Download, Ended
from lodestream.transfer.receiver_state import MemoryStore, ReceiverState
from lodestream.transfer.sender import Sender

from ..surfaces import index_of, terrain

REGION = ((20, 90), (310, 420))
TARGET = ls.Target(region=REGION, until_rms=ls.Tolerance(5e-3, relative=True))


@cache
def container() -> bytes:
    return ls.encode(terrain((120, 530), 8).astype(np.float32))


@cache
def index() -> Index:
    return index_of(container())


def read(offset: int, length: int) -> bytes:
    return container()[offset : offset + length]


def windows() -> WindowErrors:
    found = read_window_errors(index(), read)
    assert found is not None
    return found


def sender() -> Sender:
    return Sender(index(), hashlib.sha256(container()).hexdigest(), windows=windows)


def talk(
    reception: ReceiverState, *, earlier_server: bool = False, earlier_client: bool = False, pieces: int = 10**9
) -> tuple[list[Any], list[Any]]:
    """All that the server says, and all that the client shows, until one of them breaks off after so many messages."""
    client, server = Download(reception=reception, window=2000), sender()
    said: list[Any] = []
    shown: list[Any] = []
    while not any(isinstance(event, Ended) for event in shown) and len(said) < pieces:
        for message in client.data_to_send():
            fields = msgpack.unpackb(message)
            if earlier_server:
                fields.pop("window_errors", None)
            if earlier_server or earlier_client:
                fields.pop("decodes", None)
            server.receive(msgpack.packb(fields))
        while (answer := server.next_message()) is not None:
            said.append(parse(answer))
            shown += client.receive(answer)
        if (wanted := server.wanted()) is not None:
            server.provide(wanted, read(wanted.offset, wanted.length))
    return said, shown


def expected() -> Plan:
    return plan(index(), TARGET, windows=windows())


@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize("pieces", [10**9, 7, 3])
def test_the_stream_ends_where_the_window_is_good_enough(stored: bool, pieces: int) -> None:
    reception = ReceiverState(TARGET, store=MemoryStore() if stored else None)
    shown: list[Any] = []
    for _ in range(400):
        said, more = talk(reception, pieces=pieces)
        shown += more
        section = window_section(index())
        assert section is not None
        assert said[0].window_errors == (section.offset, section.length)
        if isinstance(shown[-1:] and shown[-1], Ended):
            break
    assert shown[-1] == Ended("rms")
    assert reception.received == reception.planned == expected().bytes < plan(index(), TARGET).bytes
    assert reception.data_bytes == reception.cached.total, "nothing came twice"
    last = shown[-2]
    assert (last.bytes, last.rms, last.max_error) == (expected().bytes, expected().rms, expected().max_error)
    assert not any(isinstance(event, Layer) for event in said)
    if pieces > 1000:
        said, again = talk(ReceiverState(TARGET), earlier_client=True)
        assert again == shown
        told = [(event.bytes, event.rms, event.max) for event in said if isinstance(event, Layer)]
        assert told == [(view.bytes, view.rms, view.max_error) for view in shown[:-1]]


@pytest.mark.parametrize("stored", [False, True])
def test_a_server_of_an_earlier_release_sends_the_whole_window(stored: bool) -> None:
    reception = ReceiverState(TARGET, store=MemoryStore() if stored else None)
    said, shown = talk(reception, earlier_server=True)
    assert said[0].window_errors is None
    assert shown[-1] == Ended("complete")
    assert shown[-2].complete
    assert all(math.isnan(event.rms) for event in [event for event in said if isinstance(event, Layer)][:-1])
    # What the whole surface's errors say of the window is known all the same.
    assert not any(math.isnan(view.rms) for view in shown[:-1])


def test_a_client_of_an_earlier_release_gets_what_it_expects() -> None:
    said, _ = talk(ReceiverState(TARGET), earlier_server=True)
    section = window_section(index())
    assert section is not None
    assert not any(isinstance(event, Segments) and event.offset == section.offset for event in said)
    assert said[0].planned == plan(index(), ls.Target(region=REGION)).bytes


def test_a_stream_goes_on_at_a_server_of_another_release() -> None:
    reception = ReceiverState(TARGET, store=MemoryStore())
    talk(reception, pieces=12)
    said, shown = talk(reception, earlier_server=True)
    assert said[0].window_errors is None
    assert shown[-1] == Ended("complete")


@pytest.mark.parametrize("stored", [False, True])
@pytest.mark.parametrize("pieces", [3, 12])
def test_a_stream_goes_on_at_a_server_that_tells_more(stored: bool, pieces: int) -> None:
    reception = ReceiverState(TARGET, store=MemoryStore() if stored else None)
    talk(reception, earlier_server=True, pieces=pieces)
    said, shown = talk(reception)
    assert said[0].window_errors is not None
    assert shown[-1] == Ended("rms")
    assert reception.received == reception.planned == expected().bytes
    assert (shown[-2].rms, shown[-2].max_error) == (expected().rms, expected().max_error)


def test_errors_of_windows_that_are_told_and_not_there_are_not_waited_for() -> None:
    reception = ReceiverState(ls.Target(region=REGION), store=MemoryStore())
    reception.follow(index())
    root, metadata = ((place.offset, place.length) for place in (index().index, index().metadata))
    reception.expect(1, root, metadata, windows=(10, 20), prefix=False)
    for place in plan(index(), reception.target).slices:
        reception.take(place.offset, read(place.offset, place.length))
    reception.take(10, read(10, 20))
    assert reception.decoder.complete
