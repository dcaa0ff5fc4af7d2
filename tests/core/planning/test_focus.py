"""The focus of a stream: what a region needs comes first, nothing twice, and the end is the same."""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from random import Random
from types import FrameType

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container import ByteRange, Header, Index, read_index
from lodestream.decoding.view import View
from lodestream.errors import OptionError
from lodestream.planning.byte_ranges import RangeSet
from lodestream.planning.cost import plan_cost
from lodestream.planning.planner import plan
from lodestream.planning.selection import Selection
from lodestream.protocol.messages import MAX_DATA, MAX_HELD, End, Layer, MessageError, Open, Segments, Stop
from lodestream.protocol.wire import parse, serialize
from lodestream.target import Region
from lodestream.transfer.download import Download, Ended
from lodestream.transfer.receiver_state import MemoryStore, ReceiverState
from lodestream.transfer.sender import Sender
from tests.core.protocol.talk import without_decodes
from tests.examples import examples

SHAPE = (400, 530)
NEAR: Region = ((0, 60), (0, 70))
FAR: Region = ((340, 400), (450, 530))
TARGETS = [
    ls.Target(),
    ls.Target(order="level"),
    ls.Target(level=9),
    ls.Target(until_rms=ls.Tolerance(5e-4, True)),
    ls.Target(region=((0, 400), (0, 300))),
]
KINDS = ["integers", "floats", "holes"]


@cache
def container(kind: str) -> bytes:
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    heights = 300 * np.sin(rows / 70) * np.cos(columns / 50) + np.random.default_rng(5).normal(size=SHAPE)
    if kind == "integers":
        return ls.encode(np.rint(30 * heights).astype(np.int16))
    if kind == "holes":
        return ls.encode(np.where(np.hypot(rows - 200, columns - 200) < 50, np.nan, np.rint(30 * heights) + 0.0))
    return ls.encode((heights / 3).astype(np.float32))


@cache
def index(kind: str) -> Index:
    data = container(kind)
    return read_index(lambda offset, length: data[offset : offset + length], len(data))


class Link:
    """A client and a server joined by queues, one step of one of them at a time."""

    def __init__(self, kind: str, target: ls.Target, window: int, reception: ReceiverState | None = None) -> None:
        self.data = container(kind)
        self.reception = ReceiverState(target) if reception is None else reception
        self.client = Download(window=window, reception=self.reception)
        self.server = Sender(index(kind), hashlib.sha256(self.data).hexdigest())
        self.to_server: list[bytes] = []
        self.to_client: list[bytes] = []
        self.views: list[View] = []
        self.slices: list[tuple[int, int]] = []
        self.layers: list[Layer] = []
        self.decodes = True
        self.flush()

    def flush(self) -> None:
        self.to_server += self.client.data_to_send()

    def focus(self, region: Region | None) -> None:
        self.client.focus(region)
        self.flush()

    def serve(self) -> bool:
        message = self.server.next_message()
        if message is not None:
            self.to_client.append(message)
        elif (wanted := self.server.wanted()) is not None:
            self.server.provide(wanted, self.data[wanted.offset : wanted.end])
        else:
            return False
        return True

    def hear(self) -> None:
        message = self.to_server.pop(0)
        self.server.receive(message if self.decodes else without_decodes(message))

    def take(self) -> None:
        event = parse(self.to_client[0])
        if isinstance(event, Segments):
            self.slices.append((event.offset, len(event.data)))
        elif isinstance(event, Layer):
            self.layers.append(event)
        self.views += [made for made in self.client.receive(self.to_client.pop(0)) if not isinstance(made, Ended)]
        self.flush()

    def step(self, random: Random) -> bool:
        choices = ["serve", *["hear"] * bool(self.to_server), *["take"] * bool(self.to_client)]
        choice = random.choice(choices)
        if choice == "serve":
            return self.serve() or len(choices) > 1
        self.hear() if choice == "hear" else self.take()
        return True

    def run(self, until: int = 2**60) -> None:
        """Deliver everything in turns, until so many bytes have come or nothing is left to do."""
        while self.reception.data_bytes < until and (self.serve() or self.to_server or self.to_client):
            while self.to_server:
                self.hear()
            while self.to_client and self.reception.data_bytes < until:
                self.take()


