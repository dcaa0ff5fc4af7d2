"""Two machines without I/O: turns, credit, and every order in which messages can cross."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from random import Random

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream.errors import LocalProtocolError, UnsupportedVersionError
from lodestream.protocol.connection import TRANSITIONS, Connection, Side, State
from lodestream.protocol.messages import (
    BASE_CREDIT,
    CODES,
    MAX_CREDIT,
    MAX_DATA,
    Bye,
    Credit,
    End,
    Error,
    Event,
    Layer,
    MessageError,
    Open,
    Opened,
    Segments,
    Stop,
)
from lodestream.protocol.wire import serialize
from tests.examples import examples

HEADER = Opened("0" * 64, 1000, 900, 1.0, (930, 40), (900, 30), True)
SAMPLES: dict[type[Event], Event] = {
    Open: Open(credit=100),
    Credit: Credit(50),
    Stop: Stop(),
    Bye: Bye(),
    Opened: HEADER,
    Segments: Segments(0, b"x" * 10),
    Layer: Layer(0, 0, 10, 0.5, 1.0),
    End: End("complete"),
    Error: Error("internal", "The server failed", "..."),
}


def pair() -> tuple[Connection, Connection]:
    return Connection(Side.CLIENT), Connection(Side.SERVER)


def opened(credit: int = 100) -> tuple[Connection, Connection]:
    client, server = pair()
    server.receive(client.send(Open(credit=credit)))
    client.receive(server.send(HEADER))
    return client, server


def test_a_stream_from_open_to_bye() -> None:
    client, server = opened()
    for event in (Segments(0, b"abc"), SAMPLES[Layer], End("complete")):
        assert client.receive(server.send(event)) == event
    assert server.receive(client.send(Bye())) == Bye()
    assert client.state is server.state is State.CLOSED


@pytest.mark.parametrize("sending", [True, False])
@pytest.mark.parametrize(("side", "state"), [(side, state) for side in Side for state in TRANSITIONS[side]])
def test_what_the_table_does_not_allow_is_refused(side: Side, state: State, sending: bool) -> None:
    moves = TRANSITIONS[side][state][0 if sending else 1]
    for kind, event in SAMPLES.items():
        connection = Connection(side)
        connection.state, connection.credit = state, 0 if kind is Open else 100

        def act(connection: Connection = connection, event: Event = event) -> object:
            return connection.send(event) if sending else connection.receive(serialize(event))

        if kind in moves:
            act()
            assert connection.state is moves[kind]
        else:
            with pytest.raises(LocalProtocolError if sending else MessageError) as refused:
                act()
            assert event.type in str(refused.value)
            assert state.value in str(refused.value)
            assert connection.state is state


def test_every_state_is_reached_and_every_end_is_silent() -> None:
    for side, table in TRANSITIONS.items():
        reached = {State.IDLE}
        for _ in State:
            for state in list(reached):
                sends, receives = table[state]
                reached |= {*sends.values(), *receives.values()}
        assert reached == set(table)
        assert not table[State.FAILED][0]
        assert not table[State.CLOSED][0], side


def test_what_one_side_may_send_the_other_side_knows() -> None:
    kinds = {side: {kind for sends, _ in TRANSITIONS[side].values() for kind in sends} for side in Side}
    heard = {side: {kind for _, receives in TRANSITIONS[side].values() for kind in receives} for side in Side}
    assert kinds[Side.CLIENT] == heard[Side.SERVER] == {Open, Credit, Stop, Bye}
    assert kinds[Side.SERVER] == heard[Side.CLIENT] == {Opened, Segments, Layer, End, Error}


def test_the_server_cannot_send_beyond_the_credit() -> None:
    client, server = opened(credit=10)
    with pytest.raises(LocalProtocolError, match="1 to 10 bytes"):
        server.send(Segments(0, bytes(11)))
    client.receive(server.send(Segments(0, bytes(10))))
    with pytest.raises(LocalProtocolError, match="credit is 0"):
        server.send(Segments(10, b"x"))
    server.receive(client.send(Credit(1)))
    client.receive(server.send(Segments(10, b"x")))
    assert client.credit == server.credit == 0


def test_the_client_refuses_what_comes_beyond_the_credit() -> None:
    client, _ = opened(credit=10)
    with pytest.raises(MessageError, match="at most 10 bytes") as refused:
        client.receive(serialize(Segments(0, bytes(11))))
    assert refused.value.code == "out-of-turn"
    assert client.credit == 10


def test_a_message_is_never_larger_than_the_limit() -> None:
    _, server = opened(credit=BASE_CREDIT)
    with pytest.raises(LocalProtocolError, match=str(MAX_DATA)):
        server.send(Segments(0, bytes(MAX_DATA + 1)))


def test_the_client_cannot_grant_more_than_the_cap() -> None:
    client, server = opened(credit=BASE_CREDIT - 5)
    with pytest.raises(LocalProtocolError, match="1 to 5 bytes"):
        client.send(Credit(6))
    with pytest.raises(LocalProtocolError):
        client.send(Credit(0))
    server.receive(client.send(Credit(5)))
    assert server.credit == BASE_CREDIT
    with pytest.raises(LocalProtocolError):
        Connection(Side.CLIENT).send(Open(credit=-1))


def test_the_server_forgets_what_is_granted_beyond_the_cap() -> None:
    server = Connection(Side.SERVER)
    server.receive(serialize(Open(credit=10 * BASE_CREDIT)))
    assert server.credit == BASE_CREDIT
    server.send(HEADER)
    server.send(Segments(0, bytes(100)))
    server.receive(serialize(Credit(2**50)))
    assert server.credit == BASE_CREDIT


def test_a_server_may_keep_more_than_every_server_does() -> None:
    client, server = Connection(Side.CLIENT), Connection(Side.SERVER, MAX_CREDIT)
    server.receive(client.send(Open(credit=BASE_CREDIT)))
    with pytest.raises(LocalProtocolError):
        client.send(Credit(1))  # it may be a server of an earlier release, which would forget it
    client.receive(server.send(replace(HEADER, credit=MAX_CREDIT)))
    assert client.most == MAX_CREDIT
    server.receive(client.send(Credit(MAX_CREDIT - BASE_CREDIT)))
    assert client.credit == server.credit == MAX_CREDIT
    server.receive(serialize(Credit(2**50)))
    assert server.credit == MAX_CREDIT


def test_a_client_believes_no_more_credit_than_there_can_be() -> None:
    client = Connection(Side.CLIENT)
    client.send(Open(credit=1))
    client.receive(serialize(replace(HEADER, credit=2**53)))
    assert client.most == MAX_CREDIT
    fields = msgpack.unpackb(serialize(HEADER))
    assert "credit" not in fields
    with pytest.raises(MessageError, match=r"header.credit to be an integer from 262144 to 2\^53"):
        Connection(Side.CLIENT).receive(msgpack.packb(fields | {"credit": BASE_CREDIT - 1}))


def test_after_stop_the_server_can_only_end() -> None:
    client, server = opened()
    under_way = server.send(Segments(0, b"abc"))
    stop = client.send(Stop())
    assert server.receive(stop) == Stop()
    for event in (Segments(3, b"d"), SAMPLES[Layer], HEADER):
        with pytest.raises(LocalProtocolError, match="end or error"):
            server.send(event)
    end = server.send(End("stopped"))
    assert client.receive(under_way) == Segments(0, b"abc")
    assert client.receive(end) == End("stopped")
    with pytest.raises(LocalProtocolError, match="bye"):
        client.send(Credit(1))
    server.receive(client.send(Bye()))
    assert server.state is State.CLOSED


def test_a_client_may_stop_before_the_header() -> None:
    client, server = pair()
    opening = client.send(Open(credit=1))
    stop = client.send(Stop())
    server.receive(opening)
    header = server.send(HEADER)
    server.receive(stop)
    end = server.send(End("stopped"))
    assert [client.receive(message) for message in (header, end)] == [HEADER, End("stopped")]
    client, server = pair()
    server.receive(client.send(Open(credit=1)))
    server.receive(client.send(Stop()))
    client.receive(server.send(End("stopped")))
    assert client.state is State.ENDED


def test_what_was_left_of_the_credit_ends_with_the_stream() -> None:
    client, server = opened(credit=100)
    end = server.send(End("complete"))
    server.receive(client.send(Credit(5)))
    client.receive(end)
    server.receive(client.send(Open(credit=7)))
    assert client.credit == server.credit == 7
    client.receive(server.send(HEADER))
    client.receive(server.send(Segments(0, b"again")))
    assert client.credit == server.credit == 2


def test_two_headers_are_refused_even_after_a_stop() -> None:
    client, server = opened()
    client.send(Stop())
    with pytest.raises(MessageError, match="got header"):
        client.receive(serialize(HEADER))
    assert server.state is State.STREAMING


def test_credit_and_stop_may_cross_the_end() -> None:
    client, server = opened()
    end = server.send(End("complete"))
    server.receive(client.send(Credit(5)))
    server.receive(client.send(Stop()))
    client.receive(end)
    server.receive(client.send(Bye()))
    assert client.state is server.state is State.CLOSED


def test_an_error_is_the_last_word_and_what_was_under_way_is_ignored() -> None:
    client, server = opened()
    under_way = [client.send(Credit(5)), client.send(Stop())]
    client.receive(server.send(SAMPLES[Error]))
    for message in under_way:
        server.receive(message)
    assert client.state is server.state is State.FAILED
    with pytest.raises(LocalProtocolError):
        server.send(End("complete"))


def test_a_bad_message_leaves_the_server_able_to_say_so() -> None:
    _, server = opened()
    with pytest.raises(MessageError):
        server.receive(b"garbage")
    with pytest.raises(UnsupportedVersionError):
        Connection(Side.SERVER).receive(serialize(Open()).replace(b"version\x01", b"version\x09"))
    server.send(SAMPLES[Error])
    assert server.state is State.FAILED


def test_each_error_code_has_a_close_code_that_an_application_may_use() -> None:
    for word, code in CODES.items():
        assert code.close in {1009, 1011, 1012} or 4000 <= code.close < 5000, word
        assert code.title


def moves(client: Connection, server: Connection, window: int, left: int) -> list[str]:
    """What either side may say next, of a stream with ``left`` bytes to send."""
    choices = []
    if client.state in (State.OPENED, State.STREAMING):
        if client.credit < window:
            choices.append("grant")
        choices.append("stop")
    if client.state is State.ENDED:
        choices += ["bye", "open again"]
    if server.state is State.OPENED:
        choices.append("header")
    if server.state is State.STREAMING and left and server.credit:
        choices.append("segments")
    if (server.state is State.STREAMING and not left) or server.state is State.STOPPING:
        choices.append("end")
    return choices


@examples(150)
@given(window=st.integers(1, 300), left=st.integers(0, 1000), seed=st.integers(0, 2**32))
def test_every_interleaving_of_honest_peers_ends(window: int, left: int, seed: int) -> None:
    """Messages cross in any order; nobody is ever accused, credit is never negative, and `stop` always ends."""
    client, server = pair()
    random = Random(seed)
    to_server: deque[bytes] = deque()
    to_client: deque[bytes] = deque()
    to_server.append(client.send(Open(credit=window)))
    received = sent = after_stop = 0
    stopped_at: int | None = None
    for _ in range(3000):
        choices = ["deliver to server"] * bool(to_server) + ["deliver to client"] * bool(to_client)
        choices += moves(client, server, window, left)
        if not choices:
            break
        # Stopping is rare, so that whole streams are seen too.
        if "stop" in choices and len(choices) > 1 and random.randrange(31):
            choices.remove("stop")
        match random.choice(choices):
            case "deliver to server":
                server.receive(to_server.popleft())
            case "deliver to client":
                event = client.receive(to_client.popleft())
                if isinstance(event, Segments):
                    received += len(event.data)
                    after_stop += len(event.data) if stopped_at is not None else 0
            case "open again":
                assert not to_client, "nothing follows an end"
                stopped_at, after_stop = None, 0
                to_server.append(client.send(Open(credit=random.randint(0, window))))
            case "grant":
                to_server.append(client.send(Credit(random.randint(1, window - client.credit))))
            case "stop":
                stopped_at = client.credit
                to_server.append(client.send(Stop()))
            case "bye":
                to_server.append(client.send(Bye()))
            case "header":
                to_client.append(server.send(HEADER))
            case "segments":
                size = random.randint(1, min(left, server.credit))
                to_client.append(server.send(Segments(sent, bytes(size))))
                sent, left = sent + size, left - size
            case "end":
                why = "stopped" if server.state is State.STOPPING else "complete"
                to_client.append(server.send(End(why)))
        # What a server has left of an end is worth nothing: the next open says how much there is.
        assert server.state is State.ENDED or 0 <= server.credit <= client.credit
        assert 0 <= client.credit <= window
        assert sent - received <= window
    assert client.state is server.state is State.CLOSED
    assert received == sent
    assert after_stop <= (stopped_at or 0)
