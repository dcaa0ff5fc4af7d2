from __future__ import annotations

import numpy as np
import pytest

from lodestream.remesh.closest import ClosestPoints

from . import scenes

igl = pytest.importorskip("igl")


@pytest.mark.parametrize("spread", [0.0, 1e-3, 1.0, 1e9])
def test_points_in_any_order_have_the_closest_points_that_each_alone_has(spread: float) -> None:
    vertices, faces = scenes.sphere()
    points = np.random.default_rng(0).normal(size=(500, 3)) * spread
    distances, triangles, places = ClosestPoints(vertices, faces).to(points)
    squared, elements, closest = igl.point_mesh_squared_distance(points, vertices, faces)
    np.testing.assert_array_equal(distances, np.sqrt(squared))
    np.testing.assert_array_equal(triangles, elements)
    np.testing.assert_array_equal(places, closest)


def test_edges_have_closest_points_too() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0]])
    distances, edges, places = ClosestPoints(vertices, np.array([[0, 1], [1, 2]])).to(
        np.array([[2.0, 0.5, 0], [0.5, -1, 0]])
    )
    assert distances.tolist() == [1, 1]
    assert edges.tolist() == [1, 0]
    assert places.tolist() == [[1, 0.5, 0], [0.5, 0, 0]]


def test_no_points_have_no_closest_points() -> None:
    distances, triangles, places = ClosestPoints(*scenes.sphere()).to(np.empty((0, 3)))
    assert distances.shape == triangles.shape == (0,)
    assert places.shape == (0, 3)
