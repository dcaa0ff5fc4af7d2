from __future__ import annotations

import numpy as np
import pytest

from lodestream.grid.connectivity import Arrangement, LatticeBlock, Patch, arrange

from .arrangements import Ints, checked
from .layouts import GLUES, glued, random_points


def surface(shape: tuple[int, int], kind: str = "sheet") -> Ints:
    """Points of so many faces in the two directions, joined as the kind says."""
    numbers = glued(*shape, GLUES[kind])
    return random_points(np.random.default_rng(0), int(numbers.max()) + 1)[numbers]


def opened(*grids: Ints) -> list[LatticeBlock]:
    return [LatticeBlock(grid, (False, False)) for grid in grids]


def shared(patch: Patch) -> list[int | None]:
    return [None if side is None else side.interface for side in patch.sides]


def test_blocks_side_by_side_share_one_interface_and_are_clamped_all_round() -> None:
    whole = surface((6, 8))
    arrangement = checked(opened(whole[:, :5], whole[:, 4:]))
    assert [shared(patch) for patch in arrangement.patches] == [[None, None, None, 0], [None, None, 0, None]]
    assert all(patch.clamped == (True, True, True, True) for patch in arrangement.patches)
    assert [interface.length for interface in arrangement.interfaces] == [7]


def test_axes_are_turned_round_where_a_gap_has_a_side() -> None:
    """Lengths 6 and 7 meet an even length, 5 and 9 do not."""
    for faces in (4, 5, 6, 8):
        whole = surface((faces, 4))
        one, other = whole[:, :3], whole[::-1, 2:]
        for grids in ((one, other), (one, other.transpose(1, 0, 2))):
            arrangement = checked(opened(*grids))
            matters = faces in (5, 6)
            axis = int(grids[1].shape[1] == faces + 1)
            assert arrangement.patches[1].flipped[axis] == matters
            assert [side.reversed for patch in arrangement.patches for side in patch.sides if side] == [
                False,
                not matters,
            ]


def test_a_side_is_split_where_its_neighbours_end_and_so_is_what_lies_opposite() -> None:
    whole = surface((6, 9))
    bricks = [whole[:3, :5], whole[:3, 4:], whole[2:5, :4], whole[2:5, 3:7], whole[2:5, 6:], whole[4:]]
    arrangement = checked(opened(*bricks))
    columns = [patch.columns for patch in arrangement.patches]
    assert columns == [
        *[(0, 4), (3, 5), (0, 3), (2, 6)],
        *[(0, 4), (0, 2), (1, 4), (0, 4)],
        *[(0, 4), (3, 5), (4, 7), (6, 10)],
    ]
    assert all(patch.rows in ((0, 3), (0, 2)) for patch in arrangement.patches)


def test_any_number_of_blocks_may_meet_along_a_interface() -> None:
    whole, fin = surface((6, 8)), surface((6, 3)) + 2**21
    fin[:, 0] = whole[:, 4]
    arrangement = checked(opened(whole[:, :5], whole[:, 4:], fin))
    assert [shared(patch) for patch in arrangement.patches] == [
        [None, None, None, 0],
        [None, None, 0, None],
        [None, None, 0, None],
    ]


def test_a_block_that_comes_back_to_itself_shares_a_side_with_itself() -> None:
    arrangement = checked(opened(surface((5, 8), "cylinder")))
    assert shared(arrangement.patches[0]) == [None, None, 0, 0]
    assert not arrangement.interfaces[0].stops


def test_a_c_grid_is_split_where_the_wake_begins() -> None:
    whole = surface((4, 20))
    whole[0, 15:] = whole[0, 5::-1]
    arrangement = checked(opened(whole))
    assert [patch.columns for patch in arrangement.patches] == [(0, 6), (5, 16), (15, 21)]
    first, middle, last = (shared(patch) for patch in arrangement.patches)
    assert first[0] == last[0] is not None
    assert middle[0] is None


