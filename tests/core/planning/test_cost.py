"""What a plan costs is told before it is made, whatever it walks, and is bounded."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream import OptionError, Target
from lodestream.container import ByteRange, Index
from lodestream.container.chunks import chunk_places, chunks_touched
from lodestream.container.model import AttributeKind, Chunk
from lodestream.planning import cost
from lodestream.planning import selection as selecting
from lodestream.planning.cost import plan_cost
from lodestream.planning.planner import plan
from lodestream.planning.selection import Selection, select
from lodestream.protocol.messages import MessageError, Open, Stop
from lodestream.protocol.wire import parse, serialize
from lodestream.transfer.sender import Sender

from ..surfaces import SAMPLES, contained
from .test_focus import steps_of
from .test_plan import ORDERS, targets


def every_target(index: Index) -> Iterator[Target]:
    """Targets of all kinds that walk different things."""
    yield from targets(index)
    header = index.header
    names = tuple(kind.name for kind in header.attributes)
    limits = dict.fromkeys(header.channel_names, 1e-09)
    for order in ORDERS:
        yield Target(attributes=(), order=order)
        yield Target(attributes=names, order=order)
        yield Target(until_rms=limits, until_max=limits, order=order)
        if len(header.blocks) == 1:
            near = ((0, min(header.shape[0], 4)), (0, min(header.shape[1], 5)))
            yield Target(region=near, order=order)
            yield Target(region=near, first=near, order=order)
            strip = ((0, header.shape[0]), near[1])  # it has two points of every level
            yield from (Target(region=strip, level=level, order=order) for level in range(header.levels + 1))
            yield Target(first=near, order=order)


@pytest.mark.parametrize("name", SAMPLES)
def test_no_plan_takes_more_than_is_told(name: str) -> None:
    _, index = contained(name)
    # Which tiles a region needs is found level by level, by some calls of numpy for each.
    fixed = 300 + 400 * (index.header.levels + 1)
    for target in every_target(index):
        told = plan_cost(index, target, 0)
        assert steps_of(lambda target=target: plan(index, target)) < 30 * told + fixed  # type: ignore[misc]


def crowded(count: int) -> Index:
    """An index of a surface with a residual of one chunk for each of its points, which are about so many."""
    _, index = contained("heights")
    header = index.header
    rows = count // header.shape[1]
    blocks = (((rows, header.shape[1]), header.blocks[0][1]),)
    header = replace(header, blocks=blocks, chunk=(0, 0), corrected=True)
    places = sum(1 for _ in chunk_places(header))
    chunks = tuple(Chunk(ByteRange(10_000 + number, 1), 0) for number in range(places))
    return replace(index, header=header, segments=(), chunks=chunks, residual=ByteRange(10_000, places))


def test_chunks_of_the_residual_are_chosen_together_and_counted() -> None:
    index = crowded(65_536)
    assert len(index.chunks) > 60_000
    near = ((1, 4), (2, 5))
    assert steps_of(lambda: select(index, Selection(near))) < 2000
    assert plan_cost(index, Target(region=near), 0) > 60_000
    assert len(select(index, Selection(near)).chunks) == 9 * index.header.channels


@pytest.mark.parametrize("name", SAMPLES)
@given(data=st.data())
def test_chunks_that_are_touched_are_those_of_the_places(name: str, data: st.DataObject) -> None:
    header = contained(name)[1].header
    header = replace(header, chunk=(data.draw(st.integers(0, 6)), data.draw(st.integers(0, 6))))
    region = None
    if len(header.blocks) == 1:
        spans = []
        for length in header.shape:
            start = data.draw(st.integers(0, length - 1))
            spans.append((start, data.draw(st.integers(start + 1, length))))
        region = data.draw(st.sampled_from([None, (spans[0], spans[1])]))
    channels = np.array(data.draw(st.lists(st.booleans(), min_size=header.channels, max_size=header.channels)))
    wanted = [
        bool(channels[place.channel])
        and (
            region is None
            or all(
                start < b and a < stop
                for (start, stop), (a, b) in zip(region, (place.rows, place.columns), strict=True)
            )
        )
        for place in chunk_places(header)
    ]
    assert chunks_touched(header, region, channels).tolist() == wanted


class Compared(str):
    """A name that counts how often it is compared."""

    times: ClassVar[int] = 0

    def __eq__(self, other: object) -> bool:
        Compared.times += 1
        return str(self) == str(other)

    def __hash__(self) -> int:
        return hash(str(self))


def test_names_of_attributes_are_looked_up() -> None:
    _, index = contained("heights")
    count = 2000
    kinds = tuple(AttributeKind(Compared(f"a{number}"), np.dtype(np.float32), 0) for number in range(count))
    header = replace(index.header, attributes=kinds)
    selection = Selection(attributes=tuple(Compared(f"a{number}") for number in reversed(range(count))))
    Compared.times = 0
    selection.check(header)
    selection.channels(header)
    assert Compared.times < 10 * count


@pytest.mark.parametrize("part", ["channels", "ranges", "chunks", "names"])
def test_each_thing_that_is_walked_counts(part: str) -> None:
    _, index = contained("attributes")
    names = tuple(f"a{number}" for number in range(50))
    kinds = tuple(AttributeKind(name, np.dtype(np.float32), 0) for name in names)
    index = replace(index, header=replace(index.header, attributes=kinds))
    limits = dict.fromkeys(("x", "y", "z", "attribute_0", "attribute_1"), 0.0)
    target = {
        "channels": Target(until_rms=limits),
        "names": Target(attributes=names),
    }.get(part, Target(attributes=()))
    base = plan_cost(index, Target(attributes=()) if part == "names" else target, 0)
    more: dict[str, Any] = {
        "channels": lambda: plan_cost(replace(index, layers=index.layers * 3), target, 0),
        "ranges": lambda: plan_cost(index, target, 500),
        "chunks": lambda: plan_cost(replace(index, chunks=(Chunk(ByteRange(0, 1), 0),) * 5000), target, 0),
        "names": lambda: plan_cost(index, target, 0),
    }
    least = {
        "channels": base + 2 * len(index.layers) * (1 + len(limits)),
        "ranges": base + 500,
        "chunks": base + 5000 - len(index.chunks),
        "names": base + len(names),
    }
    assert more[part]() >= least[part]


def test_a_plan_that_would_cost_more_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    _, index = contained("heights")
    sender = Sender(index, "0" * 64)
    message = serialize(Open(Target(order="level")))
    monkeypatch.setattr(cost, "MOST_STEPS", sender.cost(message))
    sender.receive(message)
    most = Sender(index, "0" * 64).cost(message) - 1
    monkeypatch.setattr(cost, "MOST_STEPS", most)
    with pytest.raises(MessageError, match=f"at most {most:,} steps") as refusal:
        Sender(index, "0" * 64).receive(message)
    assert refusal.value.code == "bad-target"
    # What is a prefix of the file is planned whatever its segments are.
    Sender(index, "0" * 64).receive(serialize(Open()))


def test_the_bound_is_above_what_encoders_make() -> None:
    # Tiles of 64 x 64 coefficients of 2^28 points, with a segment in each of a dozen layers, and their chunks.
    tiles = (1 << 28) // 4096 * 4 // 3
    assert 3 * tiles * 12 + 3 * tiles < cost.MOST_STEPS


def test_names_are_not_repeated() -> None:
    for names in (("a", "a"), ("a", "b", "a"), ("",) * 3):
        with pytest.raises(OptionError, match="expected each attribute once"):
            Target(attributes=names)
        message = serialize(Open(Target(attributes=("x", "y"))))
        repeated = message.replace(b"attributes\x92\xa1x\xa1y", b"attributes\x92\xa1x\xa1x")
        assert repeated != message
        with pytest.raises(MessageError) as refusal:
            parse(repeated)
        assert refusal.value.code == "bad-target"
    assert Target(attributes=("a", "b")).attributes == ("a", "b")


def test_a_message_that_makes_no_plan_costs_nothing() -> None:
    _, index = contained("heights")
    sender = Sender(index, "0" * 64)
    assert sender.cost(serialize(Open())) > 0
    sender.receive(serialize(Open()))
    assert sender.cost(serialize(Stop())) == 0


def test_the_window_of_a_level_of_a_long_axis_is_placed_once_without_sorting(monkeypatch: pytest.MonkeyPatch) -> None:
    _, index = contained("heights")
    header = replace(index.header, blocks=(((1 << 20, 4), (False, False)),), corrected=False)
    index = replace(index, header=header, segments=(), chunks=())
    target = Target(region=((1000, 5000), (0, 4)), level=header.levels - 1)
    calls: list[str] = []

    def counted(owner: Any, name: str) -> None:
        original = getattr(owner, name)

        def called(*args: Any, **options: Any) -> Any:
            calls.append(name)
            return original(*args, **options)

        monkeypatch.setattr(owner, name, called)

    for name in ("unique", "sort", "argsort"):
        counted(np, name)
    counted(selecting, "level_positions")
    select(index, selecting.selection_of(target))
    assert calls == ["level_positions"]
    least = plan_cost(index, target, 0) - plan_cost(index, replace(target, level=None), 0)
    assert least > 2 * sum(header.shape) // 64, "all of the axis is listed, of the patch and of the block"
