"""Both ends of a stream without I/O, joined by queues: what is promised holds in whatever order messages cross."""

from __future__ import annotations

import hashlib
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.errors import (
    CorruptStreamError,
    OptionError,
    RemoteError,
    RemoteProtocolError,
    TruncatedStreamError,
    UnsupportedVersionError,
)
from lodestream.planning.planner import plan
from lodestream.protocol.connection import State
from lodestream.protocol.messages import (
    BASE_CREDIT,
    CODES,
    MAX_CREDIT,
    End,
    Error,
    Layer,
    MessageError,
    Open,
    Opened,
    Segments,
)
from lodestream.protocol.wire import parse, serialize
from lodestream.transfer.download import Download, Ended

from ..protocol.talk import Link, container, index


@pytest.mark.parametrize("window", [1, 7, 500, 4096, MAX_CREDIT])
def test_the_whole_surface_comes_and_is_the_same(window: int) -> None:
    link = Link(window=window)
    link.run()
    assert link.events[-1] == Ended("complete")
    assert [view.bytes for view in link.views] == [mark.bytes for mark in plan(index()).marks]
    original = ls.decode(container())
    assert np.array_equal(link.client.decoder.surface().points, original.points)
    assert link.client.decoder.metadata == original.metadata
    assert link.server.state is State.CLOSED
    assert link.server.why == link.client.ended == "complete"


@pytest.mark.parametrize(
    ("target", "ended"),
    [
        (ls.Target(), "complete"),
        (ls.Target(order="level"), "complete"),
        (ls.Target(level=0), "level"),
        (ls.Target(level=3), "level"),
        (ls.Target(level=3, order="level"), "level"),
        (ls.Target(until_rms=ls.Tolerance(1e-2, True)), "rms"),
        (ls.Target(until_rms=ls.Tolerance(0.5)), "rms"),
        (ls.Target(until_max=ls.Tolerance(5e-2, True)), "max"),
        (ls.Target(max_bytes=2000), "bytes"),
        (ls.Target(max_bytes=2000, order="level"), "bytes"),
        (ls.Target(until_rms=ls.Tolerance(0.0)), "complete"),
    ],
)
@pytest.mark.parametrize("window", [300, MAX_CREDIT])
def test_every_target_ends_where_the_plan_does(target: ls.Target, ended: str, window: int) -> None:
    link = Link(target, window)
    link.run()
    planned = plan(index(), target)
    assert link.events[-1] == Ended(ended)
    decoder = link.client.decoder
    state = (decoder.bytes, decoder.level, decoder.rms, decoder.max_error)
    assert state == (planned.bytes, planned.level, planned.rms, planned.max_error)
    assert decoder.metadata == {"name": "hills"}
    assert link.client.answer == Opened(
        hashlib.sha256(container()).hexdigest(),
        len(container()),
        planned.bytes,
        index().header.extent,
        (index().index.offset, index().index.length),
        (index().metadata.offset, index().metadata.length),
        planned.prefix,
    )
    assert link.server.sent == sum(part.length for part in (*planned.before, *planned.ranges, *planned.after))


@pytest.mark.parametrize(("window", "decodes"), [(65_535, True), (BASE_CREDIT, False)])
def test_a_message_ends_where_a_layer_does(window: int, decodes: bool) -> None:
    link = Link(window=window, decodes=decodes)
    sizes = []
    link.hear()
    while link.serve():
        pass
    total = 0
    for message in link.to_client:
        event = parse(message)
        if isinstance(event, Segments):
            total += len(event.data)
            sizes.append(total)
    assert [mark.sent for mark in plan(index()).marks] == sizes[:-1]


@pytest.mark.parametrize("target", [ls.Target(), ls.Target(order="level"), ls.Target(first=((0, 20), (0, 20)))])
def test_messages_to_a_client_that_decodes_end_with_the_first_layer_and_then_anywhere(target: ls.Target) -> None:
    link, slow = Link(target, 65_536), Link(target, 65_535)
    link.hear()
    first = min(mark.sent for mark in plan(index(), target).marks)
    messages, service = [], sum(place.length for place in plan(index(), target).before)
    while link.serve():
        pass
    for message in link.to_client:
        event = parse(message)
        messages.append(event)
        assert not isinstance(event, Layer)
    sizes = np.cumsum([len(event.data) for event in messages if isinstance(event, Segments)])
    assert service + first in sizes
    assert sizes[-1] == link.server.sent
    link.run()
    slow.run()
    assert link.server.layers == slow.server.layers == len(plan(index(), target).marks) > 4
    assert [(view.bytes, view.rms) for view in link.views] == [(view.bytes, view.rms) for view in slow.views]
    if plan(index(), target).prefix:
        assert len(sizes) < len(link.views), "where slices are not contiguous, each is a message"
    assert np.array_equal(link.client.decoder.surface().points, ls.decode(container()).points)