@pytest.mark.parametrize("double", [False, True])
def test_a_side_that_is_folded_is_split_at_the_fold(double: bool) -> None:
    whole = surface((4, 8 + double))
    whole[0, 5 + double :] = whole[0, 3::-1]
    if double:
        whole[0, 4] = whole[0, 5]
    arrangement = checked(opened(whole))
    assert [patch.columns for patch in arrangement.patches] == (
        [(0, 5), (4, 6), (5, 10)] if double else [(0, 5), (4, 9)]
    )


def test_where_no_direction_is_consistent_axes_stop_at_an_even_length() -> None:
    for faces, stops in ((4, False), (5, True), (6, True), (8, False)):
        strip = surface((7, faces), "moebius")
        for blocks in (opened(strip), opened(strip[:4], strip[3:])):
            arrangement = checked(blocks)
            assert all(patch.stops == (False, stops) for patch in arrangement.patches)
            assert all(
                interface.stops == stops for interface in arrangement.interfaces if interface.length == faces + 1
            )
            assert any(side.reversed for patch in arrangement.patches for side in patch.sides if side)


def test_a_shared_rim_is_a_closed_interface_begun_at_one_point_and_run_one_way() -> None:
    whole = surface((6, 10), "cylinder")[:, :-1]
    upper = LatticeBlock(whole[:4], (False, True))
    for lower in (whole[3:], np.roll(whole[3:], 3, axis=1), np.roll(whole[3:, ::-1], 4, axis=1)):
        arrangement = checked([upper, LatticeBlock(lower, (False, True))])
        assert [patch.closed for patch in arrangement.patches] == [(False, True)] * 2
        assert [shared(patch) for patch in arrangement.patches] == [[None, 0, None, None], [0, None, None, None]]
        assert [patch.clamped for patch in arrangement.patches] == [(True, True, False, False)] * 2
        assert arrangement.interfaces[0].closed
        assert not any(side.reversed for patch in arrangement.patches for side in patch.sides if side)


def test_a_rim_shared_with_open_sides_is_cut_where_they_end() -> None:
    whole = surface((6, 10), "cylinder")
    ring = LatticeBlock(np.roll(whole[:4, :-1], 3, axis=1), (False, True))
    arrangement = checked([ring, *opened(whole[3:])])
    assert [patch.columns for patch in arrangement.patches] == [(3, 14), (0, 11)]
    assert arrangement.patches[0].sides[2] == arrangement.patches[0].sides[3] is not None
    arrangement = checked([ring, *opened(whole[3:, :4], whole[3:, 3:])])
    assert [patch.columns for patch in arrangement.patches] == [(3, 7), (6, 14), (0, 4), (0, 8)]


def test_a_tube_that_ends_in_its_own_beginning_turned_over_is_cut_where_the_turn_leaves_a_point() -> None:
    whole = surface((6, 10), "cylinder")[:, :-1]
    whole[-1] = np.roll(whole[0, ::-1], 3, axis=0)
    arrangement = checked([LatticeBlock(whole, (False, True))])
    assert [patch.columns for patch in arrangement.patches] == [(1, 12)]
    assert [patch.stops for patch in arrangement.patches] == [(False, True)]


def test_a_tube_twisted_by_one_sample_is_not_cut_to_ribbons() -> None:
    whole = surface((6, 200), "cylinder")[:, :-1]
    whole[-1] = np.roll(whole[0], 1, axis=0)
    arrangement = checked([LatticeBlock(whole, (False, True))], complete=False)
    assert len(arrangement.patches) == 1
    assert not arrangement.interfaces
    assert len(checked([LatticeBlock(whole, (False, True))]).patches) == 200


