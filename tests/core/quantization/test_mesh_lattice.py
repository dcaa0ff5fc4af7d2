"""Faces of a mesh laid out in the plane, and grids of them, against plain Python."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.mesh.develop import develop_quads, develop_triangles
from lodestream.mesh.grid import _start, make_grid
from lodestream.mesh.triangles import _Survey

from ..mesh.meshes import calls_of, wound_alike

Ints = NDArray[np.int32]

seeds = st.integers(0, 2**32)


@pytest.fixture(autouse=True, scope="module", params=[1, 5, 1 << 16])
def _steps_of_a_call(request: pytest.FixtureRequest) -> Iterator[None]:
    with calls_of(request.param):
        yield


STEPS = {4: [(0, 1), (1, 0), (0, -1), (-1, 0)], 3: [(1, 0), (0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1)]}


def basis(steps: list[tuple[int, int]]) -> tuple[int, int, int]:
    """(a, b) and (0, d), whose sums are those of the steps."""
    a, b, d = 0, 0, 0
    for x, y in steps:
        while x:
            (a, b), (x, y) = (x, y), (a - a // x * x, b - a // x * y)
        d = int(np.gcd(d, y))
    a, b = (-a, -b) if a < 0 else (a, b)
    return a, b % d if d else b, d


def developed(sides: int, twins: Ints) -> tuple[list[Any], ...]:
    steps = STEPS[sides]
    turn, count = len(steps) // sides, len(twins) // 4
    piece, first, heading = [-1] * count, [(0, 0)] * count, [-1] * count
    turns: list[bool] = []
    periods: list[list[tuple[int, int]]] = []
    for seed in range(count):
        if heading[seed] >= 0:
            continue
        piece[seed], heading[seed] = len(turns), 0
        turns.append(False)
        periods.append([])
        stack = [seed]
        while stack:
            face = stack.pop()
            (x, y), way = first[face], heading[face]
            for k in range(sides):
                x, y = x + steps[way][0], y + steps[way][1]
                other, m = divmod(int(twins[4 * face + k]), 4)
                if other >= 0:
                    back = (way + len(steps) // 2 - turn * m) % len(steps)
                    gone = [steps[(back + turn * j) % len(steps)] for j in range(m)]
                    place = (x - sum(step[0] for step in gone), y - sum(step[1] for step in gone))
                    if heading[other] < 0:
                        piece[other], first[other], heading[other] = len(turns) - 1, place, back
                        stack.append(other)
                    elif heading[other] != back:
                        turns[-1] = True
                    else:
                        periods[-1].append((place[0] - first[other][0], place[1] - first[other][1]))
                way = (way + turn) % len(steps)
    return piece, first, heading, turns, [basis(steps) for steps in periods]


@given(seeds, st.sampled_from([3, 4]))
def test_faces_laid_out(seed: int, sides: int) -> None:
    polygons, _ = wound_alike(seed, "quads" if sides == 4 else "triangles")
    laid = develop_quads(polygons.twins) if sides == 4 else develop_triangles(polygons.twins)
    piece, first, heading, turns, periods = developed(sides, polygons.twins)
    assert laid.piece.tolist() == piece
    assert laid.first.tolist() == list(map(list, first))
    assert laid.heading.tolist() == heading
    assert laid.turns.tolist() == turns
    assert laid.periods.tolist() == list(map(list, periods))


def test_more_pieces_laid_out_than_there_is_room_for_at_first() -> None:
    laid = develop_quads(np.full(4 * 1000, -1, np.int32))
    assert laid.piece.tolist() == list(range(1000))
    assert laid.turns.shape == (1000,)
    assert not laid.periods.any()


@given(seeds)
def test_what_there_is_along_each_direction(seed: int) -> None:
    polygons, vertices = wound_alike(seed, "triangles")
    corners, twins = polygons.corners, polygons.twins
    points = np.random.default_rng(seed).random((vertices, 2 + seed % 2))
    laid = develop_triangles(twins)
    survey = _Survey.of(corners, twins, points, laid)
    ways = (laid.heading[:, None] + np.array([0, 2, 4])) % 6
    steps = np.array(STEPS[3])[ways]
    places = laid.first[:, None].astype(np.int64) + np.cumsum(steps, axis=1) - steps
    lengths = np.linalg.norm(points[corners[:, :3]] - points[np.roll(corners[:, :3], -1, axis=1)], axis=-1)
    for number in range(len(laid.turns)):
        ours = laid.piece == number
        x, y = places[ours, :, 0], places[ours, :, 1]
        assert survey.extent[number].tolist() == [np.ptp(x), np.ptp(y), np.ptp(x + y)]
        for way in range(3):
            along = ours[:, None] & (ways % 3 == way)
            assert survey.single[number, way] == (twins.reshape(-1, 4)[:, :3][along] < 0).any()
            assert np.isclose(survey.length[number, way], lengths[along].sum())


@given(seeds)
def test_quads_in_their_places(seed: int) -> None:
    polygons, _ = wound_alike(seed, "quads")
    corners = polygons.corners
    laid = develop_quads(polygons.twins)
    for number in range(len(laid.turns)):
        faces = np.flatnonzero(laid.piece == number)
        grid = make_grid(faces, laid, number, corners.reshape(-1), corners.reshape(-1))
        if grid is None:
            continue
        assert sorted(grid.faces[grid.faces >= 0].tolist()) == faces.tolist()
        for r, c in np.argwhere(grid.faces >= 0).tolist():
            below, right = (r + 1) % grid.corners.shape[0], (c + 1) % grid.corners.shape[1]
            round_it = [grid.corners[r, c], grid.corners[r, right], grid.corners[below, right], grid.corners[below, c]]
            face = corners[grid.faces[r, c]].tolist()
            found = corners.reshape(-1)[round_it].tolist()[:: -1 if grid.reversed else 1]
            assert found in [face[k:] + face[:k] for k in range(4)]


@given(seeds)
def test_where_closed_lines_begin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, length = rng.integers(1, 6), rng.integers(3, 9)
    lines = rng.integers(0, rng.integers(1, 30), (count, length)).astype(np.int32)
    lines[rng.random(lines.shape) < rng.choice([0, 0.3, 0.8])] = -1
    votes = np.zeros(length, np.int64)
    for line in lines.tolist():
        numbers = [number for number in line if number >= 0]
        if len(set(numbers)) < 2:
            continue
        place = line.index(min(numbers))
        votes[place] += 1
        while line[place - 1] < 0:
            place -= 1
            votes[place] += 1
    assert _start(lines) == np.flatnonzero(votes == votes.max())[-1]
