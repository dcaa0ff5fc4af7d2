"""What must hold of every arrangement of blocks."""

from __future__ import annotations

from collections import defaultdict
from typing import Any
from unittest import mock

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream.grid.axis import axis_lengths, axis_step
from lodestream.grid.connectivity import Arrangement, LatticeBlock, Patch, arrange, assemble, cuts, stored
from lodestream.transform.lifting import forward_step

#: The third step of the levels, in turn.
PREDICTORS = [(0, 0), (16, 0), (32, -7)]

Ints = NDArray[np.int32]


def lines(grid: NDArray[Any]) -> list[NDArray[Any]]:
    """First row, last row, first column, last column."""
    return [grid[0], grid[-1], grid[:, 0], grid[:, -1]]


def checked(blocks: list[LatticeBlock], complete: bool = True) -> Arrangement:
    """The arrangement of blocks in space, when all that must hold of it does; ``complete``: however many patches."""
    with mock.patch.object(cuts, "PATCHES", 10**6 if complete else cuts.PATCHES):
        arrangement = arrange(blocks, 3)
    grids = [stored(patch, blocks[patch.block].coordinates) for patch in arrangement.patches]
    masks = [stored(patch, _mask(blocks[patch.block])) for patch in arrangement.patches]
    closed = [block.closed for block in blocks]
    for block, points, mask in zip(
        blocks, assemble(closed, arrangement.patches, grids), assemble(closed, arrangement.patches, masks), strict=True
    ):
        np.testing.assert_array_equal(points, block.coordinates)
        np.testing.assert_array_equal(mask, _mask(block))
    _check_interfaces(arrangement, grids, masks)
    _check_patches(arrangement, grids, masks)
    if complete:
        _check_that_all_is_shared(blocks, arrangement, grids, masks)
    _check_levels(arrangement, grids, closed)
    return arrangement


def _mask(block: LatticeBlock) -> NDArray[np.bool_]:
    return np.ones(block.coordinates.shape[:2], bool) if block.mask is None else block.mask


