"""Both ends of a stream without I/O, joined by queues: what is promised holds in whatever order messages cross."""

from __future__ import annotations

import hashlib
from collections import deque
from dataclasses import dataclass, field
from functools import cache
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.container import ByteRange, Index, read_index
from lodestream.decoder import View
from lodestream.download import Download, Ended
from lodestream.errors import (
    CorruptStreamError,
    OptionError,
    RemoteError,
    RemoteProtocolError,
    TruncatedStreamError,
    UnsupportedVersionError,
)
from lodestream.messages import (
    CODES,
    MAX_CREDIT,
    MAX_HELD,
    MAX_MESSAGE,
    MIN_WINDOW,
    End,
    Error,
    Header,
    Layer,
    MessageError,
    Open,
    Segments,
)
from lodestream.plan import plan
from lodestream.protocol import State
from lodestream.reception import Reception
from lodestream.sender import Sender
from lodestream.wire import parse, serialize

SHAPE = (61, 47)


@cache
def container() -> bytes:
    rows, columns = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    heights = 100 * np.sin(rows / 9) * np.cos(columns / 7) + np.random.default_rng(1).normal(size=SHAPE)
    return ls.encode(ls.Surface(heights.astype(np.float32), metadata={"name": "hills"}))


@cache
def index() -> Index:
    data = container()
    return read_index(lambda offset, length: data[offset : offset + length], len(data))


@dataclass
class Link:
    """A client and a server, and what is under way between them."""

    target: ls.Target = field(default_factory=ls.Target)
    window: int = MAX_CREDIT
    now: float = 0.0
    reception: Reception | None = None

    def __post_init__(self) -> None:
        self.client = Download(self.target, window=self.window, reception=self.reception)
        self.server = Sender(index(), hashlib.sha256(container()).hexdigest())
        self.to_server: deque[bytes] = deque()
        self.to_client: deque[bytes] = deque()
        self.events: list[View | Ended] = []
        self.data_after_stop = 0
        self.stopped = False
        self.flush()

    def flush(self) -> None:
        self.to_server.extend(self.client.data_to_send())

    def serve(self) -> bool:
        """One step of the server; whether there was anything to do."""
        message = self.server.next_message()
        if message is not None:
            assert len(message) <= MAX_MESSAGE
            self.to_client.append(message)
            return True
        wanted = self.server.wanted()
        if wanted is None:
            return False
        self.server.provide(wanted, container()[wanted.offset : wanted.end])
        return True

    def hear(self) -> None:
        self.server.receive(self.to_server.popleft())

    def take(self) -> None:
        message = self.to_client.popleft()
        event = parse(message)
        if self.stopped and isinstance(event, Segments):
            self.data_after_stop += len(event.data)
        self.events += self.client.receive(message)
        self.flush()

    def stop(self) -> None:
        self.client.stop()
        self.stopped = True
        self.flush()

    def run(self) -> None:
        """Deliver everything, in turns, until nothing is left to do."""
        while self.serve() or self.to_server or self.to_client:
            if self.to_server:
                self.hear()
            if self.to_client:
                self.take()

    def wanted(self) -> ByteRange:
        """The next slice that the server wants to read."""
        while (wanted := self.server.wanted()) is None:
            assert self.serve()
        return wanted

    @property
    def in_flight(self) -> int:
        events = (parse(message) for message in self.to_client)
        return sum(len(event.data) for event in events if isinstance(event, Segments))

    @property
    def views(self) -> list[View]:
        return [event for event in self.events if isinstance(event, View)]


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
    assert link.client.header == Header(
        hashlib.sha256(container()).hexdigest(),
        len(container()),
        planned.bytes,
        index().header.extent,
        (index().index.offset, index().index.length),
        (index().metadata.offset, index().metadata.length),
        planned.prefix,
    )
    last = planned.marks[-1]
    assert link.client.layer == Layer(last.number, last.level, last.bytes, last.rms, last.max_error)
    assert link.server.sent == sum(part.length for part in (*planned.before, *planned.ranges, *planned.after))


def test_a_message_ends_where_a_layer_does() -> None:
    link = Link()
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
    link = Link()
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
    link = Link(ls.Target(seconds=5.0))
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
    with pytest.raises(RemoteError, match="level of 0 to 6, got 99") as told:
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
        (4404, "not-found: no such surface", RemoteError, "no such surface"),
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
    link = Link()
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


TARGETS = [
    ls.Target(),
    ls.Target(level=3),
    ls.Target(order="level"),
    ls.Target(level=2, order="level"),
    ls.Target(max_bytes=2000),
    ls.Target(until_rms=ls.Tolerance(1e-2, True)),
]


def messages_of(target: ls.Target, window: int) -> int:
    """How many messages the server has for a target."""
    link = Link(target, window)
    count = 0
    while link.serve() or link.to_server or link.to_client:
        if link.to_server:
            link.hear()
        if link.to_client:
            link.take()
            count += 1
    return count


