"""The core of a stream by scripted effects: every decision, without a socket and without waiting."""

from __future__ import annotations

from dataclasses import fields
from itertools import pairwise
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.datastructures import Headers
from websockets.exceptions import InvalidStatus
from websockets.http11 import Response

import lodestream as ls
from lodestream.errors import LodestreamError, NotFoundError, OptionError, RemoteError, TruncatedStreamError
from lodestream.protocol.handshake import MAX_OPENING
from lodestream.protocol.messages import SUBPROTOCOL, Bye, Credit, Error, Open, Stop
from lodestream.protocol.wire import serialize
from lodestream.transfer.receiver_state import MemoryStore
from lodestream_client.errors import SilenceError, UnreachableError
from lodestream_client.requests.answers import Head
from lodestream_client.stream.core import Core
from lodestream_client.stream.effects import (
    Ahead,
    Dial,
    DialError,
    Dialled,
    Effect,
    Get,
    HangUp,
    Hear,
    Read,
    Send,
    Wait,
)
from lodestream_client.stream.options import ConnectKeywords, ConnectOptions
from lodestream_client.stream.session import Session
from tests.examples import examples

from .world import NEAR, STEP, URL, Act, World, container, heights

FILE = "http://one/ab.lode"


def check_order(effects: list[Effect]) -> None:
    """No effect comes where it makes no sense."""
    dialled = answered = False
    for effect, following in pairwise([*effects, Wait(0.0)]):
        if isinstance(effect, Hear):
            assert dialled
        if isinstance(effect, Read):
            assert answered
        if isinstance(effect, Dial):
            dialled, answered = True, False
            assert not isinstance(following, Read)
        if isinstance(effect, Get):
            dialled, answered = False, True
        if isinstance(effect, HangUp):
            dialled = answered = False


def next_effect(core: Core) -> Effect | None:
    """What is to be done next; a call, since type checkers take an attribute to stay what it was."""
    return core.effect


def complete(world: World) -> None:
    assert world.session.ended == "complete"
    assert np.array_equal(world.session.reception.decoder.surface().points, heights())
    assert world.session.reception.data_bytes == world.session.reception.cached.total, "nothing came twice"
    assert world.views[-1].complete


@pytest.mark.parametrize("options", [{}, {"transport": "http"}, {"transport": "ws", "window": 500}])
def test_a_stream_without_faults(options: dict[str, Any]) -> None:
    world = World(**options).run()
    complete(world)
    check_order(world.effects)
    assert not any(isinstance(effect, Wait) for effect in world.effects)
    assert isinstance(world.effects[0], Get if "http" in options.values() else Dial)
    assert isinstance(world.effects[-1], HangUp)
    assert world.core.effect is None


def test_the_plain_file_of_any_web_server() -> None:
    world = World(url=FILE).run()
    complete(world)
    assert {type(effect) for effect in world.effects} == {Get, Read, HangUp}


@pytest.mark.parametrize("target", [None, ls.Target(region=NEAR), ls.Target(order="level")], ids=repr)
def test_the_next_range_is_asked_for_before_the_last_one_has_come_and_before_a_view_is_looked_at(target: Any) -> None:
    world = World(transport="http", target=target)
    waiting = 0
    while (effect := next_effect(world.core)) is not None:
        if isinstance(effect, Get) and world.session.ranges is not None and world.session.ranges.requests > 1:
            waiting += world.ahead is None
        world.step(effect)
        if world.session.shows and isinstance(next_effect(world.core), Ahead):
            assert world.core.next_view() is None
        elif (view := world.core.next_view()) is not None:
            assert not isinstance(next_effect(world.core), Get) or world.ahead is not None
            world.views.append(view)
    assert world.session.ended == "complete"
    assert world.in_vain == 0
    assert world.session.ranges is not None
    # What only an index tells can be asked for no sooner.
    assert waiting <= 1


def test_a_request_made_ahead_takes_no_longer_than_the_target_allows() -> None:
    world = World(url=FILE, target=ls.Target(order="level", seconds=0.5)).run()
    asked = [effect.get for effect in world.effects if isinstance(effect, Ahead)]
    assert asked
    assert all(get.seconds <= 0.5 for get in asked)


