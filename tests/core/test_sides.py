from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.axis import axis_lengths, axis_step
from lodestream.lifting import forward_step, inverse_step
from lodestream.sides import Arrangement, LatticeBlock, Part, arrange, assemble, cuts, stored

from .layouts import GLUES, cube, glued, layouts, overlapping, random_points, tubes

DATA = Path(__file__).parents[3] / "shared" / "data"
PREDICTORS = [(0, 0), (16, 0), (32, -7)]

Ints = NDArray[np.int32]


def lines(grid: NDArray[Any]) -> list[NDArray[Any]]:
    """First row, last row, first column, last column."""
    return [grid[0], grid[-1], grid[:, 0], grid[:, -1]]


def checked(blocks: list[LatticeBlock], complete: bool = True) -> Arrangement:
    """The arrangement of blocks in space, when all that must hold of it does; with ``complete``, however many parts."""
    with patch.object(cuts, "PARTS", 10**6 if complete else cuts.PARTS):
        arrangement = arrange(blocks, 3)
    grids = [stored(part, blocks[part.block].coordinates) for part in arrangement.parts]
    masks = [stored(part, _mask(blocks[part.block])) for part in arrangement.parts]
    closed = [block.closed for block in blocks]
    for block, points, mask in zip(
        blocks, assemble(closed, arrangement.parts, grids), assemble(closed, arrangement.parts, masks), strict=True
    ):
        np.testing.assert_array_equal(points, block.coordinates)
        np.testing.assert_array_equal(mask, _mask(block))
    _check_curves(arrangement, grids, masks)
    _check_parts(arrangement, grids, masks)
    if complete:
        _check_that_all_is_shared(blocks, arrangement, grids, masks)
    _check_levels(arrangement, grids, closed)
    return arrangement


def _mask(block: LatticeBlock) -> NDArray[np.bool_]:
    return np.ones(block.coordinates.shape[:2], bool) if block.mask is None else block.mask


