"""Attributes of corners: kept at each corner of each face, as seams where they differ, or left out and said so."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.mesh import CornerAttribute, Mesh, weld
from lodestream.mesh.recognise import recognise
from lodestream.surface import Surface

from .meshes import FaceList, collapse, cut_in_two, drawn, grid_faces

SEEDS = st.integers(0, 2**32 - 1)


def sphere(rows: int, columns: int, cut: str) -> tuple[FaceList, list[list[tuple[float, float]]]]:
    """Faces of a sphere as programs write them: closed by its vertices, with a seam and tips by its texture."""
    grid = grid_faces(rows, columns + 1)  # with the seam open
    wrap = [r * columns + c % columns for r in range(rows) for c in range(columns + 1)]
    last = (rows - 1) * columns
    faces: FaceList = []
    texture: list[list[tuple[float, float]]] = []
    for whole in grid:
        for half in cut_in_two([whole], cut) if cut else [whole]:
            place: list[tuple[float, int]] = [(corner % (columns + 1), corner // (columns + 1)) for corner in half]
            face = [wrap[corner] for corner in half]
            for pole, row in ((0, 0), (last, rows - 1)):
                at = [k for k in range(len(face)) if place[k][1] == row]
                if len(at) == 2:
                    middle = sum(place[k][0] for k in at) / 2
                    place[at[0]] = (middle, row)
                    face[at[0]] = pole
                    del place[at[1]], face[at[1]]
                elif at:
                    face[at[0]] = pole
                    place[at[0]] = (min(c for c, _ in place) + 0.5, row)
            if len(set(face)) > 2:
                faces.append(face)
                texture.append([(c / columns, r / (rows - 1)) for c, r in place])
    used = sorted({corner for face in faces for corner in face})
    number = {vertex: index for index, vertex in enumerate(used)}
    return [[number[corner] for corner in face] for face in faces], texture


def with_texture(faces: FaceList, texture: list[list[tuple[Any, ...]]], name: str = "uv") -> Mesh:
    vertices = 1 + max(map(max, faces))
    values = np.array([place for face in texture for place in face], np.float64)
    rows = np.full((len(faces), 4), -1, np.int32)
    start = 0
    for index, face in enumerate(faces):
        rows[index, : len(face)] = range(start, start + len(face))
        start += len(face)
    mesh = Mesh.of(np.random.default_rng(0).random((vertices, 3)), faces, {"number": np.arange(vertices)})
    return Mesh(mesh.vertices, mesh.corners, mesh.attributes, {name: CornerAttribute(values, rows)})


def corners_of(faces: FaceList, numbers: NDArray[Any], values: NDArray[Any]) -> Counter[Any]:
    """Faces with what each of their corners has, whatever their sense and first corner."""
    result: Counter[Any] = Counter()
    for face in faces:
        corners = [(int(numbers[corner]), *np.atleast_1d(values[corner]).tolist()) for corner in face]
        turns = [tuple(turned[k:] + turned[:k]) for turned in (corners, corners[::-1]) for k in range(len(face))]
        result[min(turns)] += 1
    return result


def assert_same_corners(
    surface: Surface, faces: FaceList, texture: list[list[tuple[Any, ...]]], name: str = "uv"
) -> None:
    mesh = drawn(surface)
    out = corners_of([*mesh.quads.tolist(), *mesh.triangles.tolist()], mesh.attributes["number"], mesh.attributes[name])
    expected: Counter[Any] = Counter()
    for face, places in zip(faces, texture, strict=True):
        expected += corners_of([list(range(len(face)))], np.array(face), np.array(places))
    assert out == expected
    # By their places alone, vertices are as many as in the file.
    assert len(set(weld(surface).joined.tolist())) == 1 + max(map(max, faces))


@pytest.mark.parametrize("cut", ["", "main", "anti"])
@pytest.mark.parametrize("seed", range(4))
def test_a_sphere_with_a_seam_and_a_tip_for_each_triangle(cut: str, seed: int) -> None:
    faces, texture = sphere(6, 8, cut)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(faces)).tolist() if seed else range(len(faces))
    faces, texture = [faces[index] for index in order], [texture[index] for index in order]
    surface = recognise(with_texture(faces, texture)).surface()
    assert surface.shape in ((6, 9), (9, 6))
    assert surface.closed == (False, False)
    assert "; 2 poles; seam in uv" in surface.metadata["recognised"]
    assert_same_corners(surface, faces, texture)


@settings(deadline=None)
@given(rows=st.integers(3, 7), columns=st.integers(3, 7), closed=st.booleans(), at=st.integers(0, 30), seed=SEEDS)
def test_seams_along_grid_lines(rows: int, columns: int, closed: bool, at: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    faces = grid_faces(rows, columns, (closed, True))
    at %= columns
    texture: list[list[tuple[Any, ...]]] = [
        [
            (corner // columns, (corner % columns - at) % columns or (columns if k in (1, 2) else 0))
            for k, corner in enumerate(face)
        ]
        for face in faces
    ]
    order = rng.permutation(len(faces)).tolist()
    faces, texture = [faces[index] for index in order], [texture[index] for index in order]
    surface = recognise(with_texture(faces, texture)).surface()
    assert len(surface.blocks) == 1
    assert_same_corners(surface, faces, texture)


def test_equal_values_with_numbers_of_their_own_are_no_seam() -> None:
    faces = grid_faces(4, 5, (True, True))
    texture: list[list[tuple[Any, ...]]] = [[(corner, 2.5) for corner in face] for face in faces]
    surface = recognise(with_texture(faces, texture)).surface()
    assert surface.closed == (True, True)
    assert "seam" not in surface.metadata["recognised"]
    assert surface.attributes["uv"].shape == (4, 5, 2)
    assert_same_corners(surface, faces, texture)


def test_normals_of_single_faces_are_left_out() -> None:
    faces = grid_faces(8, 9)
    texture: list[list[tuple[Any, ...]]] = [[(index, 0, 0)] * 4 for index in range(len(faces))]
    surface = recognise(with_texture(faces, texture, "normal")).surface()
    assert surface.shape == (8, 9)
    assert set(surface.attributes) == {"number"}
    assert "normal left out: different on too many faces side by side" in surface.metadata["recognised"]


def test_normals_that_differ_between_the_halves_of_quads_are_left_out() -> None:
    faces = cut_in_two(grid_faces(5, 5), "main")
    texture: list[list[tuple[Any, ...]]] = [[(index, 0, 0)] * 3 for index in range(len(faces))]
    surface = recognise(with_texture(faces, texture, "normal")).surface()
    assert surface.shape == (5, 5)
    assert "normal left out" in surface.metadata["recognised"]


def test_what_only_some_corners_have_is_left_out() -> None:
    faces = grid_faces(4, 4)
    mesh = with_texture(faces, [[(corner, 0) for corner in face] for face in faces])
    mesh.corner_attributes["uv"].corners[3, 2] = -1
    surface = recognise(mesh).surface()
    assert "uv left out: not on all faces" in surface.metadata["recognised"]


def test_hard_edges_make_blocks() -> None:
    # Two walls that meet at an edge, along which their normals differ.
    faces = grid_faces(5, 9)
    texture: list[list[tuple[Any, ...]]] = [[(0, 0, 1) if face[0] % 9 < 4 else (1, 0, 0)] * 4 for face in faces]
    surface = recognise(with_texture(faces, texture, "normal")).surface()
    assert [block.shape for block in surface.blocks] == [(5, 5), (5, 5)]
    assert surface.metadata["recognised"] == "2 blocks, 5 x 5 each; 45 vertices; seam in normal"
    assert_same_corners(surface, faces, texture, "normal")


def test_a_seam_that_ends_amid_the_surface_cuts_it() -> None:
    faces = grid_faces(9, 9)
    texture: list[list[tuple[Any, ...]]] = [
        [
            (corner, 1 if face[0] % 9 == 4 and face[0] // 9 < 4 and corner % 9 == 4 and corner // 9 < 4 else 0)
            for corner in face
        ]
        for face in faces
    ]
    surface = recognise(with_texture(faces, texture)).surface()
    assert "seam in uv; cut at" in surface.metadata["recognised"]
    assert_same_corners(surface, faces, texture)


def test_quads_that_name_the_pole_twice_keep_both_of_its_places() -> None:
    faces = [[max(corner - 7, 0) for corner in face] for face in grid_faces(5, 8)]
    texture: list[list[tuple[Any, ...]]] = [[(corner % 8, corner // 8) for corner in face] for face in grid_faces(5, 8)]
    surface = recognise(with_texture(faces, texture)).surface()
    assert surface.shape == (5, 8)
    assert surface.metadata["poles"] == [{"block": 0, "side": "first_row", "kind": "degenerate"}]
    np.testing.assert_array_equal(surface.attributes["uv"][..., 0], np.arange(8) + np.zeros((5, 1)))
    assert_same_corners(surface, faces, texture)


def test_collapsed_sides_next_to_a_seam() -> None:
    faces = collapse(grid_faces(5, 6, (False, True)), range(6), 0)
    numbers = {vertex: index for index, vertex in enumerate(sorted({corner for face in faces for corner in face}))}
    faces = [[numbers[corner] for corner in face] for face in faces]
    texture: list[list[tuple[Any, ...]]] = [
        [(corner, index == 3) for corner in face] for index, face in enumerate(faces)
    ]
    surface = recognise(with_texture(faces, texture)).surface()
    assert_same_corners(surface, faces, texture)