def test_a_server_that_refuses_a_second_request_is_asked_one_by_one() -> None:
    world = World(url=FILE, target=ls.Target(order="level"))
    while not isinstance(effect := next_effect(world.core), Ahead):
        assert effect is not None
        world.step(effect)
    world.step(effect)
    while not isinstance(effect := next_effect(world.core), Get):
        assert effect is not None
        world.step(effect)
    refused = len(world.effects)
    world.acts = {refused: "break"}
    world.run()
    complete(world)
    after = world.effects[refused + 1 :]
    assert not any(isinstance(one, Ahead) and isinstance(two, Read) for one, two in pairwise(after))
    assert any(isinstance(each, Get) for each in after)


@given(
    st.dictionaries(st.integers(0, 120), st.sampled_from(["break", "silence", "cancel", "focus"]), max_size=12),
    st.sampled_from(["auto", "ws", "http"]),
    st.sampled_from([None, 500, 4096]),
    st.sampled_from([None, 5000.0]),
)
@examples(30)
def test_whatever_breaks_the_surface_comes_once_and_whole(
    acts: dict[int, Act], transport: Any, window: int | None, rate: float | None
) -> None:
    world = World(acts, transport=transport, window=window, limit_rate=rate, deadline=1e6, silence=2.0)
    try:
        world.run()
    except LodestreamError:
        # Before the server has answered once there are only three attempts.
        assert not world.session.transports.met
        assert world.session.ended == "truncated"
        assert world.core.effect is None
    else:
        complete(world)
    check_order(world.effects)


@given(
    st.dictionaries(st.integers(0, 60), st.sampled_from(["break", "silence", "cancel", "focus"]), max_size=5),
    st.integers(0, 60),
    st.sampled_from(["stop", "close"]),
    st.sampled_from(["auto", "ws", "http"]),
)
@examples(30)
def test_a_stop_at_any_time_is_obeyed(acts: dict[int, Act], number: int, stop: Act, transport: Any) -> None:
    world = World({**acts, number: stop}, transport=transport, window=700, close_timeout=3.0, silence=2.0, deadline=1e6)
    try:
        world.run()
    except LodestreamError:
        assert world.session.ended == "truncated"
        assert not world.session.transports.met
        return
    if world.stopped_at is None:
        assert world.session.ended == "complete"
        return
    assert world.session.ended in ("stopped", "complete")
    after = world.effects[world.stopped_at :]
    assert not any(isinstance(effect, Dial | Get) for effect in after), "nothing new is asked for"
    check_order(world.effects)
    assert world.core.effect is None


@given(st.integers(0, 40), st.floats(0.5, 30.0), st.sampled_from(["ws", "http", "auto"]))
@examples(50)
def test_a_server_that_is_gone_is_given_up_in_time(first: int, deadline: float, transport: Any) -> None:
    acts: dict[int, Act] = dict.fromkeys(range(first, 5000), "break")
    world = World(acts, transport=transport, window=500, deadline=deadline)
    lost = (first + 1) * STEP
    try:
        world.run()
    except (UnreachableError, TruncatedStreamError):
        assert world.session.ended == "truncated"
        waits = [effect.until for effect in world.effects if isinstance(effect, Wait)]
        assert max(waits, default=0.0) < lost + deadline
    else:
        complete(world)  # all had come before


def test_an_effect_that_was_interrupted_is_carried_out_again() -> None:
    acts: dict[int, Act] = dict.fromkeys(range(0, 200, 2), "cancel")
    world = World(acts, window=500).run()
    complete(world)
    for one, other in list(pairwise(world.effects[:200]))[::2]:
        assert one is other


def test_waits_that_are_interrupted_get_no_longer() -> None:
    acts: dict[int, Act] = dict.fromkeys(range(0, 2000, 2), "cancel")
    world = World(acts, limit_rate=5000.0).run()
    complete(world)
    assert world.now < world.session.reception.data_bytes / 5000.0 + len(world.effects) * STEP


def test_silence_is_an_error_only_when_nothing_replaces_the_connection() -> None:
    for transport in ("ws", "http"):
        acts: dict[int, Act] = dict.fromkeys(range(4, 5000), "silence")
        world = World(acts, transport=transport, window=500, silence=2.0, deadline=0)
        with pytest.raises(SilenceError, match="has sent nothing for 2 seconds"):
            world.run()
    complete(World({6: "silence"}, window=500).run())


def refused(dial: Dial, status: int, url: str | None = None) -> DialError:
    """A handshake answered by a status, where redirects led."""
    error = DialError(url or dial.url)
    error.__cause__ = InvalidStatus(Response(status, "No", Headers(), b""))
    return error