def test_layers_count_when_they_are_handed_out() -> None:
    link = Link()
    link.hear()
    link.serve()
    wanted = link.wanted()
    link.server.provide(wanted, container()[wanted.offset : wanted.end])
    assert link.server.layers == 0
    assert link.serve()
    assert link.server.layers == 1
    wanted = link.wanted()
    link.server.provide(wanted, container()[wanted.offset : wanted.end])
    link.stop()
    link.hear()
    link.run()
    assert link.server.layers == 1


@pytest.mark.parametrize("cut", [1, 7, 300, 2000])
@pytest.mark.parametrize("decodes", [(True, False), (False, True), (True, True)])
def test_a_stream_that_breaks_goes_on_at_a_server_of_another_release(cut: int, decodes: tuple[bool, bool]) -> None:
    link = Link(decodes=decodes[0])
    link.hear()
    while link.client.reception.data_bytes < cut and (link.serve() or link.to_client):
        if link.to_client:
            link.take()
    again = Link(reception=link.client.reception, decodes=decodes[1])
    again.run()
    assert again.client.ended == "complete"
    assert again.client.reception.data_bytes == again.client.reception.cached.total
    assert np.array_equal(again.client.decoder.surface().points, ls.decode(container()).points)


def test_no_more_is_in_flight_than_granted_when_the_client_does_not_read() -> None:
    link = Link(window=1000)
    link.hear()
    while link.serve():
        pass
    assert link.in_flight == 1000
    assert link.server.wanted() is None
    while link.to_client:
        link.take()
        while link.to_server:
            link.hear()
        while link.serve():
            pass
        assert link.in_flight <= 1000
    assert link.client.ended == "complete"


def test_the_credit_is_granted_again_in_few_messages() -> None:
    link = Link(window=4000)
    link.run()
    grants = 0
    counted = Link(window=4000)
    while counted.serve() or counted.to_server or counted.to_client:
        if counted.to_server:
            grants += parse(counted.to_server[0]).type == "credit"
            counted.hear()
        if counted.to_client:
            counted.take()
    assert 0 < grants <= 4 * len(container()) / 4000 + 1


def test_stop_overtakes_what_has_not_been_handed_out() -> None:
    link = Link(window=60_000)
    link.hear()
    for _ in range(6):
        link.serve()
    wanted = link.wanted()
    before = len(link.to_client)
    link.stop()
    link.hear()
    link.server.provide(wanted, container()[wanted.offset : wanted.end])
    assert link.server.wanted() is None
    while link.serve():
        pass
    assert [parse(message) for message in list(link.to_client)[before:]] == [End("stopped")]
    link.run()
    assert link.events == [Ended("stopped")]
    assert link.server.state is State.CLOSED


def test_what_arrives_after_stop_is_kept_but_gives_no_views() -> None:
    link = Link()
    link.hear()
    for _ in range(10):
        link.serve()
    link.stop()
    link.run()
    assert link.views == []
    decoder = link.client.decoder
    assert decoder.bytes > 0
    assert decoder.bytes == decoder.layers[-1].bytes


def test_stopping_twice_or_after_the_end_does_nothing() -> None:
    link = Link()
    link.stop()
    link.stop()
    link.run()
    assert link.client.ended == "stopped"
    link = Link()
    link.run()
    link.stop()
    assert not link.to_server
    assert link.client.ended == "complete"


def test_seconds_are_the_clients_business() -> None:
    link = Link(ls.Target(seconds=5.0), window=60_000)
    assert link.client.tick(100.0) == 5.0
    assert link.client.tick(103.0) == 2.0
    link.hear()
    for _ in range(8):
        link.serve()
    link.take()
    assert link.client.tick(105.0) is None
    link.flush()
    link.run()
    assert link.client.ended == "seconds"
    assert Link().client.tick(0.0) is None


def test_bytes_on_the_wire_are_counted() -> None:
    link = Link()
    link.hear()
    total = 0
    while link.serve():
        pass
    total = sum(map(len, link.to_client))
    link.run()
    assert link.client.wire_bytes == total
    assert len(container()) < total + 2000


@pytest.mark.parametrize("window", [0, -1, MAX_CREDIT + 1])
def test_a_window_outside_the_limits_is_refused(window: int) -> None:
    with pytest.raises(OptionError, match="window"):
        Download(window=window)


