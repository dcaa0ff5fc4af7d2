from __future__ import annotations

import itertools
from random import Random

import pytest

from lodestream import OptionError, Target, Tolerance
from lodestream.container import Index
from lodestream.planning.byte_ranges import RangeSet
from lodestream.planning.plan import Plan
from lodestream.planning.planner import plan
from lodestream.target import Order

from ..surfaces import SAMPLES, contained

ORDERS: tuple[Order, ...] = ("quality", "level")


def targets(index: Index) -> list[Target]:
    """All kinds of target, met early, late, and not at all."""
    found = [Target(level=k, order=order) for k in range(index.header.levels + 1) for order in ORDERS]
    wanted = [layer.rms for layer in index.layers] + [0.0, 1e9, index.header.extent / 100]
    for order in ORDERS:
        found.append(Target(order=order))
        for rms in wanted:
            found.append(Target(until_rms=Tolerance(rms), order=order))
            found.append(Target(until_max=Tolerance(rms), order=order))
        found += [Target(until_rms=Tolerance(r, relative=True), order=order) for r in (0.1, 1e-3)]
        first = plan(index, Target(order=order)).marks[0].bytes
        found += [
            Target(max_bytes=n, order=order) for n in (first, first + 1, max(first, index.surface_end - 1), 10**9)
        ]
        found.append(Target(until_rms=Tolerance(wanted[0] / 2), max_bytes=max(first, 400), order=order))
    return found


def assert_sound(made: Plan, index: Index) -> None:
    assert sum(place.length for place in made.ranges) == made.bytes == made.marks[-1].sent
    assert all(place.length > 0 for place in made.ranges)
    sent = [mark.sent for mark in made.marks]
    assert sent == sorted(sent)
    assert [mark.bytes for mark in made.marks] == sent
    held = sorted((place.offset, place.end) for place in made.ranges)
    assert all(a[1] <= b[0] for a, b in itertools.pairwise(held))
    assert held[0][0] == 0
    assert held[-1][1] <= index.surface_end
    assert made.after == (index.metadata,)
    assert made.before in ((), (index.index,))


@pytest.mark.parametrize("name", SAMPLES)
def test_every_plan_is_made_of_slices_that_sum_to_what_it_says(name: str) -> None:
    _, index = contained(name)
    for target in targets(index):
        assert_sound(plan(index, target), index)


@pytest.mark.parametrize("name", SAMPLES)
def test_a_level_takes_the_bytes_that_the_index_says(name: str) -> None:
    _, index = contained(name)
    for record in index.levels:
        made = plan(index, Target(level=record.level))
        assert sum(place.length for place in made.ranges) == record.bytes
        assert (made.rms, made.max_error) == (record.rms, record.max_error)
        by_level = plan(index, Target(level=record.level, order="level"))
        assert (by_level.rms, by_level.max_error, by_level.ended) == (made.rms, made.max_error, made.ended)
        finest = record.level == index.header.levels
        assert made.ended == ("complete" if finest else "level")
        # The tables of the layers travel only where whole layers do.
        assert by_level.bytes <= record.bytes if finest else by_level.bytes == record.bytes
    sizes = [record.bytes for record in index.levels]
    assert sizes == sorted(sizes)
    assert sizes[-1] == index.surface_end


@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.parametrize("order", ORDERS)
def test_the_smaller_the_error_the_more_is_sent(name: str, order: Order) -> None:
    _, index = contained(name)
    whole = plan(index, Target(order=order))
    assert whole.ended == "complete"
    for rms in (True, False):
        sizes = []
        for power in range(0, 60, 3):
            limit = Tolerance(2.0**-power, relative=True)
            made = plan(index, Target(until_rms=limit, order=order) if rms else Target(until_max=limit, order=order))
            error = made.rms if rms else made.max_error
            assert made.ended == "complete" or error <= limit.absolute(index.header.extent)
            sizes.append(made.bytes)
            # The first state that meets the limit, none before it does.
            for mark in made.marks[:-1]:
                assert (mark.rms if rms else mark.max_error) > limit.absolute(index.header.extent)
        assert sizes == sorted(sizes)
        assert sizes[-1] <= whole.bytes


@pytest.mark.parametrize("name", SAMPLES)
def test_so_many_bytes_at_most_and_not_one_layer_fewer(name: str) -> None:
    _, index = contained(name)
    marks = plan(index).marks
    for limit in {mark.bytes + d for mark in marks for d in (-1, 0, 1)}:
        if limit < marks[0].bytes:
            with pytest.raises(OptionError, match=f"at least the {marks[0].bytes} bytes"):
                plan(index, Target(max_bytes=limit))
            continue
        made = plan(index, Target(max_bytes=limit))
        assert made.bytes == max(mark.bytes for mark in marks if mark.bytes <= limit)
        assert made.ended == ("complete" if limit >= marks[-1].bytes else "bytes")


def test_of_several_limits_the_first_one_met_ends_it() -> None:
    _, index = contained("heights")
    third, later = index.layers[2], index.layers[5]
    soon = plan(index, Target(until_rms=Tolerance(third.rms), max_bytes=later.end))
    assert (soon.ended, soon.bytes) == ("rms", third.end)
    soon = plan(index, Target(until_rms=Tolerance(later.rms), max_bytes=third.end))
    assert (soon.ended, soon.bytes) == ("bytes", third.end)
    assert plan(index, Target(until_max=Tolerance(1e9))).ended == "max"


def test_levels_that_do_not_exist_are_refused_by_name() -> None:
    _, index = contained("heights")
    finest = index.header.levels
    for order in ORDERS:
        with pytest.raises(OptionError, match=f"0 to {finest}, got {finest + 1}"):
            plan(index, Target(level=finest + 1, order=order))


@pytest.mark.parametrize("name", ["heights", "attributes", "noise", "pair"])
def test_what_is_held_is_not_sent_again(name: str) -> None:
    _, index = contained(name)
    random = Random(7)
    for target in targets(index):
        whole = plan(index, target)
        for _ in range(3):
            held = RangeSet(
                (random.randrange(index.size), random.randrange(1, index.size)) for _ in range(random.randrange(4))
            )
            left = plan(index, target, held)
            assert (left.bytes, left.ended, left.prefix) == (whole.bytes, whole.ended, whole.prefix)
            assert len(left.marks) == len(whole.marks)
            asked = [byte for place in whole.slices for byte in range(place.offset, place.end)]
            missing = [byte for byte in asked if not held.covers(byte, 1)]
            assert [byte for place in left.slices for byte in range(place.offset, place.end)] == missing
            surface = [byte for place in whole.ranges for byte in range(place.offset, place.end)]
            for before, after in zip(whole.marks, left.marks, strict=True):
                assert after.sent == sum(not held.covers(byte, 1) for byte in surface[: before.sent])
                assert after.bytes == before.bytes


def test_what_is_held_whole_leaves_nothing() -> None:
    _, index = contained("heights")
    left = plan(index, Target(), RangeSet([(0, index.size)]))
    assert left.slices == ()
    assert {mark.sent for mark in left.marks} == {0}
    assert plan(index, Target(), RangeSet()) == plan(index)
