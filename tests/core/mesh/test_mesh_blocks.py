"""Meshes cut into blocks: the same surface, welded where it was cut and nowhere else."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lodestream.errors import FormatError
from lodestream.mesh import Mesh, weld
from lodestream.mesh.recognise import recognise
from lodestream.surface import Block, Surface

from .meshes import FaceList, assert_same_faces, collapse, cut_in_two, drawn, grid_faces, mesh_of, scrambled, star

SEEDS = st.integers(0, 2**32 - 1)


def cube(size: int) -> tuple[int, FaceList]:
    """Vertices and quads of the surface of a cube."""
    number: dict[tuple[int, ...], int] = {}
    faces = []
    for axis in range(3):
        for level in (0, size):
            for i in range(size):
                for j in range(size):
                    face = []
                    for a, b in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)):
                        place = [a, b]
                        place.insert(axis, level)
                        face.append(number.setdefault(tuple(place), len(number)))
                    faces.append(face)
    return len(number), faces


@settings(deadline=None)
@given(arms=st.sampled_from([3, 5, 6, 7]), size=st.integers(3, 6), seed=SEEDS)
def test_patches_round_a_vertex(arms: int, size: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = star(arms, size)
    faces = scrambled(faces, vertices, rng)
    surface = recognise(mesh_of(faces, vertices, rng)).surface()
    assert [block.shape for block in surface.blocks] == [(size + 1, size + 1)] * arms
    assert surface.metadata["recognised"].startswith(
        f"{arms} blocks, {size + 1} x {size + 1} each; {vertices} vertices; cut at 1 irregular vertex"
    )
    assert_same_faces(surface, faces)


@pytest.mark.parametrize("seed", range(5))
def test_a_cube_is_six_blocks(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = cube(5)
    faces = scrambled(faces, vertices, rng)
    surface = recognise(mesh_of(faces, vertices, rng)).surface()
    assert [block.shape for block in surface.blocks] == [(6, 6)] * 6
    assert_same_faces(surface, faces)


@settings(deadline=None)
@given(size=st.integers(4, 7), holes=st.integers(0, 3), seed=SEEDS)
def test_cubes_with_faces_missing(size: int, holes: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = cube(size)
    faces = scrambled([faces[index] for index in rng.permutation(len(faces))[holes:]], vertices, rng)
    try:
        surface = recognise(mesh_of(faces, vertices, rng)).surface()
    except FormatError as refusal:
        assert "irregular vertices" in str(refusal)  # noqa: PT017 - a refusal is one of two good answers
        return
    assert_same_faces(surface, faces)


def test_a_grid_without_its_corners_is_one_block_with_holes() -> None:
    rng = np.random.default_rng(2)
    faces = [face for face in grid_faces(21, 21) if not (face[0] // 21 < 7 and face[0] % 21 < 7)]
    faces = [face for face in faces if not (face[0] // 21 >= 11 and face[0] % 21 >= 9)]
    faces = scrambled(faces, 441, rng)
    surface = recognise(mesh_of(faces, 441, rng)).surface()
    assert surface.shape == (21, 21)
    assert surface.mask is not None
    assert_same_faces(surface, faces)


def test_a_long_bent_strip_is_cut() -> None:
    # An L of two arms 3 wide and 60 long: too empty for one grid with holes.
    faces = [face for face in grid_faces(61, 61) if face[0] // 61 < 3 or face[0] % 61 < 3]
    surface = recognise(mesh_of(faces, 3721)).surface()
    assert sorted(block.shape for block in surface.blocks) == [(4, 4), (4, 58), (58, 4)]
    assert_same_faces(surface, faces)


def test_a_fan_over_several_blocks() -> None:
    # A cap over a cube without its top: the quads of the walls end at fans round one vertex.
    size = 4
    vertices, faces = cube(size)
    on_top = set(range(size * size * 5, size * size * 6))  # the faces of the last side
    walls = [face for index, face in enumerate(faces) if index not in on_top]
    cap = [[b, a, vertices] for a, b in _border_edges(walls)]
    mesh = mesh_of(walls + cap, vertices + 1)
    surface = recognise(mesh).surface()
    fans = [pole for pole in surface.metadata["poles"] if pole["kind"] == "fan"]
    assert len(fans) > 1
    assert "1 pole;" in surface.metadata["recognised"]
    assert_same_faces(surface, walls + cap)


def _border_edges(faces: FaceList) -> list[tuple[int, int]]:
    count = Counter(frozenset((face[k - 1], face[k])) for face in faces for k in range(4))
    return [(face[k - 1], face[k]) for face in faces for k in range(4) if count[frozenset((face[k - 1], face[k]))] == 1]


def test_coincident_vertices_of_one_grid_stay_apart() -> None:
    points = np.random.default_rng(1).random((7, 6, 3))
    points[:, 5] = points[:, 0]  # closed to the eye, open to the faces
    surface = recognise(Mesh.of(points.reshape(-1, 3), grid_faces(7, 6))).surface()
    assert surface.shape == (7, 6)
    assert len(drawn(surface).vertices) == 42


def test_points_of_two_blocks_are_welded_whatever_their_direction() -> None:
    rng = np.random.default_rng(0)
    left, right = rng.random((5, 7, 3)), rng.random((7, 6, 3))
    right[0, :5] = left[::-1, 6]
    welded = weld(Surface(blocks=[Block(left), Block(right)]))
    assert len(welded.source) == 35 + 42 - 5
    assert len(welded.quads) == 4 * 6 + 6 * 5
    apart = weld(Surface(blocks=[Block(left), Block(right)], metadata={"faces": [{}, {"part": 1}]}))
    assert len(apart.source) == 35 + 42
    not_joined = weld(Surface(blocks=[Block(left), Block(right)], metadata={"faces": {"joined": False}}))
    assert len(not_joined.source) == 35 + 42


def test_attributes_hold_vertices_apart_that_are_joined() -> None:
    rng = np.random.default_rng(0)
    left, right = rng.random((4, 4, 3)), rng.random((4, 4, 3))
    right[:, 0] = left[:, 3]
    colours = [np.zeros((4, 4, 3), np.uint8), np.full((4, 4, 3), 9, np.uint8)]
    colours[1][0, 0] = 0
    blocks = [
        Block(points, attributes={"color": colour}) for points, colour in zip((left, right), colours, strict=True)
    ]
    welded = weld(Surface(blocks=blocks))
    assert len(welded.source) == 31  # one corner has the same colour
    assert np.count_nonzero(welded.joined != np.arange(31)) == 3
    assert len(np.unique(welded.joined[welded.quads])) == 28


def test_a_collapsed_side_of_a_block_becomes_triangles() -> None:
    points = np.random.default_rng(0).random((4, 5, 3))
    points[0] = points[0, 0]
    other = points + 5
    welded = drawn(Surface(blocks=[Block(points), Block(other)]))
    assert (len(welded.quads), len(welded.triangles)) == (16, 8)
    single = drawn(Surface(points))  # repeated vertices stay as they are
    assert (len(single.quads), len(single.triangles), len(single.vertices)) == (12, 0, 20)


def test_cells_at_holes_have_no_face() -> None:
    points = np.random.default_rng(0).random((5, 6, 3))
    points[2, 3, 1] = np.nan
    mesh = drawn(Surface(points))
    assert (len(mesh.vertices), len(mesh.quads)) == (29, 16)
    assert np.isfinite(mesh.vertices).all()


def test_heights_and_planar_points_have_places() -> None:
    heights = np.arange(6, dtype=np.int16).reshape(2, 3)
    mesh = drawn(Surface(heights))
    assert mesh.vertices.tolist() == [[0, 0, 0], [1, 0, 1], [2, 0, 2], [0, 1, 3], [1, 1, 4], [2, 1, 5]]
    placed = drawn(Surface(heights, metadata={"geotransform": [100.0, 10.0, 1.0, 500.0, 2.0, -20.0]}))
    assert placed.vertices[3].tolist() == [106.5, 471.0, 3.0]
    flat = drawn(Surface(np.ones((2, 2, 2), np.float32)))
    assert flat.vertices.tolist() == [[1, 1, 0]] * 4


def test_channels_beyond_the_third_are_attributes() -> None:
    points = np.random.default_rng(0).random((3, 3, 5))
    mesh = drawn(Surface(points))
    assert mesh.vertices.shape == (9, 3)
    np.testing.assert_array_equal(mesh.attributes["attribute_1"], points[..., 4].reshape(-1))


@pytest.mark.parametrize(
    "metadata",
    [
        {"faces": [{}]},
        {"faces": {"diagonal": "both"}},
        {"faces": "triangles"},
        {"poles": [{"block": 7, "side": "first_row", "kind": "fan"}]},
        {"poles": [{"block": 0, "side": "top", "kind": "fan"}]},
        {"poles": 3},
        {"faces": {"left_out": {"shape": [2, 2], "cells": "!"}}},
    ],
)
def test_metadata_that_say_nothing_sensible_about_meshes_are_refused(metadata: dict[str, object]) -> None:
    blocks = [Block(np.random.default_rng(0).random((3, 3, 3))) for _ in range(2)]
    with pytest.raises(ValueError, match=r"expected .* in the metadata"):
        drawn(Surface(blocks=blocks, metadata=metadata))


@settings(deadline=None)
@given(rows=st.integers(3, 8), columns=st.integers(3, 8), seed=SEEDS)
def test_triangles_in_pairs_of_a_mesh_that_is_cut(rows: int, columns: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, quads = cube(4)
    order = rng.permutation(len(quads)).tolist()
    faces = cut_in_two([quads[index] for index in order], "main" if rows < columns else "anti")
    surface = recognise(mesh_of(faces, vertices, rng)).surface()
    assert len(surface.blocks) == 6
    assert_same_faces(surface, faces)


def test_a_pole_on_a_block_of_many() -> None:
    vertices, faces = star(5, 4)
    sphere = collapse(grid_faces(5, 6, (False, True)), range(6), 0)
    faces += [[corner + vertices for corner in face] for face in sphere]
    surface = recognise(mesh_of(faces, vertices + 30)).surface()
    assert len(surface.blocks) == 6
    assert surface.metadata["poles"] == [{"block": 5, "side": "first_row", "kind": "fan"}]
    assert_same_faces(surface, faces)


def test_a_window_of_a_sphere_has_no_pole() -> None:
    faces = collapse(grid_faces(6, 8, (False, True)), range(8), 0)
    numbers = {vertex: index for index, vertex in enumerate(sorted({corner for face in faces for corner in face}))}
    surface = recognise(mesh_of([[numbers[corner] for corner in face] for face in faces], 41)).surface()
    window = Surface(surface.points[2:, :5], metadata=surface.metadata)
    mesh = drawn(window)
    assert (len(mesh.vertices), len(mesh.quads), len(mesh.triangles)) == (20, 12, 0)


def test_faces_of_many_corners_are_no_mesh() -> None:
    with pytest.raises(ValueError, match="faces of 3 or 4 corners, got others"):
        Mesh.of(np.zeros((5, 3)), [[0, 1, 2, 3, 4]])
    with pytest.raises(ValueError, match="outside 0 to 4"):
        Mesh.of(np.zeros((5, 3)), [[0, 1, 2, 5]])
    with pytest.raises(ValueError, match="vertices of shape"):
        Mesh.of(np.zeros(5), [[0, 1, 2, 3]])