def _check_curves(arrangement: Arrangement, grids: list[Ints], masks: list[NDArray[np.bool_]]) -> None:
    """All users of a curve have its points, its length, its closure; there are at least two, or one twice."""
    seen: dict[int, tuple[Ints, Ints]] = {}
    users: dict[int, int] = defaultdict(int)
    for part, grid, mask in zip(arrangement.parts, grids, masks, strict=True):
        for number, side in enumerate(part.sides):
            if side is None:
                continue
            along, curve, turn = 1 - number // 2, arrangement.curves[side.curve], -1 if side.reversed else 1
            points = lines(grid)[number][::turn], lines(mask)[number][::turn]
            for ours, theirs in zip(points, seen.setdefault(side.curve, points), strict=True):
                np.testing.assert_array_equal(ours, theirs)
            assert len(points[0]) == curve.length
            assert (part.closed[along], part.stops[along]) == (curve.closed, curve.stops)
            assert not part.closed[number // 2]
            assert (points[0] != points[0][0]).any()
            if side.reversed:
                assert not curve.closed
                assert curve.stops or all(n % 2 for n in axis_lengths(curve.length, False)[1:])
            users[side.curve] += 1
    assert sorted(users) == list(range(len(arrangement.curves)))
    assert all(count > 1 for count in users.values())


def _check_parts(arrangement: Arrangement, grids: list[Ints], masks: list[NDArray[np.bool_]]) -> None:
    for part, grid, mask in zip(arrangement.parts, grids, masks, strict=True):
        assert grid.shape[:2] == part.shape
        for number in range(4):
            line, valid = lines(grid)[number], lines(mask)[number]
            pole = min(grid.shape[:2]) > 1 and (line == line[0]).all() and valid.all()
            expected = any(part.sides) or pole
            assert part.clamped[number] == (bool(expected) and not part.closed[number // 2])
        for axis in (0, 1):
            assert not (part.stops[axis] and (part.closed[axis] or part.flipped[axis]))


def _check_that_all_is_shared(
    blocks: list[LatticeBlock], arrangement: Arrangement, grids: list[Ints], masks: list[NDArray[np.bool_]]
) -> None:
    """An edge that sides of blocks have in common is one edge of one curve, wherever it lies."""
    places: dict[frozenset[bytes], set[tuple[int, ...]]] = defaultdict(set)
    for n, (part, grid, mask) in enumerate(zip(arrangement.parts, grids, masks, strict=True)):
        if min(grid.shape[:2]) < 2:
            continue
        for number, side in enumerate(part.sides):
            axis, along = number // 2, 1 - number // 2
            if part.closed[axis] or not _is_outside(part, number, blocks[part.block]):
                continue
            line, valid = lines(grid)[number], lines(mask)[number]
            last = len(line) - 1
            for i in range(last + part.closed[along]):
                ends = line[i].tobytes(), line[(i + 1) % len(line)].tobytes()
                if ends[0] == ends[1] or not (valid[i] and valid[(i + 1) % len(line)]):
                    continue
                if side is None:
                    places[frozenset(ends)].add((-1, n, number, i))
                else:
                    places[frozenset(ends)].add((side.curve, last - 1 - i if side.reversed else i))
    assert all(len(found) == 1 for found in places.values())


def _is_outside(part: Part, number: int, block: LatticeBlock) -> bool:
    """Whether a side of a part lies on a side of its block."""
    axis = number // 2
    window = (part.rows, part.columns)[axis]
    is_last = bool(number % 2) != part.flipped[axis]
    length = block.coordinates.shape[axis]
    return not block.closed[axis] and (window[1] == length if is_last else window[0] == 0)


def _check_levels(arrangement: Arrangement, grids: list[Ints], closed: list[tuple[bool, bool]]) -> None:
    """Every part coarsened by itself, and every curve: shared sides stay the same to the bit."""
    work = [np.array(grid, np.int32) for grid in grids]
    curves: dict[int, Ints] = {}
    for part, grid in zip(arrangement.parts, work, strict=True):
        for number, side in enumerate(part.sides):
            if side is not None:
                curves[side.curve] = lines(grid)[number][:: -1 if side.reversed else 1].copy()
    for level in range(40):
        coarser = [_coarsened(part, grid, level) for part, grid in zip(arrangement.parts, work, strict=True)]
        for number, curve in enumerate(arrangement.curves):
            step = axis_step(len(curves[number]), curve.closed, (True, True), curve.stops)
            curves[number] = _stepped(curves[number][:, None], 0, step.coarse, level, curve.closed, curve.stops)[:, 0]
        for part, fine, coarse in zip(arrangement.parts, work, coarser, strict=True):
            for number, side in enumerate(part.sides):
                line = lines(coarse)[number]
                if side is not None:
                    np.testing.assert_array_equal(line[:: -1 if side.reversed else 1], curves[side.curve])
                elif part.clamped[number] and (lines(fine)[number] == lines(fine)[number][0]).all():
                    assert (line == lines(fine)[number][0]).all()
        done = all(a.shape == b.shape for a, b in zip(work, coarser, strict=True))
        work = coarser
        assemble(closed, arrangement.parts, work)
        if done:
            return
    pytest.fail("coarsening does not end")


def _coarsened(part: Part, grid: Ints, level: int) -> Ints:
    for axis in (0, 1):
        ends = part.clamped[2 * axis], part.clamped[2 * axis + 1]
        step = axis_step(grid.shape[axis], part.closed[axis], ends, part.stops[axis])
        grid = _stepped(grid, axis, step.coarse, level, part.closed[axis], part.stops[axis], ends)
    return grid


def _stepped(
    grid: Ints,
    axis: int,
    coarse: int,
    level: int,
    closed: bool,
    stops: bool,
    ends: tuple[bool, bool] = (True, True),
) -> Ints:
    values = np.array(grid, np.int32)
    for channel in range(values.shape[2]):
        plane = values[..., channel].copy()
        step = axis_step(plane.shape[axis], closed, ends, stops)
        forward_step(plane, axis, step, PREDICTORS[level % len(PREDICTORS)])
        values[..., channel] = plane
    return values[:coarse] if axis == 0 else values[:, :coarse]


@settings(max_examples=200)
@given(layouts())
def test_any_layout_is_watertight_at_every_level(blocks: list[LatticeBlock]) -> None:
    arrangement = checked(blocks)
    assert {part.block for part in arrangement.parts} == set(range(len(blocks)))


@given(st.integers(1, 20), st.integers(0, 2**32))
def test_a_sphere_of_six_blocks_has_twelve_curves(faces: int, seed: int) -> None:
    arrangement = checked(cube(np.random.default_rng(seed), faces))
    assert len(arrangement.parts) == 6
    assert len(arrangement.curves) == 12
    assert all(all(part.sides) for part in arrangement.parts)


@given(overlapping())
def test_blocks_may_overlap(blocks: list[LatticeBlock]) -> None:
    assert len(checked(blocks).parts) >= len(blocks)


@given(tubes())
def test_rims_agree_or_are_cut_open(blocks: list[LatticeBlock]) -> None:
    assert len(checked(blocks).parts) >= len(blocks)


@given(layouts(), st.integers(1, 3))
def test_what_splits_too_much_is_given_up_and_the_rest_still_fits(blocks: list[LatticeBlock], limit: int) -> None:
    with patch.object(cuts, "PARTS", 8 * limit), patch.object(cuts, "PARTS_OF_BLOCK", 8):
        arrangement = checked(blocks, complete=False)
    assert len(arrangement.parts) <= 8 * (len(blocks) + limit)


@pytest.mark.parametrize(("name", "blocks", "curves"), [("m6_small", 9, 16), ("uneven_sphere_large", 6, 12)])
def test_real_files_share_as_many_sides_as_they_are_known_to(name: str, blocks: int, curves: int) -> None:
    path = DATA / f"{name}.fmt"
    if not path.exists():
        pytest.skip(f"{path.name} is not here")
    found = plot3d(path)
    arrangement = checked(found)
    assert (len(found), len(arrangement.parts), len(arrangement.curves)) == (blocks, blocks, curves)
    assert not any(curve.stops for curve in arrangement.curves)


def plot3d(path: Path) -> list[LatticeBlock]:
    words = path.read_text().split()
    count = int(words[0])
    sizes = np.array(words[1 : 1 + 3 * count], int).reshape(-1, 3)
    values = np.array(words[1 + 3 * count :], float)
    values *= 2**20 / np.abs(values).max()
    ends = np.cumsum(3 * sizes.prod(axis=1))
    pieces = np.split(np.rint(values).astype(np.int32), ends[:-1])
    return [
        LatticeBlock(piece.reshape(3, columns, rows).transpose(1, 2, 0), (False, False))
        for piece, (rows, columns, _) in zip(pieces, sizes, strict=True)
    ]


def surface(shape: tuple[int, int], kind: str = "sheet") -> Ints:
    """Points of so many faces in the two directions, joined as the kind says."""
    numbers = glued(*shape, GLUES[kind])
    return random_points(np.random.default_rng(0), int(numbers.max()) + 1)[numbers]


def opened(*grids: Ints) -> list[LatticeBlock]:
    return [LatticeBlock(grid, (False, False)) for grid in grids]


def shared(part: Part) -> list[int | None]:
    return [None if side is None else side.curve for side in part.sides]


def test_blocks_side_by_side_share_one_curve_and_are_clamped_all_round() -> None:
    whole = surface((6, 8))
    arrangement = checked(opened(whole[:, :5], whole[:, 4:]))
    assert [shared(part) for part in arrangement.parts] == [[None, None, None, 0], [None, None, 0, None]]
    assert all(part.clamped == (True, True, True, True) for part in arrangement.parts)
    assert [curve.length for curve in arrangement.curves] == [7]


def test_axes_are_turned_round_where_a_gap_has_a_side() -> None:
    """Lengths 6 and 7 meet an even length, 5 and 9 do not."""
    for faces in (4, 5, 6, 8):
        whole = surface((faces, 4))
        one, other = whole[:, :3], whole[::-1, 2:]
        for grids in ((one, other), (one, other.transpose(1, 0, 2))):
            arrangement = checked(opened(*grids))
            matters = faces in (5, 6)
            axis = int(grids[1].shape[1] == faces + 1)
            assert arrangement.parts[1].flipped[axis] == matters
            assert [side.reversed for part in arrangement.parts for side in part.sides if side] == [False, not matters]


def test_a_side_is_split_where_its_neighbours_end_and_so_is_what_lies_opposite() -> None:
    whole = surface((6, 9))
    bricks = [whole[:3, :5], whole[:3, 4:], whole[2:5, :4], whole[2:5, 3:7], whole[2:5, 6:], whole[4:]]
    arrangement = checked(opened(*bricks))
    columns = [part.columns for part in arrangement.parts]
    assert columns == [
        *[(0, 4), (3, 5), (0, 3), (2, 6)],
        *[(0, 4), (0, 2), (1, 4), (0, 4)],
        *[(0, 4), (3, 5), (4, 7), (6, 10)],
    ]
    assert all(part.rows in ((0, 3), (0, 2)) for part in arrangement.parts)


def test_any_number_of_blocks_may_meet_along_a_curve() -> None:
    whole, fin = surface((6, 8)), surface((6, 3)) + 2**21
    fin[:, 0] = whole[:, 4]
    arrangement = checked(opened(whole[:, :5], whole[:, 4:], fin))
    assert [shared(part) for part in arrangement.parts] == [
        [None, None, None, 0],
        [None, None, 0, None],
        [None, None, 0, None],
    ]


def test_a_block_that_comes_back_to_itself_shares_a_side_with_itself() -> None:
    arrangement = checked(opened(surface((5, 8), "cylinder")))
    assert shared(arrangement.parts[0]) == [None, None, 0, 0]
    assert not arrangement.curves[0].stops


def test_a_c_grid_is_split_where_the_wake_begins() -> None:
    whole = surface((4, 20))
    whole[0, 15:] = whole[0, 5::-1]
    arrangement = checked(opened(whole))
    assert [part.columns for part in arrangement.parts] == [(0, 6), (5, 16), (15, 21)]
    first, middle, last = (shared(part) for part in arrangement.parts)
    assert first[0] == last[0] is not None
    assert middle[0] is None


@pytest.mark.parametrize("double", [False, True])
def test_a_side_that_is_folded_is_split_at_the_fold(double: bool) -> None:
    whole = surface((4, 8 + double))
    whole[0, 5 + double :] = whole[0, 3::-1]
    if double:
        whole[0, 4] = whole[0, 5]
    arrangement = checked(opened(whole))
    assert [part.columns for part in arrangement.parts] == ([(0, 5), (4, 6), (5, 10)] if double else [(0, 5), (4, 9)])


def test_where_no_direction_is_consistent_axes_stop_at_an_even_length() -> None:
    for faces, stops in ((4, False), (5, True), (6, True), (8, False)):
        strip = surface((7, faces), "moebius")
        for blocks in (opened(strip), opened(strip[:4], strip[3:])):
            arrangement = checked(blocks)
            assert all(part.stops == (False, stops) for part in arrangement.parts)
            assert all(curve.stops == stops for curve in arrangement.curves if curve.length == faces + 1)
            assert any(side.reversed for part in arrangement.parts for side in part.sides if side)


def test_a_shared_rim_is_a_closed_curve_begun_at_one_point_and_run_one_way() -> None:
    whole = surface((6, 10), "cylinder")[:, :-1]
    upper = LatticeBlock(whole[:4], (False, True))
    for lower in (whole[3:], np.roll(whole[3:], 3, axis=1), np.roll(whole[3:, ::-1], 4, axis=1)):
        arrangement = checked([upper, LatticeBlock(lower, (False, True))])
        assert [part.closed for part in arrangement.parts] == [(False, True)] * 2
        assert [shared(part) for part in arrangement.parts] == [[None, 0, None, None], [0, None, None, None]]
        assert [part.clamped for part in arrangement.parts] == [(True, True, False, False)] * 2
        assert arrangement.curves[0].closed
        assert not any(side.reversed for part in arrangement.parts for side in part.sides if side)


def test_a_rim_shared_with_open_sides_is_cut_where_they_end() -> None:
    whole = surface((6, 10), "cylinder")
    ring = LatticeBlock(np.roll(whole[:4, :-1], 3, axis=1), (False, True))
    arrangement = checked([ring, *opened(whole[3:])])
    assert [part.columns for part in arrangement.parts] == [(3, 14), (0, 11)]
    assert arrangement.parts[0].sides[2] == arrangement.parts[0].sides[3] is not None
    arrangement = checked([ring, *opened(whole[3:, :4], whole[3:, 3:])])
    assert [part.columns for part in arrangement.parts] == [(3, 7), (6, 14), (0, 4), (0, 8)]


def test_a_tube_that_ends_in_its_own_beginning_turned_over_is_cut_where_the_turn_leaves_a_point() -> None:
    whole = surface((6, 10), "cylinder")[:, :-1]
    whole[-1] = np.roll(whole[0, ::-1], 3, axis=0)
    arrangement = checked([LatticeBlock(whole, (False, True))])
    assert [part.columns for part in arrangement.parts] == [(1, 12)]
    assert [part.stops for part in arrangement.parts] == [(False, True)]


def test_a_tube_twisted_by_one_sample_is_not_cut_to_ribbons() -> None:
    whole = surface((6, 200), "cylinder")[:, :-1]
    whole[-1] = np.roll(whole[0], 1, axis=0)
    arrangement = checked([LatticeBlock(whole, (False, True))], complete=False)
    assert len(arrangement.parts) == 1
    assert not arrangement.curves
    assert len(checked([LatticeBlock(whole, (False, True))]).parts) == 200


def test_poles_are_clamped_and_are_no_curves() -> None:
    whole = surface((6, 8), "cylinder")[:, :-1]
    whole[0], whole[-1] = whole[0, 0], whole[-1, 0]
    (part,) = checked([LatticeBlock(whole, (False, True))]).parts
    assert (part.closed, part.sides, part.clamped) == ((False, True), (None,) * 4, (True, True, False, False))
    whole[-1] = surface((6, 8))[-1, :-1]
    (part,) = checked([LatticeBlock(whole, (False, True))]).parts
    assert part.clamped == (True, False, False, False)


def test_edges_without_length_are_passed_over() -> None:
    whole = surface((6, 8))
    whole[2:4, 4] = whole[1, 4]
    arrangement = checked(opened(whole[:, :5], whole[:, 4:]))
    assert len(arrangement.parts) == 2
    assert len(arrangement.curves) == 1


def test_points_that_only_one_block_holds_valid_end_a_contact() -> None:
    whole = surface((6, 8))
    left, right = np.ones((7, 5), bool), np.ones((7, 5), bool)
    left[3, 4] = right[3, 0] = False
    both = [LatticeBlock(whole[:, :5], (False, False), left), LatticeBlock(whole[:, 4:], (False, False), right)]
    assert len(checked(both).parts) == 2
    arrangement = checked([both[0], LatticeBlock(whole[:, 4:], (False, False))])
    assert [part.rows for part in arrangement.parts] == [(0, 3), (2, 5), (4, 7)] * 2
    assert [curve.length for curve in arrangement.curves if curve.length == 3] == [3, 3]


def test_single_points_curves_and_heights_are_not_shared() -> None:
    whole = surface((6, 8))
    apart = arrange(opened(whole[:4, :5], whole[3:, 4:]), 3)
    assert not apart.curves
    thin = arrange(opened(whole[:, :1], whole[:, :1], whole[:1, :1]), 3)
    assert not thin.curves
    assert [part.clamped for part in apart.parts + thin.parts] == [(False,) * 4] * 5
    heights = arrange(opened(whole[:, :5, :1], whole[:, 4:, :1]), 1)
    assert not heights.curves
    assert arrange([], 3) == Arrangement((), ())


def test_channels_that_are_not_geometric_do_not_tell_points_apart() -> None:
    whole = surface((6, 8))
    one, other = whole[:, :5], whole[:, 4:].copy()
    other[..., 2] += 1
    assert not arrange(opened(one, other), 3).curves
    assert len(arrange(opened(one, other), 2).curves) == 1


@pytest.mark.parametrize("predictor", PREDICTORS)
def test_steps_of_odd_lengths_between_clamped_ends_are_the_same_backwards(predictor: tuple[int, int]) -> None:
    """Nodes, details and what the inverse makes of any of them: why sides may be reversed where all lengths are odd."""
    rng = np.random.default_rng(1)
    for length in range(3, 70, 2):
        step = axis_step(length, False, (True, True))
        ahead = rng.integers(-(2**24), 2**24, (1, length), np.int32)
        back = ahead[:, ::-1].copy()
        for move in (forward_step, inverse_step):
            move(ahead, 1, step, predictor)
            move(back, 1, step, predictor)
            nodes, details = (step.coarse, length) if move is forward_step else (length, length)
            np.testing.assert_array_equal(ahead[:, :nodes], back[:, :nodes][:, ::-1])
            np.testing.assert_array_equal(ahead[:, nodes:details], back[:, nodes:details][:, ::-1])
            if move is forward_step:
                ahead[:, nodes:] //= 4
                back[:, nodes:] = ahead[:, nodes:][:, ::-1]