def test_a_level_that_does_not_exist_is_refused_by_name() -> None:
    link = Link(ls.Target(level=99))
    with pytest.raises(MessageError, match="level of 0 to 6, got 99") as refused:
        link.hear()
    assert refused.value.code == "bad-target"
    link.server.fail(refused.value.code, str(refused.value))
    link.serve()
    with pytest.raises(RemoteError, match=r"^expected a level of 0 to 6, got 99") as told:
        link.take()
    assert told.value.code == "bad-target"
    assert not link.serve()


def test_a_refusal_is_the_last_word() -> None:
    link = Link()
    link.hear()
    link.serve()
    link.server.fail("internal", "out of luck")
    link.server.fail("idle", "again")
    while link.serve():
        pass
    assert parse(link.to_client[-1]) == Error("idle", CODES["idle"].title, "again")
    assert link.server.state is State.FAILED
    link.server.fail("internal", "after the end")
    assert not link.serve()


def test_an_end_before_everything_promised_is_not_taken_for_one() -> None:
    link = Link()
    link.hear()
    link.serve()
    link.take()
    with pytest.raises(TruncatedStreamError, match="expected"):
        link.client.receive(serialize(End("complete")))


@pytest.mark.parametrize(
    ("code", "reason", "kind", "words"),
    [
        (None, "", TruncatedStreamError, "connection was lost"),
        (1006, "", TruncatedStreamError, "closed with code 1006"),
        (1012, "", RemoteError, "restarting"),
        (4404, "not-found: no such surface", RemoteError, "^no such surface$"),
    ],
)
def test_a_connection_that_breaks_is_never_silent(
    code: int | None, reason: str, kind: type[Exception], words: str
) -> None:
    link = Link()
    link.hear()
    for _ in range(4):
        link.serve()
    while link.to_client:
        link.take()
    with pytest.raises(kind, match=words):
        link.client.connection_lost(code, reason)
    link.run()
    link.client.connection_lost(code, reason)
    assert link.client.ended == "complete"


def test_damaged_bytes_are_reported_with_their_offset() -> None:
    link = Link(window=60_000)
    link.hear()
    while link.serve():
        pass
    events = [parse(message) for message in link.to_client]
    slices = [event for event in events if isinstance(event, Segments)]
    link.take()
    for event in slices[:2]:
        link.client.receive(serialize(event))
    third = slices[2]
    with pytest.raises(CorruptStreamError) as damaged:
        link.client.receive(serialize(Segments(third.offset, bytes([third.data[0] ^ 255]) + third.data[1:])))
    assert damaged.value.offset >= third.offset
    assert len(link.client.decoder.layers) == 2


def test_a_file_that_has_been_cut_is_reported() -> None:
    link = Link()
    link.hear()
    wanted = link.wanted()
    with pytest.raises(CorruptStreamError, match="expected"):
        link.server.provide(wanted, container()[wanted.offset : wanted.end - 1])


def test_strangers_are_refused_on_both_sides() -> None:
    link = Link()
    with pytest.raises(RemoteProtocolError):
        link.client.receive(b"\xc1")
    with pytest.raises(RemoteProtocolError):
        link.server.receive(serialize(End("complete")))
    with pytest.raises(UnsupportedVersionError):
        link.server.receive(serialize(Open()).replace(b"version\x01", b"version\x07"))


@given(
    target=st.sampled_from([ls.Target(), ls.Target(level=4), ls.Target(max_bytes=1500), ls.Target(order="level")]),
    window=st.sampled_from([300, 2000, MAX_CREDIT]),
    stop_after=st.none() | st.integers(0, 120),
    seed=st.integers(0, 2**32),
)
def test_any_order_of_events_ends_with_what_was_promised(
    target: ls.Target, window: int, stop_after: int | None, seed: int
) -> None:
    """No deadlock, never more in flight than the window, and a stop that always ends, within the credit."""
    link, schedule = Link(target, window), Random(seed)
    for step in range(5000):
        if step == stop_after and link.client.ended is None:
            link.stop()
        choices = ["serve", *["hear"] * bool(link.to_server), *["take"] * bool(link.to_client)]
        choice = schedule.choice(choices)
        if choice == "hear":
            link.hear()
        elif choice == "take":
            link.take()
        elif not link.serve() and len(choices) == 1:
            break
        assert link.in_flight <= window
    assert link.server.state is State.CLOSED
    assert isinstance(link.events[-1], Ended)
    assert link.data_after_stop <= window
    if link.client.ended != "stopped":
        assert link.client.decoder.bytes == plan(index(), target).bytes