def test_an_address_without_websockets_is_received_over_http() -> None:
    core = Core(Session(URL, ConnectOptions(), lambda: 7.0))
    assert isinstance(core.effect, Dial)
    core.failed(refused(core.effect, 501))
    assert next_effect(core) == HangUp(abort=True)
    core.done(None)
    assert next_effect(core) == Wait(7.0)
    core.done(None)
    assert isinstance(core.effect, Get)
    assert core.effect.url == f"{URL}/container"


def test_a_token_stays_with_its_server() -> None:
    core = Core(Session(URL, ConnectOptions(token="secret", transport="http")))
    first = core.effect
    assert isinstance(first, Get)
    assert first.headers["Authorization"] == "Bearer secret"
    size = len(container())
    last = int(first.headers["Range"].rpartition("-")[2])
    told = {"etag": '"1"', "content-range": f"bytes 0-{min(last, size - 1)}/{size}"}
    core.done(Head(206, "", told, "http://other/ab.lode"))
    core.done(container()[:2000])
    core.done(container()[2000 : last + 1])
    while isinstance(core.effect, Read):
        core.done(b"")
    if isinstance(core.effect, Get):
        assert core.effect.url == "http://other/ab.lode"
        assert "Authorization" not in core.effect.headers


def test_a_refusal_says_that_the_token_was_withheld() -> None:
    core = Core(Session(URL, ConnectOptions(token="secret", transport="http")))
    assert isinstance(core.effect, Get)
    core.done(Head(404, "Not Found", {}, "http://other/v1/surfaces/ab/container"))
    assert next_effect(core) == Read()
    core.done(b'{"code": "not-found", "detail": "No such surface"}')
    core.done(b"")
    assert next_effect(core) == HangUp(abort=True)
    with pytest.raises(NotFoundError, match=r"No such surface; the token was not sent to http://other"):
        core.done(None)
    assert next_effect(core) is None
    assert core.session.ended == "truncated"


def test_a_handshake_that_was_redirected_says_so_too() -> None:
    core = Core(Session(URL, ConnectOptions(token="secret", transport="ws")))
    assert isinstance(core.effect, Dial)
    assert core.effect.headers == {"Authorization": "Bearer secret"}
    core.failed(refused(core.effect, 403, "ws://other/v1/surfaces/ab/stream"))
    assert next_effect(core) == HangUp(abort=True)
    with pytest.raises(RemoteError, match=r"answered 403 .*; the token was not sent to http://other"):
        core.done(None)


def test_errors_that_no_library_raises_come_through() -> None:
    core = Core(Session(URL, ConnectOptions()))
    assert isinstance(core.effect, Dial)
    with pytest.raises(ZeroDivisionError):
        core.failed(ZeroDivisionError())
    assert next_effect(core) is None


def test_a_sink_that_fails_ends_the_stream() -> None:
    def fail(offset: int, data: bytes) -> None:
        raise OSError("the disk is full")

    world = World(sink=fail)
    with pytest.raises(OSError, match="the disk is full"):
        world.run()
    assert world.core.effect is None


def test_a_refused_opening_is_an_error_at_the_first_look() -> None:
    core = Core(Session(URL, ConnectOptions(window=0)))
    assert next_effect(core) == HangUp(abort=True)
    with pytest.raises(OptionError, match="expected a window"):
        core.done(None)


def test_an_opening_too_long_for_an_address_is_sent() -> None:
    store = MemoryStore()
    for offset in range(0, 8000, 20):
        store.write(offset, container()[offset : offset + 10])
    core = Core(Session(URL, ConnectOptions(store=store, container="ab" * 32, size=len(container()))))
    dial = core.effect
    assert isinstance(dial, Dial)
    assert "open=" not in dial.url
    core.done(Dialled(SUBPROTOCOL, dial.url))
    assert next_effect(core) == Send()
    (opening,) = core.session.messages()
    assert len(opening) > MAX_OPENING / 2


def test_time_is_limited_while_there_is_no_connection() -> None:
    acts: dict[int, Act] = dict.fromkeys(range(6, 5000), "break")
    world = World(acts, target=ls.Target(seconds=3.0), window=500, deadline=1e6).run()
    assert world.session.ended == "seconds"
    assert world.now == pytest.approx(3.0, abs=0.5)