def test_what_is_given_up_for_being_too_much_does_not_touch_the_rest() -> None:
    tube = surface((6, 600), "cylinder")[:, :-1] + 2**22
    tube[-1] = np.roll(tube[0], 1, axis=0)
    whole = surface((6, 10))
    bricks = opened(whole[:3, :9], whole[2:5], whole[4:, 5:])
    alone = checked(bricks)
    assert [patch.columns for patch in alone.patches if patch.block == 2] == [(0, 4), (3, 6)]
    both = checked([*bricks, LatticeBlock(tube, (False, True))], complete=False)
    assert both.patches[:-1] == alone.patches
    assert both.interfaces == alone.interfaces


def test_neighbours_fit_at_every_level_across_a_cut_that_is_a_single_point() -> None:
    """The left patch has no direction for what its other neighbour does to it, so the right patch has none either."""
    strip, above, block = (
        surface((5, 7), "moebius").transpose(1, 0, 2),
        surface((3, 4)) + 2**22,
        surface((7, 8)) + 2**24,
    )
    block[:, 4] = block[0, 4]
    above[-1] = block[0, :5]
    block[1:, 0] = strip[1:, 0]
    strip[0, 0] = strip[-1, -1] = above[-1, 0] = block[0, 0]
    arrangement = checked(opened(block, above, strip))
    left, right = (patch for patch in arrangement.patches if patch.block == 0)
    assert (left.columns, right.columns) == ((0, 5), (4, 9))
    assert left.sides[3] is right.sides[2] is None
    assert left.stops[0]
    assert right.stops[0]


def test_poles_are_clamped_and_are_no_interfaces() -> None:
    whole = surface((6, 8), "cylinder")[:, :-1]
    whole[0], whole[-1] = whole[0, 0], whole[-1, 0]
    (patch,) = checked([LatticeBlock(whole, (False, True))]).patches
    assert (patch.closed, patch.sides, patch.clamped) == ((False, True), (None,) * 4, (True, True, False, False))
    whole[-1] = surface((6, 8))[-1, :-1]
    (patch,) = checked([LatticeBlock(whole, (False, True))]).patches
    assert patch.clamped == (True, False, False, False)


def test_edges_without_length_are_passed_over() -> None:
    whole = surface((6, 8))
    whole[2:4, 4] = whole[1, 4]
    arrangement = checked(opened(whole[:, :5], whole[:, 4:]))
    assert len(arrangement.patches) == 2
    assert len(arrangement.interfaces) == 1


def test_points_that_only_one_block_holds_valid_end_a_contact() -> None:
    whole = surface((6, 8))
    left, right = np.ones((7, 5), bool), np.ones((7, 5), bool)
    left[3, 4] = right[3, 0] = False
    both = [LatticeBlock(whole[:, :5], (False, False), left), LatticeBlock(whole[:, 4:], (False, False), right)]
    assert len(checked(both).patches) == 2
    arrangement = checked([both[0], LatticeBlock(whole[:, 4:], (False, False))])
    assert [patch.rows for patch in arrangement.patches] == [(0, 3), (2, 5), (4, 7)] * 2
    assert [interface.length for interface in arrangement.interfaces if interface.length == 3] == [3, 3]


def test_single_points_interfaces_and_heights_are_not_shared() -> None:
    whole = surface((6, 8))
    apart = arrange(opened(whole[:4, :5], whole[3:, 4:]), 3)
    assert not apart.interfaces
    thin = arrange(opened(whole[:, :1], whole[:, :1], whole[:1, :1]), 3)
    assert not thin.interfaces
    assert [patch.clamped for patch in apart.patches + thin.patches] == [(False,) * 4] * 5
    heights = arrange(opened(whole[:, :5, :1], whole[:, 4:, :1]), 1)
    assert not heights.interfaces
    assert arrange([], 3) == Arrangement((), ())


def test_channels_that_are_not_geometric_do_not_tell_points_apart() -> None:
    whole = surface((6, 8))
    one, other = whole[:, :5], whole[:, 4:].copy()
    other[..., 2] += 1
    assert not arrange(opened(one, other), 3).interfaces
    assert len(arrange(opened(one, other), 2).interfaces) == 1
