"""Faces of more than four corners, cut into triangles that cover them and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.errors import FormatError, InputError
from lodestream.mesh import Mesh
from lodestream.mesh.ears import cut_faces, cut_polygons

Floats = NDArray[np.float64]


def star(corners: int, seed: int) -> Floats:
    """A simple polygon, seldom convex, whose corners a centre sees."""
    random = np.random.default_rng(seed)
    angle = 2 * np.pi * (np.arange(corners) + 0.8 * random.random(corners)) / corners
    radius = random.uniform(0.1, 1, corners)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def comb(teeth: int) -> Floats:
    """A polygon whose corners nobody sees from one place."""
    shape = ((0.9, 0.2), (0.8, 3.0), (0.2, 3.0), (0.1, 0.2))
    return np.array([[0, 0], [teeth, 0], *([k + x, y] for k in reversed(range(teeth)) for x, y in shape)], np.float64)


def areas_of(polygon: Floats, triangles: NDArray[np.int64]) -> Floats:
    a, b, c = (polygon[triangles[:, k]] for k in range(3))
    return ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2


def area_of(polygon: Floats) -> float:
    x, y = polygon.T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


def edges_of(triangles: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Edges that no other triangle passes the other way."""
    edges = {(int(row[k]), int(row[(k + 1) % 3])) for row in triangles for k in range(3)}
    return sorted((a, b) for a, b in edges if (b, a) not in edges)


@given(st.integers(5, 30), st.integers(0, 1000), st.booleans())
def test_triangles_cover_a_polygon_once(corners: int, seed: int, reverse: bool) -> None:
    polygon = star(corners, seed)
    turned = polygon[::-1] if reverse else polygon
    (triangles,) = cut_polygons(turned[np.newaxis])
    assert triangles.shape == (corners - 2, 3)
    areas = areas_of(turned, triangles) * (-1 if reverse else 1)
    assert areas.min() > -1e-12
    assert areas.sum() == pytest.approx(area_of(polygon))
    assert edges_of(triangles) == sorted((k, (k + 1) % corners) for k in range(corners))


def test_a_comb_is_covered_once() -> None:
    polygon = comb(12)
    (triangles,) = cut_polygons(polygon[np.newaxis])
    assert areas_of(polygon, triangles).min() > -1e-12
    assert areas_of(polygon, triangles).sum() == pytest.approx(area_of(polygon))


def test_a_polygon_in_space_is_cut_in_its_plane() -> None:
    flat = star(9, 5)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    there = np.column_stack([flat, np.full(9, 7.0)]) @ turn.T * 1000
    np.testing.assert_array_equal(
        np.sort(cut_polygons(there[np.newaxis]), axis=None), np.sort(cut_polygons(flat[np.newaxis]), axis=None)
    )
    (triangles,) = cut_polygons(there[np.newaxis])
    assert areas_of(flat, triangles).sum() == pytest.approx(area_of(flat))
    assert areas_of(flat, triangles).min() > -1e-12


def test_corners_on_a_straight_side_stay_corners() -> None:
    """A neighbour may end there: without them there would be a crack."""
    square = np.array([[0, 0], [1, 0], [2, 0], [2, 2], [1, 2], [0, 2], [0, 1]], np.float64)
    (triangles,) = cut_polygons(square[np.newaxis])
    assert edges_of(triangles) == sorted((k, (k + 1) % 7) for k in range(7))
    assert areas_of(square, triangles).min() > 0


@pytest.mark.parametrize("points", [np.zeros((6, 3)), np.eye(6)[:, :3], star(7, 1)[[0, 3, 1, 5, 2, 6, 4]]])
def test_polygons_without_area_or_that_cross_themselves_are_still_whole(points: Floats) -> None:
    (triangles,) = cut_polygons(points[np.newaxis])
    assert edges_of(triangles) == sorted((k, (k + 1) % len(points)) for k in range(len(points)))


def test_faces_keep_their_order_and_triangles_and_quads_stay() -> None:
    points = np.array([[0, 0], [1, 0], [2, 0], [2, 1], [1, 2], [0, 1]], np.float64)
    counts, corners = np.array([3, 6, 4]), np.array([0, 1, 5, 0, 1, 2, 3, 4, 5, 1, 2, 3, 5])
    places, faces = cut_faces(points, counts, corners)
    assert faces.tolist() == [0, 1, 1, 1, 1, 2]
    assert places[0].tolist() == [0, 1, 2, -1]
    assert places[-1].tolist() == [9, 10, 11, 12]
    assert set(places[1:5, :3].ravel().tolist()) == set(range(3, 9))
    assert (places[1:5, 3] == -1).all()


@pytest.mark.long
def test_what_would_take_long_is_refused() -> None:
    round_ = np.linspace(0, 2 * np.pi, 5000, endpoint=False)
    disc = np.stack([np.cos(round_), np.sin(round_)], axis=-1)
    assert cut_polygons(disc[np.newaxis]).shape == (1, 4998, 3)
    with pytest.raises(FormatError, match="at most 1,000 corners, got one of 5,000"):
        cut_polygons(star(5000, 0)[np.newaxis])
    stars = np.concatenate([star(900, 0), star(800, 0)])
    counts = np.array([900, 800] * 9)
    with pytest.raises(FormatError, match="expected fewer faces that are not convex, or with fewer corners"):
        cut_faces(stars, counts, np.tile(np.arange(1700), 9))


def test_a_list_of_faces_is_refused_by_what_is_wrong_with_it() -> None:
    points = np.eye(5)[:, :3]
    assert len(Mesh.of(points, [[0, 1, 2, 3, 4]], polygons=True).corners) == 3
    with pytest.raises(InputError, match="3 or 4 corners, got others; remesh=True takes more"):
        Mesh.of(points, [[0, 1, 2, 3, 4]])
    with pytest.raises(InputError, match="3 corners or more"):
        Mesh.of(points, [[0, 1]], polygons=True)
    with pytest.raises(InputError, match="outside 0 to 4"):
        Mesh.of(points, [[0, 1, 2, 3, 5]], polygons=True)
