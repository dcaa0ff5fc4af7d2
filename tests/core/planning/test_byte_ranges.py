from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from lodestream.planning.byte_ranges import RangeSet

places = st.tuples(st.integers(0, 60), st.integers(0, 12))


def as_set(ranges: RangeSet) -> set[int]:
    return {byte for offset, length in ranges for byte in range(offset, offset + length)}


@given(st.lists(places), places)
def test_it_is_a_set_of_bytes(added: list[tuple[int, int]], asked: tuple[int, int]) -> None:
    ranges, expected = RangeSet(), set[int]()
    for offset, length in added:
        ranges.add(offset, length)
        expected |= set(range(offset, offset + length))
    assert as_set(ranges) == expected
    assert ranges.total == len(expected)
    assert ranges.end == max(expected, default=-1) + 1
    assert ranges == RangeSet(added) == ranges.copy()
    listed = list(ranges)
    assert len(listed) == len(ranges)
    assert all(a[0] + a[1] < b[0] for a, b in pairwise(listed))
    assert all(length > 0 for _, length in listed)
    window = set(range(asked[0], asked[0] + asked[1]))
    assert as_set(RangeSet(ranges.missing(*asked))) == window - expected
    assert as_set(RangeSet(ranges.overlap(*asked))) == window & expected
    assert ranges.covers(*asked) is (window <= expected)
    run = ranges.run(asked[0])
    assert set(range(asked[0], asked[0] + run)) <= expected
    assert asked[0] + run not in expected


def test_a_copy_grows_by_itself() -> None:
    one = RangeSet([(0, 5)])
    other = one.copy()
    other.add(10, 5)
    assert list(one) == [(0, 5)]
    assert one != other
    assert one != "RangeSet([(0, 5)])"
    assert repr(one) == "RangeSet([(0, 5)])"
