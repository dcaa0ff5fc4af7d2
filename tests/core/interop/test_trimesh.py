"""Surfaces as trimesh's meshes, and meshes that are grids."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

import lodestream as ls
from tests.core.surfaces import terrain, torus


def as_sets(points: Any) -> set[tuple[float, ...]]:
    return set(map(tuple, np.asarray(points, np.float64).reshape(-1, 3).tolist()))


def test_a_torus_is_watertight_and_comes_back() -> None:
    surface = ls.Surface(torus(24, 32), (True, True), metadata={"name": "ring", "unit": "mm"})
    mesh = surface.to_trimesh()
    assert isinstance(mesh, trimesh.Trimesh)
    assert mesh.is_watertight
    assert mesh.euler_number == 0
    assert mesh.metadata["name"] == "ring"
    back = ls.Surface.from_trimesh(mesh)
    assert back.closed == (True, True)
    assert sorted(back.shape) == [24, 32]
    assert as_sets(back.points) == as_sets(surface.points)
    assert back.metadata["unit"] == "mm"


def test_blocks_are_joined_and_holes_left_open() -> None:
    points = np.stack([*np.meshgrid(np.arange(9.0), np.arange(7.0)), terrain((7, 9))], axis=2)
    mask = np.ones((7, 5), np.bool_)
    mask[3, 2] = False
    surface = ls.Surface(blocks=[ls.Block(points[:, :5], mask=mask), ls.Block(points[:, 4:])])
    mesh = surface.to_trimesh()
    assert len(mesh.vertices) == 7 * 9 - 1
    assert len(mesh.faces) == 2 * (6 * 8 - 4)
    assert mesh.body_count == 1


def test_colours_normals_textures_and_other_attributes_go_where_trimesh_has_them() -> None:
    shape = (6, 7)
    rng = np.random.default_rng(3)
    color = rng.integers(0, 255, (*shape, 4)).astype("u1")
    normal = rng.normal(size=(*shape, 3))
    normal /= np.linalg.norm(normal, axis=2)[..., None]
    surface = ls.Surface(
        terrain(shape), attributes={"color": color, "normal": normal, "n": np.arange(42.0).reshape(shape)}
    )
    mesh: Any = surface.to_trimesh()
    assert np.array_equal(mesh.visual.vertex_colors, color.reshape(-1, 4))
    assert np.allclose(mesh.vertex_normals, normal.reshape(-1, 3))
    assert mesh.vertex_attributes["n"].tolist() == list(range(42))
    back = ls.Surface.from_trimesh(mesh)
    order = back.attributes["n"].astype(int)
    assert np.array_equal(back.attributes["color"], color.reshape(-1, 4)[order])
    assert np.allclose(back.attributes["normal"], normal.reshape(-1, 3)[order])
    uv = rng.random((*shape, 2))
    textured: Any = ls.Surface(terrain(shape), attributes={"uv": uv}).to_trimesh()
    assert np.array_equal(textured.visual.uv, uv.reshape(-1, 2))
    assert set(ls.Surface.from_trimesh(textured).attributes) == {"uv"}


def test_normals_that_follow_from_the_points_are_no_attribute() -> None:
    mesh = ls.Surface(torus(8, 9), (True, True)).to_trimesh()
    assert mesh.face_normals.shape == (144, 3)
    assert ls.Surface.from_trimesh(mesh).attributes == {}


def test_a_mesh_in_any_order_is_recognised() -> None:
    mesh = ls.Surface(terrain((9, 12))).to_trimesh()
    rng = np.random.default_rng(1)
    order = rng.permutation(len(mesh.vertices))
    faces = np.argsort(order)[mesh.faces][rng.permutation(len(mesh.faces))]
    shuffled = trimesh.Trimesh(mesh.vertices[order], faces, process=False)
    back = ls.Surface.from_trimesh(shuffled)
    assert sorted(back.shape) == [9, 12]
    assert as_sets(back.points) == as_sets(mesh.vertices)


def test_what_is_no_grid_is_refused() -> None:
    with pytest.raises(ls.FormatError):
        ls.Surface.from_trimesh(trimesh.creation.icosphere(subdivisions=3))
    with pytest.raises(ls.FormatError, match="no face"):
        ls.Surface.from_trimesh(trimesh.Trimesh(np.zeros((3, 3))))
    with pytest.raises(ls.InputError, match="expected a mesh of trimesh, got int"):
        ls.Surface.from_trimesh(3)  # type: ignore[arg-type]
    with pytest.raises(ls.FormatError, match="a curve"):
        ls.Surface(np.zeros((5, 1, 3)) + np.arange(5.0)[:, None, None]).to_trimesh()