def check_end(reception: ReceiverState, kind: str, target: ls.Target) -> None:
    """All that was promised has come, nothing twice, and shows what the target says."""
    chosen = plan(index(kind), target)
    assert reception.ended == chosen.ended
    assert reception.data_bytes == reception.cached.total
    assert reception.received == chosen.bytes
    view = reception.decoder.view()
    assert (view.bytes, view.rms, view.max_error) == (chosen.bytes, chosen.rms, chosen.max_error)
    expected = ls.Decoder(Selection(target.region))
    for place in chosen.slices:
        expected.feed_at(place.offset, container(kind)[place.offset : place.end])
    assert np.array_equal(view.surface(target.level).points, expected.surface(target.level).points, equal_nan=True)


@pytest.mark.parametrize("kind", KINDS)
@examples(3)
@given(
    target=st.sampled_from(TARGETS),
    window=st.sampled_from([900, 5000, 60_000]),
    turns=st.lists(st.tuples(st.integers(0, 120), st.sampled_from([NEAR, FAR, None])), max_size=4),
    cuts=st.lists(st.integers(0, 150), max_size=2),
    seed=st.integers(0, 2**32),
    stored=st.booleans(),
)
def test_whenever_one_looks_elsewhere_and_the_link_breaks(
    kind: str,
    target: ls.Target,
    window: int,
    turns: list[tuple[int, Region | None]],
    cuts: list[int],
    seed: int,
    stored: bool,
) -> None:
    random, reception = Random(seed), ReceiverState(target, store=MemoryStore() if stored else None)
    todo = list(turns)
    for steps in [*cuts, 10**6]:
        link = Link(kind, target, window, reception)
        pause = 0
        for _ in range(steps):
            if todo and pause >= todo[0][0]:
                link.focus(todo.pop(0)[1])
                pause = 0
            pause += 1
            if not link.step(random):
                break
        if reception.ended is not None:
            break
    check_end(reception, kind, target)


