"""Groups of points by number, what turns some into others, and how that stands in a header."""

from __future__ import annotations

from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import lodestream as ls
from lodestream.container.shape import parse_extras
from lodestream.errors import CorruptStreamError
from lodestream.joints import Change, Groups, Joints, check_runs, find_change
from lodestream.mesh import weld

POINTS = 30
PAIRS = st.lists(st.tuples(st.integers(0, POINTS - 1), st.integers(0, POINTS - 1)), max_size=40)
ALL = np.arange(POINTS)


def groups_of(pairs: list[tuple[int, int]]) -> Groups:
    return Groups.of(np.array(pairs, np.int64).reshape(-1, 2))


@given(PAIRS)
def test_groups_are_what_hangs_together(pairs: list[tuple[int, int]]) -> None:
    one, other = np.array(pairs, np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(pairs)), (one, other)), shape=(POINTS, POINTS))
    labels = connected_components(graph, directed=False)[1]
    expected = [int(np.flatnonzero(labels == label)[0]) for label in labels]
    groups = groups_of(pairs)
    assert groups.first(ALL).tolist() == expected
    several = np.bincount(labels)[labels] > 1
    assert groups.points.tolist() == np.flatnonzero(several).tolist()


@given(PAIRS, st.lists(st.integers(0, 5), min_size=POINTS, max_size=POINTS), st.sets(st.integers(0, POINTS - 1)))
def test_a_change_makes_of_groups_what_is_wanted(
    pairs: list[tuple[int, int]], wanted: list[int], counted: set[int]
) -> None:
    groups, numbers = groups_of(pairs), np.array(sorted(counted), np.int64)
    labels = np.array(wanted)[numbers]
    change = find_change(numbers, groups, labels)
    again = Change.of(change.runs)
    for found, kept in zip(again, change, strict=True):
        np.testing.assert_array_equal(found, kept)
    first = groups.changed(again).first(numbers)
    assert np.array_equal(first[:, None] == first, labels[:, None] == labels)
    for points, width in ((change.runs[0], 1), (change.runs[1], 2)):
        assert check_runs(list(points), width, POINTS) == points


def test_nothing_is_changed_where_groups_are_as_wanted() -> None:
    groups = groups_of([(3, 7), (7, 9)])
    change = find_change(ALL, groups, groups.first(ALL))
    assert [array.size for array in change] == [0, 0]
    assert groups.changed(change) is groups
    assert Groups.none().first(ALL) is ALL


def test_long_contacts_are_short_runs() -> None:
    pairs = np.stack([np.arange(100, 200, 2), np.arange(99, 49, -1)], axis=-1)
    assert Change(np.arange(5, 25, 5), pairs).runs == ((5, 5, 4), (100, 99, 2, -1, 50))


def test_numbers_are_those_of_the_whole_surface_at_levels_and_in_windows() -> None:
    joints = Joints(((3, 4), (5, 6)), Groups.none(), Groups.none())
    assert joints.number(1, np.array([2]), np.array([3])).tolist() == [12 + 2 * 6 + 3]
    coarse = joints.at([(np.array([0, 2]), np.array([0, 3])), (np.array([0, 2, 4]), np.array([1, 5]))])
    assert coarse.number(1, np.array([1]), np.array([1])).tolist() == [12 + 2 * 6 + 5]
    again = coarse.at([(np.array([0]), np.array([0])), (np.array([2, 0]), np.array([1]))])
    assert again.number(1, np.array([0, 1]), np.array([0, 0])).tolist() == [12 + 4 * 6 + 5, 12 + 5]


HOSTILE: list[Any] = [
    7,
    [[[], []]],
    [[[], []], [[], []], [[], []]],
    [[[0, 1], []], [[], []]],
    [[[0, 1, 0], []], [[], []]],
    [[[0, 1, 13], []], [[], []]],
    [[[11, -1, 13], []], [[], []]],
    [[[0, 0, 9, 0, 0, 9], []], [[], []]],
    [[[0.0, 1, 1], []], [[], []]],
    [[[True, 1, 1], []], [[], []]],
    [[[], [0, 12, 1, 1, 1]], [[], []]],
    [[[], [0, 5, 1, 2**62, 2]], [[], []]],
    [[[], [-1, 5, 1, 1, 2]], [[], []]],
    [[[2, 1, 2**63], []], [[], []]],
]


@pytest.mark.parametrize("joints", HOSTILE)
def test_joints_that_no_writer_makes_are_refused(joints: Any) -> None:
    with pytest.raises(CorruptStreamError, match=r"^expected .* and joints in MessagePack, .*at byte 5"):
        parse_extras(memoryview(msgpack.packb({"joints": joints})), 5, 12)


def test_joints_stand_in_the_header_only_where_the_arrangement_does_not_say_them() -> None:
    grid = np.random.default_rng(0).random((9, 9, 3))
    shared = ls.Surface(blocks=[ls.Block(grid[:, :5]), ls.Block(grid[:, 4:])])
    corner = ls.Surface(blocks=[ls.Block(grid[:5, :5]), ls.Block(grid[4:, 4:])])
    changes = []
    for surface in (shared, corner):
        decoder = ls.Decoder()
        decoder.feed(ls.encode(surface))
        assert decoder.header is not None
        changes.append(decoder.header.joint_changes)
        assert len(weld(decoder.surface()).source) == len(weld(surface).source)
    assert changes == [None, (((), (25, 24, 0, 0, 1)), ((), ()))]


def test_metadata_that_make_no_mesh_do_not_keep_a_surface_from_being_encoded() -> None:
    points = np.random.default_rng(0).random((5, 5, 3))
    surface = ls.Surface(points, metadata={"faces": 7, "poles": "none"})
    assert ls.decode(ls.encode(surface)).metadata == surface.metadata