def _check_interfaces(arrangement: Arrangement, grids: list[Ints], masks: list[NDArray[np.bool_]]) -> None:
    """All users of an interface have its points, its length, its closure; there are at least two, or one twice."""
    seen: dict[int, tuple[Ints, Ints]] = {}
    users: dict[int, int] = defaultdict(int)
    for patch, grid, mask in zip(arrangement.patches, grids, masks, strict=True):
        for number, side in enumerate(patch.sides):
            if side is None:
                continue
            along, interface, turn = 1 - number // 2, arrangement.interfaces[side.interface], -1 if side.reversed else 1
            points = lines(grid)[number][::turn], lines(mask)[number][::turn]
            for ours, theirs in zip(points, seen.setdefault(side.interface, points), strict=True):
                np.testing.assert_array_equal(ours, theirs)
            assert len(points[0]) == interface.length
            assert (patch.closed[along], patch.stops[along]) == (interface.closed, interface.stops)
            assert not patch.closed[number // 2]
            assert (points[0] != points[0][0]).any()
            if side.reversed:
                assert not interface.closed
                assert interface.stops or all(n % 2 for n in axis_lengths(interface.length, False)[1:])
            users[side.interface] += 1
    assert sorted(users) == list(range(len(arrangement.interfaces)))
    assert all(count > 1 for count in users.values())


def _check_patches(arrangement: Arrangement, grids: list[Ints], masks: list[NDArray[np.bool_]]) -> None:
    for patch, grid, mask in zip(arrangement.patches, grids, masks, strict=True):
        assert grid.shape[:2] == patch.shape
        for number in range(4):
            line, valid = lines(grid)[number], lines(mask)[number]
            pole = min(grid.shape[:2]) > 1 and (line == line[0]).all() and valid.all()
            expected = any(patch.sides) or pole
            assert patch.clamped[number] == (bool(expected) and not patch.closed[number // 2])
        for axis in (0, 1):
            assert not (patch.stops[axis] and (patch.closed[axis] or patch.flipped[axis]))


def _check_that_all_is_shared(
    blocks: list[LatticeBlock], arrangement: Arrangement, grids: list[Ints], masks: list[NDArray[np.bool_]]
) -> None:
    """An edge that sides of blocks have in common is one edge of one interface, wherever it lies."""
    places: dict[frozenset[bytes], set[tuple[int, ...]]] = defaultdict(set)
    for n, (patch, grid, mask) in enumerate(zip(arrangement.patches, grids, masks, strict=True)):
        if min(grid.shape[:2]) < 2:
            continue
        for number, side in enumerate(patch.sides):
            axis, along = number // 2, 1 - number // 2
            if patch.closed[axis] or not _is_outside(patch, number, blocks[patch.block]):
                continue
            line, valid = lines(grid)[number], lines(mask)[number]
            last = len(line) - 1
            for i in range(last + patch.closed[along]):
                ends = line[i].tobytes(), line[(i + 1) % len(line)].tobytes()
                if ends[0] == ends[1] or not (valid[i] and valid[(i + 1) % len(line)]):
                    continue
                if side is None:
                    places[frozenset(ends)].add((-1, n, number, i))
                else:
                    places[frozenset(ends)].add((side.interface, last - 1 - i if side.reversed else i))
    assert all(len(found) == 1 for found in places.values())


def _is_outside(patch: Patch, number: int, block: LatticeBlock) -> bool:
    """Whether a side of a patch lies on a side of its block."""
    axis = number // 2
    window = (patch.rows, patch.columns)[axis]
    is_last = bool(number % 2) != patch.flipped[axis]
    length = block.coordinates.shape[axis]
    return not block.closed[axis] and (window[1] == length if is_last else window[0] == 0)


def _check_levels(arrangement: Arrangement, grids: list[Ints], closed: list[tuple[bool, bool]]) -> None:
    """Every patch coarsened by itself, and every interface: shared sides stay the same to the bit."""
    work = [np.array(grid, np.int32) for grid in grids]
    interfaces: dict[int, Ints] = {}
    for patch, grid in zip(arrangement.patches, work, strict=True):
        for number, side in enumerate(patch.sides):
            if side is not None:
                interfaces[side.interface] = lines(grid)[number][:: -1 if side.reversed else 1].copy()
    for level in range(40):
        coarser = [_coarsened(patch, grid, level) for patch, grid in zip(arrangement.patches, work, strict=True)]
        for number, interface in enumerate(arrangement.interfaces):
            step = axis_step(len(interfaces[number]), interface.closed, (True, True), interface.stops)
            interfaces[number] = _stepped(
                interfaces[number][:, None], 0, step.coarse, level, interface.closed, interface.stops
            )[:, 0]
        for patch, fine, coarse in zip(arrangement.patches, work, coarser, strict=True):
            for number, side in enumerate(patch.sides):
                line = lines(coarse)[number]
                if side is not None:
                    np.testing.assert_array_equal(line[:: -1 if side.reversed else 1], interfaces[side.interface])
                elif patch.clamped[number] and (lines(fine)[number] == lines(fine)[number][0]).all():
                    assert (line == lines(fine)[number][0]).all()
        done = all(a.shape == b.shape for a, b in zip(work, coarser, strict=True))
        work = coarser
        assemble(closed, arrangement.patches, work)
        if done:
            return
    pytest.fail("coarsening does not end")


def _coarsened(patch: Patch, grid: Ints, level: int) -> Ints:
    for axis in (0, 1):
        ends = patch.clamped[2 * axis], patch.clamped[2 * axis + 1]
        step = axis_step(grid.shape[axis], patch.closed[axis], ends, patch.stops[axis])
        grid = _stepped(grid, axis, step.coarse, level, patch.closed[axis], patch.stops[axis], ends)
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
