"""What has come goes on from one connection to the next: whatever breaks, nothing comes twice and nothing is missed."""

from __future__ import annotations

import hashlib
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.errors import RemoteError, RemoteProtocolError
from lodestream.planning.planner import plan
from lodestream.protocol.flow_control import FIRST_WINDOW
from lodestream.protocol.messages import MAX_HELD, MessageError, Open
from lodestream.protocol.wire import parse, serialize
from lodestream.transfer.download import Download
from lodestream.transfer.receiver_state import ReceiverState
from lodestream.transfer.sender import Sender

from ..protocol.talk import Link, container, index

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
        assert reception.data_bytes == reception.cached.total == whole.client.reception.data_bytes
        decoder = reception.decoder
        assert (decoder.bytes, decoder.rms, decoder.max_error) == (expected.bytes, expected.rms, expected.max_error)
        assert decoder.metadata == expected.metadata
        assert second.client.answer is not None
        assert second.client.answer.planned == plan(index(), target).bytes
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
    schedule, reception = Random(seed), ReceiverState(target)
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
    assert reception.data_bytes == reception.cached.total
    assert reception.decoder.bytes == plan(index(), target).bytes


def test_another_container_is_not_mixed_with_the_one_held() -> None:
    reception = ReceiverState(container="0" * 64)
    link = Link(reception=reception)
    with pytest.raises(MessageError, match="expected container") as refused:
        link.hear()
    assert refused.value.code == "other-container"
    reception = ReceiverState()
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
    reception = ReceiverState(container="0" * 64)
    for number in range(MAX_HELD + 10):
        reception.cached.add(number * 10, 5 if number % 500 else 1)
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
    assert 0 < reception.cached.total < len(container())
    reception.container = None  # so that the next connection cannot say what is held
    Link(window=700, reception=reception).run()
    assert reception.ended == "complete"
    assert reception.data_bytes > reception.cached.total
    assert np.array_equal(reception.decoder.surface().points, ls.decode(container()).points)


def test_bytes_behind_the_end_of_the_container_are_refused() -> None:
    reception = ReceiverState(size=100)
    with pytest.raises(RemoteProtocolError, match="expected bytes of 100"):
        reception.take(90, bytes(11))


def test_the_window_grows_on_a_link_that_is_fast_and_far() -> None:
    client = Download()
    assert client.window.size == FIRST_WINDOW
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
