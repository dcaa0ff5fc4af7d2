"""Walks from face to face of a mesh against plain Python, in one call of a kernel and in as many as there are steps."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.mesh.cut import irregular, trace
from lodestream.mesh.halfedges import find_pieces, find_twins, find_umbrellas, join_pieces, orient, turn
from lodestream.mesh.patchwork import Quads
from lodestream.mesh.poles import find_poles, leaving_half_edges, unfold
from lodestream.mesh.polygons import Polygons
from lodestream.mesh.tearing import rows_of_vertices, tear

from .meshes import any_faces, calls_of, corners_of, scrambled, wound_alike

Ints = NDArray[np.int32]

seeds = st.integers(0, 2**32)


@pytest.fixture(autouse=True, scope="module", params=[1, 5, 1 << 16])
def _steps_of_a_call(request: pytest.FixtureRequest) -> Iterator[None]:
    with calls_of(request.param):
        yield


def umbrellas_of(polygons: Polygons) -> tuple[Ints, Ints]:
    umbrella, valence = np.empty(polygons.twins.size, np.int32), np.empty(polygons.twins.size, np.int32)
    return umbrella, valence[: find_umbrellas(polygons.corners, polygons.twins, umbrella, valence)].copy()


def quads_of(polygons: Polygons, attributes: Ints) -> Quads:
    none = np.zeros(0, np.int32)
    cut = np.zeros(len(polygons.corners), np.bool_)
    return Quads(polygons.corners, polygons.twins, polygons.origin, cut, attributes, (), none, cut[:0], ())


def sides_of(corners: Ints, face: int) -> int:
    return 3 if corners[face, 3] < 0 else 4


def after(corners: Ints, half: int) -> int:
    face, k = divmod(half, 4)
    return 4 * face + (k + 1) % sides_of(corners, face)


def before(corners: Ints, half: int) -> int:
    face, k = divmod(half, 4)
    return 4 * face + (k - 1) % sides_of(corners, face)


def first_of_group(count: int, pairs: list[tuple[int, int]]) -> list[int]:
    """For each of so many things the first of those that pairs connect it with."""
    first = list(range(count))
    while True:
        old = list(first)
        for a, b in pairs:
            first[a] = first[b] = min(first[a], first[b])
        if first == old:
            return first


def in_order(first: list[int]) -> list[int]:
    return np.unique(first, return_inverse=True)[1].reshape(-1).tolist()


def beside(twins: Ints) -> list[tuple[int, int]]:
    return [(half // 4, int(twin) // 4) for half, twin in enumerate(twins) if twin >= 0]


@given(seeds, st.booleans())
def test_twins(seed: int, soup: bool) -> None:
    faces, vertices = any_faces(seed)
    if soup:  # three faces and more at an edge
        rng = np.random.default_rng(seed)
        faces += [rng.choice(vertices, 4, replace=False).tolist() for _ in range(5)] + faces[:2] * int(rng.integers(3))
    corners = corners_of(faces)
    at: dict[frozenset[int], list[int]] = {}
    for face in range(len(corners)):
        for half in range(4 * face, 4 * face + sides_of(corners, face)):
            ends = (corners.flat[half], corners.flat[after(corners, half)])
            at.setdefault(frozenset(map(int, ends)), []).append(half)
    twins, crossed, same = find_twins(corners, vertices)
    assert crossed == min((halves[2] for halves in at.values() if len(halves) > 2), default=-1)
    if crossed < 0:
        pairs = [halves for halves in at.values() if len(halves) == 2]
        expected = np.full(corners.size, -1)
        for a, b in pairs:
            expected[a], expected[b] = b, a
        assert np.array_equal(twins, expected)
        assert same == sum(int(corners.flat[a] == corners.flat[b]) for a, b in pairs)


@given(seeds)
def test_pieces_and_parts(seed: int) -> None:
    faces, vertices = any_faces(seed)
    rng = np.random.default_rng(seed)
    corners = corners_of(faces)
    twins, _, _ = find_twins(corners, vertices)
    apart = np.where(rng.random(twins.size) < 0.4, -1, twins)
    apart = np.where((apart >= 0) & (apart[apart] < 0), -1, apart).astype(np.int32)
    piece = np.empty(len(corners), np.int32)
    count = find_pieces(apart, piece)
    assert piece.tolist() == in_order(first_of_group(len(corners), beside(apart)))
    assert count == len(set(piece.tolist()))
    some: dict[int, int] = {}
    touching = [(int(piece[face]), some.setdefault(v, int(piece[face]))) for face, vs in enumerate(faces) for v in vs]
    parts = join_pieces(corners, piece, count, vertices)
    assert parts.tolist() == in_order(first_of_group(count, touching))


@given(seeds, st.booleans())
def test_faces_to_turn_round(seed: int, one_sided: bool) -> None:
    faces, vertices = any_faces(seed, "quads")
    if one_sided:
        strip = [[2 * j, 2 * j + 1, 2 * j + 3, 2 * j + 2] for j in range(4)] + [[8, 9, 0, 1]]
        faces += [[vertices + corner for corner in face] for face in strip]
        faces, vertices = scrambled(faces, vertices + 10, np.random.default_rng(seed)), vertices + 10
    corners = corners_of(faces)
    twins, _, _ = find_twins(corners, vertices)
    turned = np.zeros(len(corners), np.bool_)
    wrong = orient(corners, twins, turned)
    # Either side of each face, and which sides are connected.
    there = np.flatnonzero(twins >= 0)
    same = corners.flat[there] == corners.flat[twins[there]]
    sides = [
        (2 * (a // 4) + side, 2 * (b // 4) + (side ^ s))
        for a, b, s in zip(there.tolist(), twins[there].tolist(), same.tolist(), strict=True)
        for side in (0, 1)
    ]
    first = np.array(first_of_group(2 * len(corners), sides)).reshape(-1, 2)
    both = first[:, 0] == first[:, 1]
    assert both.any() == one_sided
    assert both[wrong] if one_sided else wrong == -1
    if one_sided:
        return
    moved = turn(corners, turned)
    start = np.empty(corners.size, np.int32)
    start[moved.reshape(-1)] = np.where(np.repeat(turned, 4), np.roll(corners, -1, axis=1).reshape(-1), corners.flat)
    assert (start[moved[there]] != start[moved[twins[there]]]).all()
    for number in np.unique(first.min(axis=1)):
        ours = turned[first.min(axis=1) == number]
        assert ours.sum() < len(ours) / 2 or (ours.sum() == len(ours) / 2 and not ours[0])


@given(seeds)
def test_umbrellas(seed: int) -> None:
    polygons, _ = wound_alike(seed)
    corners, twins = polygons.corners, polygons.twins
    umbrella, valence = umbrellas_of(polygons)
    pairs = [(half, after(corners, int(twin))) for half, twin in enumerate(twins) if twin >= 0]
    first = np.array(first_of_group(corners.size, pairs))
    there = corners.reshape(-1) >= 0
    assert (umbrella[~there] == -1).all()
    assert umbrella[there].tolist() == in_order(first[there].tolist())
    expected = np.bincount(umbrella[there])
    expected[umbrella[there & (twins < 0)]] *= -1
    assert np.array_equal(valence, expected)


@given(seeds)
def test_attributes_that_agree_at_each_vertex(seed: int) -> None:
    polygons, vertices = wound_alike(seed)
    rng = np.random.default_rng(seed)
    rows = np.where(polygons.corners >= 0, polygons.corners * 2, -1).astype(np.int32)
    rows[rng.random(rows.shape) < rng.choice([0, 0.05])] = 1
    seen: dict[int, set[int]] = {}
    for vertex, row in zip(polygons.corners.reshape(-1).tolist(), rows.reshape(-1).tolist(), strict=True):
        if vertex >= 0:
            seen.setdefault(vertex, set()).add(row)
    row_of = np.empty(vertices, np.int32)
    agree = rows_of_vertices(polygons.corners, rows, row_of)
    assert agree == all(len(some) == 1 for some in seen.values())
    if agree:
        assert row_of.tolist() == [min(seen.get(vertex, {-1})) for vertex in range(vertices)]


@given(seeds)
def test_edges_at_which_attributes_differ(seed: int) -> None:
    polygons, _ = wound_alike(seed, "quads")
    rng = np.random.default_rng(seed)
    attributes = np.tile(polygons.corners, (int(rng.integers(3)), 1, 1))
    attributes[rng.random(attributes.shape) < 0.05] = -5
    twins, torn = polygons.twins.copy(), np.zeros(len(attributes))
    for half, twin in enumerate(polygons.twins.tolist()):
        if twin > half:
            for number, values in enumerate(attributes.reshape(len(attributes), twins.size)):
                ends = values[[half, after(polygons.corners, half)]], values[[after(polygons.corners, twin), twin]]
                if (ends[0] != ends[1]).any():
                    torn[number] += 1
                    twins[[half, twin]] = -1
    found = polygons.twins.copy()
    assert tear(quads_of(polygons, attributes), found).tolist() == torn.tolist()
    assert np.array_equal(found, twins)


def traced(corners: Ints, twins: Ints, umbrella: Ints, valence: Ints, starts: Ints, whole: bool) -> set[int]:
    cut: set[int] = set()
    passed = set(umbrella[starts].tolist())
    riders = starts.tolist()
    while riders:
        kept = []
        for half in riders:
            if half in cut:
                continue
            cut |= {half, int(twins[half])}
            ahead = after(corners, half)
            vertex = int(umbrella[ahead])
            if valence[vertex] == 4 and (whole or vertex not in passed):
                passed.add(vertex)
                kept.append(after(corners, int(twins[ahead])))
        riders = kept
    return cut


@given(seeds, st.booleans())
def test_grid_lines(seed: int, whole: bool) -> None:
    polygons, _ = wound_alike(seed, "quads")
    umbrella, valence = umbrellas_of(polygons)
    starts = np.flatnonzero((polygons.twins >= 0) & irregular(valence)[umbrella]).astype(np.int32)
    cut = np.zeros(polygons.twins.size, np.bool_)
    trace(polygons.corners, polygons.twins, umbrella, valence, starts, whole, cut)
    expected = traced(polygons.corners, polygons.twins, umbrella, valence, starts, whole)
    assert set(np.flatnonzero(cut).tolist()) == expected


def poles_among(
    polygons: Polygons, umbrella: Ints, valence: Ints, order: list[int], together: bool
) -> tuple[list[bool], list[int]]:
    corners, twins = polygons.corners, polygons.twins
    pole, missing = [False] * len(valence), [6 - count if count > 0 else 0 for count in valence.tolist()]
    leaves = leaving_half_edges(polygons.twins, umbrella, valence)
    for vertex in order:
        fan = [int(leaves[vertex])]
        while len(fan) < abs(valence[vertex]):
            fan.append(int(twins[before(corners, fan[-1])]))
        rim = [int(umbrella[after(corners, half)]) for half in fan]
        if valence[vertex] < 0:
            rim.append(int(umbrella[before(corners, fan[-1])]))
        inner = rim if valence[vertex] > 0 else rim[1:-1]
        fits = all(missing[it] > 0 if valence[it] > 0 else valence[it] == -2 for it in inner)
        if together:
            fits = fits and not any(pole[it] for it in rim)
        if fits and abs(valence[vertex]) >= (3 if valence[vertex] > 0 else 2):
            pole[vertex] = True
            if together:
                missing[vertex] = 0
                for it in inner:
                    missing[it] -= valence[it] > 0
    return pole, missing


@given(seeds, st.booleans())
def test_poles(seed: int, together: bool) -> None:
    polygons, _ = wound_alike(seed, "triangles")
    umbrella, valence = umbrellas_of(polygons)
    order = np.random.default_rng(seed).permutation(len(valence)).astype(np.int32)
    pole, missing = np.zeros(len(valence), np.bool_), np.empty(len(valence), np.int32)
    leaves = leaving_half_edges(polygons.twins, umbrella, valence)
    find_poles(polygons.corners, polygons.twins, umbrella, valence, leaves, order, together, pole, missing)
    expected = poles_among(polygons, umbrella, valence, order.tolist(), together)
    assert (pole.tolist(), missing.tolist()) == expected


@given(seeds)
def test_fans_unfolded(seed: int) -> None:
    polygons, vertices = wound_alike(seed)
    corners, twins = polygons.corners, polygons.twins
    umbrella, valence = umbrellas_of(polygons)
    rng = np.random.default_rng(seed)
    folded = (rng.random(len(corners)) < 0.1) & (corners[:, 3] < 0)
    attributes = np.stack([corners, corners // 2, rng.integers(0, 3, corners.shape)]).astype(np.int32)
    # Some vertices with triangles alone, none of which has two of them.
    pole, taken = np.zeros(len(valence), np.bool_), corners[:, 3] >= 0
    fans: list[list[int]] = []
    for vertex in rng.permutation(len(valence))[: len(valence) // 2].tolist():
        halves = np.flatnonzero(umbrella == vertex).tolist()
        if taken[[half // 4 for half in halves]].any():
            continue
        taken[[half // 4 for half in halves]] = pole[vertex] = True
        fan = [half for half in halves if twins[half] < 0] or halves[:1]
        while len(fan) < len(halves):
            fan.append(int(twins[before(corners, fan[-1])]))
        fans.append(fan)
    expected, expected_attributes, pole_of = corners.copy(), attributes.copy(), list[int]()
    for fan in sorted(fans, key=min):
        closed, begin = twins[fan[0]] >= 0, len(pole_of)
        for half, following in zip(fan, [*fan[1:], fan[0] if closed else -1], strict=True):
            face, tip = divmod(half, 4)
            round_it = [tip, (tip + 1) % 3, (tip + 2) % 3]
            end = begin if following == fan[0] else len(pole_of) + 1
            expected[face] = [vertices + len(pole_of), *corners[face, round_it[1:]], vertices + end]
            pole_of.append(int(corners[face, tip]))
            for old, new in zip(attributes, expected_attributes, strict=True):
                there = following >= 0 and old.flat[after(corners, following)] == old[face, round_it[2]]
                last = old[face, 3] if folded[face] else old.flat[following] if there else old[face, tip]
                new[face] = [*old[face, round_it], last]
        if not closed:
            pole_of.append(pole_of[-1])
    new, new_attributes, found = corners.copy(), attributes.copy(), np.empty(2 * sum(map(len, fans)), np.int32)
    count = unfold(
        *(corners, twins, umbrella, pole, folded, attributes, vertices),
        *(new, new_attributes, found),
    )
    assert found[:count].tolist() == pole_of
    assert np.array_equal(new, expected)
    assert np.array_equal(new_attributes, expected_attributes)
