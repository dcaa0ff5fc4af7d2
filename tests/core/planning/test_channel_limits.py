"""Streams that stop by errors of channels: never above a limit, and at the first state that meets all of them."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container import Index
from lodestream.planning.limits import ErrorLimits
from lodestream.planning.planner import plan
from lodestream.protocol.connection import State
from lodestream.protocol.messages import Open, Opened, Stop
from lodestream.protocol.wire import parse, serialize
from lodestream.target import Order
from lodestream.transfer.download import Download, Ended
from lodestream.transfer.sender import Sender
from tests.examples import examples

from ..surfaces import index_of, terrain

SHAPE = 30, 25
NAMES = ("z", "speed", "wind_0", "wind_1", "wind")


@cache
def surface() -> ls.Surface:
    wind = np.stack([terrain(SHAPE, 4), 20 * terrain(SHAPE, 5)], axis=2).astype(np.float32)
    return ls.Surface(terrain(SHAPE), attributes={"speed": terrain(SHAPE, 3) / 100, "wind": wind})


@cache
def made() -> tuple[bytes, Index]:
    container = ls.encode(surface())
    return container, index_of(container)


def differences(view: ls.View, name: str) -> NDArray[Any]:
    """Distances of a view from the original, (row, column), of a channel or an attribute."""
    shown, original = view.surface(), surface()
    base, _, part = name.partition("_")
    one, other = (each.points if base == "z" else each.attributes[base] for each in (shown, original))
    delta: NDArray[Any] = one.astype(np.float64) - other
    if part:
        delta = delta[..., int(part)]
    elif delta.ndim == 3:
        delta = np.sqrt((delta**2).sum(axis=2))
    return delta


def error(view: ls.View, name: str, which: str) -> float:
    delta = differences(view, name)
    return float(np.sqrt((delta**2).mean()) if which == "rms" else np.abs(delta).max())


limits = st.dictionaries(st.sampled_from(NAMES), st.floats(-4, 2).map(lambda power: 10.0**power), max_size=3)


@examples(13)
@given(rms=limits, worst=limits, order=st.sampled_from(["quality", "level"]))
def test_no_stream_stops_while_an_error_is_above_its_limit(
    rms: dict[str, float], worst: dict[str, float], order: Order
) -> None:
    container, index = made()
    target = ls.Target(until_rms=rms, until_max=worst, order=order)
    chosen = plan(index, target)
    decoder = ls.Decoder()
    for place in (*chosen.before, *chosen.ranges, *chosen.after):
        decoder.feed_at(place.offset, container[place.offset : place.end])
    view = decoder.view()
    assert view.bytes == chosen.bytes
    for which, given_ in (("rms", rms), ("max", worst)):
        for name, limit in given_.items():
            assert error(view, name, which) <= limit * (1 + 1e-12)
    # And none before it is told to meet all of them.
    wanted = ErrorLimits.of(target, index.header)
    for mark in chosen.marks[:-1]:
        assert wanted.met(mark.rms, mark.max_error, mark.channels) is None
    assert chosen.ended in ("complete", "channels" if rms or worst else "complete")


class Old(Sender):
    """A server of a release that knows nothing of errors of channels."""

    def receive(self, message: bytes) -> Any:
        event = parse(message)
        if isinstance(event, Open):
            message = serialize(replace(event, target=replace(event.target, until_rms=None, until_max=None)))
        return super().receive(message)


@pytest.mark.parametrize("kind", [Sender, Old])
@pytest.mark.parametrize("order", ["quality", "level"])
def test_a_client_stops_by_itself_where_the_server_does_not_know_them(kind: type[Sender], order: Order) -> None:
    container, index = made()
    some = plan(index, ls.Target(order=order)).marks[-2].channels
    rms, worst = some[1][0], 1.01 * float(np.hypot(some[2][1], some[3][1]))
    target = ls.Target(until_rms={"speed": rms}, until_max={"wind": worst}, order=order)
    client, server = Download(target, window=2000), kind(index, "0" * 64)
    events: list[Any] = []
    stops = 0
    while server.state is not State.CLOSED:
        for message in client.data_to_send():
            stops += isinstance(server.receive(message), Stop)
        while (wanted := server.wanted()) is not None:
            server.provide(wanted, container[wanted.offset : wanted.end])
        if (answer := server.next_message()) is not None:
            events += client.receive(answer)
    chosen = plan(index, target)
    assert chosen.ended == "channels"
    assert chosen.bytes < plan(index, ls.Target(order=order)).bytes
    *views, last = events
    assert last == Ended("channels")
    assert [view.bytes for view in views] == [mark.bytes for mark in chosen.marks]
    assert views[-1].channels == chosen.marks[-1].channels
    assert isinstance(client.answer, Opened)
    assert (client.answer.channels, stops) == ((True, 0) if kind is Sender else (None, 1))
    assert error(views[-1], "speed", "rms") <= rms
    assert error(views[-1], "wind", "max") <= worst


def test_of_components_the_error_is_that_of_the_distance() -> None:
    _, index = made()
    header = index.header
    targets = ls.Target(until_rms={"wind": 1.0}), ls.Target(until_max={"wind": 1.0})
    for record, (which, target) in itertools.product(index.layers, enumerate(targets)):
        together = ErrorLimits.of(target, header).channels[0].error(record.channels)
        assert together == pytest.approx(np.hypot(record.channels[2][which], record.channels[3][which]))


def test_a_surface_of_one_channel_has_the_error_of_the_whole() -> None:
    index = index_of(ls.encode(terrain(SHAPE)))
    limit = index.layers[3].rms
    named, whole = plan(index, ls.Target(until_rms={"z": limit})), plan(index, ls.Target(until_rms=limit))
    assert (named.bytes, named.ended, whole.ended) == (whole.bytes, "channels", "rms")


@pytest.mark.parametrize(
    ("target", "expected"),
    [
        (ls.Target(until_rms={"pressure": 1}), "one of z, speed, wind_0, wind_1, wind, got one of 'pressure'"),
        (ls.Target(until_max={"speed": 1}, attributes=("wind",)), "one of z, wind_0, wind_1, wind, got one of 'speed'"),
    ],
)
def test_what_the_surface_does_not_have_is_refused_with_what_it_has(target: ls.Target, expected: str) -> None:
    with pytest.raises(ls.OptionError, match=re.escape(expected)):
        plan(made()[1], target)