@pytest.mark.parametrize("transport", ["ws", "http"])
def test_time_is_limited_while_data_come(transport: Any) -> None:
    world = World(transport=transport, target=ls.Target(seconds=2.0), limit_rate=2000.0, window=500).run()
    assert world.session.ended == "seconds"
    assert 2.0 <= world.now < 2.5
    assert world.views


def test_a_limited_rate_is_kept() -> None:
    world = World(limit_rate=5000.0).run()
    complete(world)
    assert world.now >= world.session.reception.data_bytes / 5000.0


def test_another_region_is_asked_for_over_the_same_websocket() -> None:
    world = World({8: "focus"}, transport="ws", window=500).run()
    complete(world)
    assert sum(isinstance(effect, Dial) for effect in world.effects) == 1
    changes = [event for event in world.sent if not isinstance(event, Credit)]
    assert changes == [Stop(), Open(ls.Target(first=NEAR), 500, decodes=True), Bye()]


def test_for_another_region_an_answer_is_left_and_another_range_is_asked_for() -> None:
    world = World({4: "focus"}, transport="http").run()
    complete(world)
    left = next(number for number, effect in enumerate(world.effects) if isinstance(effect, HangUp))
    assert isinstance(world.effects[left - 1], Read)
    assert isinstance(world.effects[left + 1], Get)
    assert left < len(world.effects) / 2


def test_closing_waits_no_longer_than_allowed() -> None:
    acts: dict[int, Act] = dict.fromkeys(range(7, 5000), "silence")
    world = World({**acts, 5: "close"}, window=500, close_timeout=3.0).run()
    assert world.session.ended == "stopped"
    assert world.now < 4.0


@pytest.mark.parametrize("transport", ["ws", "http"])
@pytest.mark.parametrize("number", range(1, 25))
def test_closing_does_not_wait_for_what_was_to_come_next(number: int, transport: Any) -> None:
    """The effect that is due when somebody closes was decided on when there was more time."""
    world = World(transport=transport, window=500, close_timeout=3.0)
    for _ in range(number):
        if (effect := next_effect(world.core)) is not None:
            world.step(effect)
    ended, began, world.acts = world.session.ended, world.now, dict.fromkeys(range(number, 5000), "silence")
    world.session.close()
    world.run()
    assert world.session.ended == (ended or "stopped")
    assert world.now - began < 3.0 + 10 * STEP


def test_while_somebody_looks_at_a_view_the_server_is_not_silent() -> None:
    world = World(transport="ws", window=500, silence=2.0)
    while world.core.next_view() is None:
        world.step(world.core.effect or pytest.fail("the stream is over"))
    world.now += 60.0
    effect = next_effect(world.core)
    assert isinstance(effect, Hear)
    assert effect.until > world.now + 1.9
    world.now += 1.0
    assert next_effect(world.core) is effect, "a wait that has begun goes on"


def test_the_keywords_of_connect_are_its_options() -> None:
    assert [*ConnectKeywords.__annotations__, "token"] == [field.name for field in fields(ConnectOptions)]
    assert len(fields(ConnectOptions)) == 14


def test_every_effect_is_a_frozen_value() -> None:
    kinds = get_args(Effect)
    assert len(kinds) == 8
    for kind in kinds:
        assert kind.__dataclass_params__.frozen


def test_options_that_make_no_sense() -> None:
    for options in (ConnectOptions(silence=0.0), ConnectOptions(limit_rate=0.0)):
        with pytest.raises(ValueError, match="expected a positive"):
            Session(URL, options)
    smoke: Any = "smoke"
    for options in (ConnectOptions(transport=smoke), ConnectOptions(deadline=-1.0)):
        with pytest.raises(OptionError):
            Session(URL, options)


def test_a_server_s_error_is_its_own_class() -> None:
    for code, kind in (("not-found", NotFoundError), ("damaged", RemoteError)):
        core = Core(Session(URL, ConnectOptions(deadline=0)))
        dial = core.effect
        assert isinstance(dial, Dial)
        core.done(Dialled(SUBPROTOCOL, dial.url))
        assert next_effect(core) == Send()
        core.done(None)
        assert isinstance(core.effect, Hear)
        core.done(serialize(Error(code, "Title", "detail")))
        assert next_effect(core) == HangUp(abort=True)
        with pytest.raises(kind, match=r"^detail$"):
            core.done(None)