@pytest.mark.parametrize("target", TARGETS, ids=repr)
def test_a_connection_that_breaks_after_any_message_is_gone_on_with(target: ls.Target) -> None:
    whole = Link(target, 700)
    whole.run()
    expected = whole.client.decoder
    for cut in range(messages_of(target, 700)):
        first = Link(target, 700)
        for _ in range(cut):
            while not first.to_client and (first.to_server or first.serve()):
                if first.to_server:
                    first.hear()
            if first.client.ended is None:
                first.take()
        reception = first.client.reception
        second = Link(target, 700, reception=reception)
        second.run()
        assert reception.ended == whole.client.ended
        assert reception.data_bytes == reception.held.total == whole.client.reception.data_bytes
        decoder = reception.decoder
        assert (decoder.bytes, decoder.rms, decoder.max_error) == (expected.bytes, expected.rms, expected.max_error)
        assert decoder.metadata == expected.metadata
        assert second.client.header is not None
        assert second.client.header.planned == plan(index(), target).bytes
    assert np.array_equal(decoder.surface().points, expected.surface().points)


@given(
    target=st.sampled_from(TARGETS),
    window=st.sampled_from([100, 700, 5000]),
    cuts=st.lists(st.integers(0, 60), max_size=6),
    seed=st.integers(0, 2**32),
)
def test_however_often_it_breaks_in_whatever_order_events_come(
    target: ls.Target, window: int, cuts: list[int], seed: int
) -> None:
    """No deadlock, and credit that is never negative nor exceeded, over several connections."""
    schedule, reception = Random(seed), Reception(target)
    for steps in [*cuts, 100_000]:
        link = Link(target, window, reception=reception)
        for _ in range(steps):
            choices = ["serve", *["hear"] * bool(link.to_server), *["take"] * bool(link.to_client)]
            choice = schedule.choice(choices)
            if choice == "hear":
                link.hear()
            elif choice == "take":
                link.take()
            elif not link.serve() and len(choices) == 1:
                break
            assert 0 <= link.in_flight <= link.client.credit <= window
        if reception.ended is not None:
            break
    assert reception.ended == plan(index(), target).ended
    assert reception.data_bytes == reception.held.total
    assert reception.decoder.bytes == plan(index(), target).bytes


def test_another_container_is_not_mixed_with_the_one_held() -> None:
    reception = Reception(container="0" * 64)
    link = Link(reception=reception)
    with pytest.raises(MessageError, match="expected container") as refused:
        link.hear()
    assert refused.value.code == "other-container"
    reception = Reception()
    reception.identify("0" * 64, 10)
    with pytest.raises(RemoteError, match="has changed") as told:
        reception.identify("1" * 64, 10)
    assert told.value.code == "other-container"
    with pytest.raises(RemoteError, match="has changed"):
        reception.identify("0" * 64, 11)


@pytest.mark.parametrize(
    ("held", "known", "words"),
    [(((0, 5),), False, "open.container"), (((0, 5), (10, 10**9)), True, "to byte")],
)
def test_a_list_of_what_is_held_that_cannot_be(held: tuple[tuple[int, int], ...], known: bool, words: str) -> None:
    sha256 = hashlib.sha256(container()).hexdigest()
    server = Sender(index(), sha256)
    with pytest.raises(MessageError, match=words) as refused:
        server.receive(serialize(Open(held=held, container=sha256 if known else None)))
    assert refused.value.code == "bad-held"


def test_what_is_held_in_very_many_pieces_is_told_as_far_as_a_message_goes() -> None:
    reception = Reception(container="0" * 64)
    for number in range(MAX_HELD + 10):
        reception.held.add(number * 10, 5 if number % 500 else 1)
    opening = parse(Download(reception=reception).data_to_send()[0])
    assert isinstance(opening, Open)
    assert len(opening.held) == MAX_HELD
    assert list(opening.held) == sorted(opening.held)
    assert {length for _, length in opening.held} == {5}


def test_a_server_that_sends_what_is_held_does_no_harm() -> None:
    first = Link(window=700)
    for _ in range(9):
        if first.to_server:
            first.hear()
        first.serve()
    while first.to_client:
        first.take()
    reception = first.client.reception
    assert 0 < reception.held.total < len(container())
    reception.container = None  # so that the next connection cannot say what is held
    Link(window=700, reception=reception).run()
    assert reception.ended == "complete"
    assert reception.data_bytes > reception.held.total
    assert np.array_equal(reception.decoder.surface().points, ls.decode(container()).points)


def test_bytes_behind_the_end_of_the_container_are_refused() -> None:
    reception = Reception(size=100)
    with pytest.raises(RemoteProtocolError, match="expected bytes of 100"):
        reception.take(90, bytes(11))


def test_the_window_grows_on_a_link_that_is_fast_and_far() -> None:
    client = Download()
    assert client.window.size == MIN_WINDOW
    client.tick(0.0)
    server = Sender(index(), hashlib.sha256(container()).hexdigest())
    now = 0.0
    while client.ended is None:
        for message in client.data_to_send():
            server.receive(message)
        now += 0.1
        while True:
            answer, wanted = server.next_message(), server.wanted()
            if answer is not None:
                client.receive(answer, now)
            elif wanted is not None:
                server.provide(wanted, container()[wanted.offset : wanted.end])
            else:
                break
    assert client.window.round_trip == pytest.approx(0.1)