@pytest.mark.sweep(6)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("target", TARGETS, ids=repr)
def test_what_the_region_needs_comes_within_the_credit_that_is_outstanding(kind: str, target: ls.Target) -> None:
    total = plan(index(kind), target).bytes
    window = total // 50
    link = Link(kind, target, window)
    link.run(until=total // 8)
    before = link.reception.data_bytes
    link.focus(NEAR)
    link.run()
    near = Selection(NEAR).tiles(index(kind).header)
    wanted = RangeSet((s.range.offset, s.range.length) for s in index(kind).segments if near[s.tile])
    chosen = plan(index(kind), target)
    planned = RangeSet((place.offset, place.length) for place in chosen.ranges)
    order = [  # of what comes after the change: is it needed there?
        any(length for place in planned.overlap(*slice_) for _, length in wanted.overlap(*place))
        for slice_ in after(link.slices, before + window)
        if slice_[0] < index(kind).surface_end
    ]
    assert order == sorted(order, reverse=True)
    assert order.count(True) > 3
    # A level that is small has its tiles near everything.
    assert target.level is not None or order.count(False) > 3
    check_end(link.reception, kind, target)


def after(slices: Sequence[tuple[int, int]], count: int) -> list[tuple[int, int]]:
    """What of these slices comes after so many bytes."""
    left = []
    for offset, length in slices:
        skipped = min(length, max(count, 0))
        count -= length
        if length > skipped:
            left.append((offset + skipped, length - skipped))
    return left


@pytest.mark.parametrize("kind", ["integers", "holes"])
def test_the_region_is_exact_long_before_the_rest(kind: str) -> None:
    whole = ls.decode(container(kind)).points
    link = Link(kind, ls.Target(), 2000)
    link.focus(NEAR)
    link.run()
    place = tuple(slice(*span) for span in NEAR)
    first = next(view for view in link.views if np.array_equal(view.window(NEAR).points, whole[place]))
    assert first.bytes < 0.5 * index(kind).surface_end
    assert not np.array_equal(first.points, whole)


def test_errors_that_are_told_are_those_of_the_picture() -> None:
    link = Link("integers", ls.Target(), 2000)
    link.run(until=9000)
    link.focus(NEAR)
    link.run()
    whole = ls.decode(container("integers")).points
    known = [view for view in link.views if not math.isnan(view.rms)]
    assert len(known) > 2
    assert len(known) < len(link.views)
    for view in known:
        error = view.points.astype(float) - whole
        assert math.isclose(view.rms, np.sqrt(np.mean(error**2)), rel_tol=1e-6, abs_tol=1e-12)
        assert view.max_error == np.abs(error).max()


@pytest.mark.parametrize("kind", KINDS)
def test_layers_that_come_whole_after_all_are_shown_once(kind: str) -> None:
    data, table = container(kind), index(kind).index
    decoder = ls.Decoder()
    expected = decoder.feed(data)
    decoder = ls.Decoder()
    decoder.focus(None)
    for start in range(0, index(kind).surface_end, 3000):
        if start == 9000:
            decoder.feed_at(table.offset, data[table.offset : table.end])
        decoder.feed_at(start, data[start : min(start + 3000, index(kind).surface_end)])
    assert figures(decoder.layers) == figures(expected)


def figures(views: Sequence[View]) -> list[tuple[float, ...]]:
    return [(view.number, view.level, view.bytes, view.rms, view.max_error) for view in views]


def test_a_window_of_a_view_is_what_a_receiver_of_that_region_sees() -> None:
    target = ls.Target(region=FAR)
    decoder = ls.Decoder(Selection(FAR))
    for place in plan(index("holes"), target).slices:
        decoder.feed_at(place.offset, container("holes")[place.offset : place.end])
    whole = ls.Decoder()
    whole.feed(container("holes"))
    window = whole.view().window(FAR)
    assert np.array_equal(window.points, decoder.surface().points)
    inner = (FAR[0], (500, 520))
    assert np.array_equal(decoder.view().window(inner).points, window.points[:, 50:70])
    with pytest.raises(OptionError, match="inside the one received"):
        decoder.view().window(NEAR)
    with pytest.raises(OptionError, match="expected rows within"):
        whole.view().window(((0, 500), (0, 10)))


@pytest.mark.parametrize("target", TARGETS, ids=repr)
def test_what_the_server_says_of_layers_is_what_the_client_sees(target: ls.Target) -> None:
    link = Link("floats", target, 2000)
    link.decodes = False
    link.run(until=20_000)
    link.focus(FAR)
    link.run(until=60_000)
    link.focus(None)
    link.run()
    told = [(layer.level, layer.bytes, layer.rms, layer.max) for layer in link.layers]
    seen = [(view.level, view.bytes, view.rms, view.max_error) for view in link.views]
    certain = [figures for figures in told if not math.isnan(figures[2])]
    assert certain
    assert set(certain) <= set(seen)
    assert [layer.bytes for layer in link.layers] == sorted(layer.bytes for layer in link.layers)


def test_a_view_does_not_look_again_for_the_tiles_of_the_region(monkeypatch: pytest.MonkeyPatch) -> None:
    looked = []

    def counted(selection: Selection, header: Header) -> NDArray[np.bool_]:
        looked.append(selection)
        return tiles(selection, header)

    tiles = Selection.tiles
    link = Link("integers", ls.Target(), 2000)
    link.focus(NEAR)
    link.run(until=60_000)
    monkeypatch.setattr(Selection, "tiles", counted)
    views = len(link.views)
    link.run()
    assert len(link.views) > views + 3
    assert not looked


def steps_of(work: Callable[[], object]) -> int:
    """How many functions are called and generators resumed, in Python and in C: work, whatever the machine does."""
    count = 0

    def step(frame: FrameType, event: str, argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    sys.setprofile(step)
    try:
        work()
    finally:
        sys.setprofile(None)
    return count


def crumbs(kind: str, count: int) -> tuple[tuple[int, int], ...]:
    """So many ranges all over a container."""
    stride = len(container(kind)) // count
    return tuple((number * stride, max(stride // 2, 1)) for number in range(count))


@pytest.mark.parametrize("target", TARGETS)
def test_the_work_of_a_plan_grows_as_what_it_is_made_of(target: ls.Target) -> None:
    found = index("floats")
    sha256 = hashlib.sha256(container("floats")).hexdigest()
    for count in (MAX_HELD // 8, MAX_HELD):
        server = Sender(found, sha256)
        server.receive(serialize(Open(target, held=crumbs("floats", count), container=sha256)))
        near = replace(target, first=NEAR)
        while server.next_message() is not None:
            pass
        opening = steps_of(lambda server=server: plan(found, target, server.cached))  # type: ignore[misc]
        turning = steps_of(lambda server=server, near=near: plan(found, near, server.cached))  # type: ignore[misc]
        assert opening < 14 * plan_cost(found, target, count)
        assert turning < 29 * plan_cost(found, near, count)


def test_a_slice_that_was_read_before_the_change_is_not_sent() -> None:
    link = Link("integers", ls.Target(), MAX_DATA)
    link.hear()
    while (wanted := link.server.wanted()) is None or link.server.layers < 3:
        link.serve()
    link.focus(FAR)
    link.hear()
    assert link.server.wanted() is None
    link.server.provide(wanted, container("integers")[wanted.offset : wanted.end])
    link.run()
    check_end(link.reception, "integers", ls.Target())


@pytest.mark.parametrize("region", [((0, 401), (0, 5)), ((0, 5), (530, 531))])
def test_a_region_outside_is_refused_on_either_side(region: Region) -> None:
    link = Link("integers", ls.Target(), 2000)
    link.run(until=5000)
    with pytest.raises(OptionError, match=r"expected (rows|columns) within"):
        link.client.focus(region)
    with pytest.raises(MessageError, match=r"expected (rows|columns) within") as refused:
        Sender(index("integers"), "ab" * 32).receive(serialize(Open(ls.Target(first=region))))
    assert refused.value.code == "bad-target"
    link.run()
    check_end(link.reception, "integers", ls.Target())


@pytest.mark.parametrize("region", [((5, 5), (0, 5)), ((0, 5), (7, 6)), ((-1, 5), (0, 5))])
def test_a_region_without_a_point_is_refused_before_anything_is_known(region: Region) -> None:
    with pytest.raises(OptionError, match="at least one row and column"):
        ReceiverState().focus(region)
    with pytest.raises(OptionError, match="at least one row and column"):
        ls.Target(first=region)


@pytest.mark.sweep(6)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("target", TARGETS, ids=repr)
def test_a_region_that_comes_first_from_the_beginning(kind: str, target: ls.Target) -> None:
    link = Link(kind, replace(target, first=NEAR), 3000)
    link.run()
    check_end(link.reception, kind, target)


def test_looking_elsewhere_opens_again_on_the_same_connection() -> None:
    link = Link("integers", ls.Target(), 4000)
    link.run(until=20_000)
    for region in (NEAR, FAR, None):
        link.focus(region)
        link.focus(region)  # the same again is nothing new
        said = [parse(message) for message in link.to_server]
        assert (said.count(Stop()), said[-1]) == (1, Stop())
        while link.to_server:
            link.hear()
        while link.serve() or link.to_client:
            while link.to_client:
                link.take()
        opened = parse(link.to_server[-1])
        assert isinstance(opened, Open)
        assert (opened.target.first, opened.held, opened.container) == (region, (), None)
        link.run(until=link.reception.data_bytes + 5000)
    link.run()
    check_end(link.reception, "integers", ls.Target())


def test_what_is_sent_again_and_again_is_remembered_once() -> None:
    data = container("integers")
    name = hashlib.sha256(data).hexdigest()
    server = Sender(index("integers"), name)
    sizes = []
    for _ in range(5):
        server.receive(serialize(Open(ls.Target(order="level"), 20_000, container=name)))
        wanted: ByteRange | None = None
        while server.next_message() is not None or (wanted := server.wanted()) is not None:
            if wanted is not None:
                server.provide(wanted, data[wanted.offset : wanted.end])
                wanted = None
        server.receive(serialize(Stop()))
        assert parse(server.next_message() or b"") == End("stopped")
        sizes.append(server.cost(serialize(Open(ls.Target(order="level"), container=name))))
    assert server.sent == 5 * 20_000
    assert len(set(sizes)) == 1


def test_a_focus_after_the_end_does_nothing() -> None:
    link = Link("integers", ls.Target(max_bytes=9000), 3000)
    link.run()
    link.focus(NEAR)
    assert not link.to_server
    check_end(link.reception, "integers", ls.Target(max_bytes=9000))


def test_an_index_that_came_in_part_does_not_stand_in_the_way_of_metadata() -> None:
    target = ls.Target(max_bytes=9000)
    first = Link("integers", target, 300)
    first.run(until=3000)
    first.focus(NEAR)
    place = index("integers").index
    while not any(place.offset <= offset < place.end for offset, _ in first.slices):
        first.run(until=first.reception.data_bytes + 1)
    assert not first.reception.cached.covers(place.offset, place.length)
    second = Link("integers", target, MAX_DATA, first.reception)
    second.focus(None)
    second.run()
    check_end(first.reception, "integers", target)
    assert first.reception.decoder.metadata is not None
