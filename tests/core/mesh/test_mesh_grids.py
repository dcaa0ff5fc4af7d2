"""Grids from connectivity: whatever the order of vertices and faces, the same surface or a true refusal."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from lodestream.errors import FormatError
from lodestream.mesh import Mesh
from lodestream.mesh.recognise import recognise
from lodestream.surface import Surface

from .meshes import assert_same_faces, collapse, cut_in_two, drawn, grid_faces, mesh_of, scrambled

CLOSED = [(False, False), (True, False), (False, True), (True, True)]
SEEDS = st.integers(0, 2**32 - 1)


def surface_of(mesh: Mesh) -> Surface:
    return recognise(mesh).surface()


def turned(shape: tuple[int, int], closed: tuple[bool, bool]) -> set[tuple[tuple[int, int], tuple[bool, bool]]]:
    return {(shape, closed), (shape[::-1], closed[::-1])}


@settings(deadline=None)
@given(rows=st.integers(3, 9), columns=st.integers(3, 9), closed=st.sampled_from(CLOSED), seed=SEEDS)
def test_any_order_of_vertices_and_faces(rows: int, columns: int, closed: tuple[bool, bool], seed: int) -> None:
    rng = np.random.default_rng(seed)
    faces = scrambled(grid_faces(rows, columns, closed), rows * columns, rng)
    surface = surface_of(mesh_of(faces, rows * columns, rng))
    assert (surface.shape, surface.closed) in turned((rows, columns), closed)
    assert_same_faces(surface, faces)


@settings(deadline=None)
@given(
    rows=st.integers(3, 9),
    columns=st.integers(3, 9),
    closed=st.sampled_from(CLOSED),
    diagonal=st.sampled_from(["main", "anti"]),
    seed=SEEDS,
)
def test_quads_cut_in_two(rows: int, columns: int, closed: tuple[bool, bool], diagonal: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    faces = scrambled(cut_in_two(grid_faces(rows, columns, closed), diagonal), rows * columns, rng)
    surface = surface_of(mesh_of(faces, rows * columns, rng))
    assert_same_faces(surface, faces)
    assert ", from triangles; " in surface.metadata["recognised"]
    if not any(closed):  # else several diagonals may fit
        assert surface.shape in ((rows, columns), (columns, rows))


@settings(deadline=None)
@given(
    rows=st.integers(3, 8),
    columns=st.integers(3, 8),
    closed=st.booleans(),
    poles=st.sampled_from([(True, False), (False, True), (True, True)]),
    cut=st.sampled_from(["", "main", "anti"]),
    seed=SEEDS,
)
def test_poles(rows: int, columns: int, closed: bool, poles: tuple[bool, bool], cut: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    faces = grid_faces(rows, columns, (False, closed))
    if poles[0]:
        faces = collapse(faces, range(columns), 0)
    if poles[1]:
        faces = collapse(faces, range((rows - 1) * columns, rows * columns), rows * columns - 1)
    faces = scrambled(cut_in_two(faces, cut) if cut else faces, rows * columns, rng)
    used = sorted({corner for face in faces for corner in face})
    numbers = {vertex: number for number, vertex in enumerate(used)}
    faces = [[numbers[corner] for corner in face] for face in faces]
    surface = surface_of(mesh_of(faces, len(used), rng))
    assert_same_faces(surface, faces)


@pytest.mark.parametrize("cut", ["", "main", "anti"])
@pytest.mark.parametrize(("closed", "kind"), [(True, "sphere, 7 x 8"), (False, "grid, 7 x 8")])
def test_a_sphere_and_a_wedge_of_it(cut: str, closed: bool, kind: str) -> None:
    faces = collapse(collapse(grid_faces(7, 8, (False, closed)), range(8), 7), range(48, 56), 48)
    faces = [[corner - 7 for corner in face] for face in faces]
    surface = surface_of(mesh_of(cut_in_two(faces, cut) if cut else faces, 42))
    assert surface.closed == (False, closed)
    assert surface.metadata["recognised"].startswith(kind)
    assert "; 42 vertices; 2 poles" in surface.metadata["recognised"]
    assert surface.metadata["poles"] == [
        {"block": 0, "side": "first_row", "kind": "fan"},
        {"block": 0, "side": "last_row", "kind": "fan"},
    ]
    assert (surface.points[0] == surface.points[0, 0]).all()
    assert_same_faces(surface, cut_in_two(faces, cut) if cut else faces)


@pytest.mark.parametrize("count", [4, 5, 6, 12])
@pytest.mark.parametrize("closed", [True, False])
def test_a_fan_alone(count: int, closed: bool) -> None:
    faces = [[0, k + 1, (k + 1) % (count + (not closed)) + 1] for k in range(count)]
    vertices = 1 + count + (not closed)
    surface = surface_of(mesh_of(scrambled(faces, vertices, np.random.default_rng(0)), vertices))
    assert sorted(surface.shape) == [2, vertices - 1]
    assert sum(surface.closed) == closed


def test_quads_that_name_the_pole_twice_come_back_so() -> None:
    faces = [[max(corner - 7, 0) for corner in face] for face in grid_faces(5, 8, (False, True))]
    surface = surface_of(mesh_of(faces, 33))
    assert surface.metadata["poles"] == [{"block": 0, "side": "first_row", "kind": "degenerate"}]
    mesh = drawn(surface)
    assert len(mesh.triangles) == 0
    assert {tuple(sorted(face)) for face in mesh.attributes["number"][mesh.quads].tolist()} == {
        tuple(sorted(face)) for face in faces
    }


@settings(deadline=None)
@given(
    rows=st.integers(4, 9),
    columns=st.integers(4, 9),
    closed=st.sampled_from(CLOSED),
    cut=st.sampled_from(["", "main"]),
    holes=st.integers(1, 6),
    seed=SEEDS,
)
def test_faces_that_are_missing(
    rows: int, columns: int, closed: tuple[bool, bool], cut: str, holes: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    faces = grid_faces(rows, columns, closed)
    faces = [faces[index] for index in rng.permutation(len(faces))[holes:]]
    faces = scrambled(cut_in_two(faces, cut) if cut else faces, rows * columns, rng)
    mesh = mesh_of(faces, rows * columns, rng)
    try:
        surface = surface_of(mesh)
    except FormatError as refusal:
        event(str(refusal).split(" got ")[0])  # what is left hangs together by vertices, or is a few quads
        return
    assert_same_faces(surface, faces)


def test_holes_and_single_faces_that_are_missing_in_a_grid() -> None:
    rng = np.random.default_rng(3)
    faces = [face for face in grid_faces(9, 11) if 38 not in face and face[0] != 60]
    surface = surface_of(mesh_of(scrambled(faces, 99, rng, flips=False), 99, rng))
    assert surface.shape in ((9, 11), (11, 9))
    assert surface.mask is not None
    assert int((~surface.mask).sum()) == 1
    assert "98 vertices; 1 hole" in surface.metadata["recognised"]
    assert len(drawn(surface).quads) == len(faces) == 75


@pytest.mark.parametrize("closed", CLOSED)
@pytest.mark.parametrize("cut", ["", "main", "anti"])
def test_row_order_is_kept(closed: tuple[bool, bool], cut: str) -> None:
    faces = grid_faces(7, 5, closed)
    surface = surface_of(mesh_of(cut_in_two(faces, cut) if cut else faces, 35))
    assert (surface.shape, surface.closed) == ((7, 5), closed)
    np.testing.assert_array_equal(surface.attributes["number"], np.arange(35).reshape(7, 5))


@settings(deadline=None)
@given(rows=st.integers(3, 7), columns=st.integers(3, 7), closed=st.sampled_from(CLOSED), seed=SEEDS)
def test_a_surface_written_and_read_again_keeps_its_grid(
    rows: int, columns: int, closed: tuple[bool, bool], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    first = surface_of(mesh_of(scrambled(grid_faces(rows, columns, closed), rows * columns, rng), rows * columns, rng))
    mesh = drawn(first)
    again = surface_of(Mesh.of(mesh.vertices, mesh.quads))
    assert again.closed == first.closed
    np.testing.assert_array_equal(again.points, first.points)
    assert again.metadata.get("faces", {}) == first.metadata.get("faces", {})


def test_geometry_decides_between_diagonals() -> None:
    u, v = (2 * np.pi * index / 12 for index in np.indices((12, 12)))
    points = np.stack([(3 + np.cos(v)) * np.cos(u), (3 + np.cos(v)) * np.sin(u), np.sin(v)], axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(5)
    order = rng.permutation(144)
    faces = [[order[corner] for corner in face] for face in cut_in_two(grid_faces(12, 12, (True, True)), "anti")]
    places = np.empty_like(points)
    places[order] = points
    surface = surface_of(Mesh.of(places, faces))
    assert surface.metadata["recognised"] == (
        "torus, 12 x 12, from triangles; 144 vertices; 3 diagonals fit, the longest chosen"
    )
    steps = np.linalg.norm(surface.points - np.roll(surface.points, 1, axis=0), axis=-1)
    across = np.linalg.norm(surface.points - np.roll(surface.points, 1, axis=1), axis=-1)
    assert min(steps.std(), across.std()) < 1e-12  # one axis runs round the tube, where all edges are as long
    assert max(steps.max(), across.max()) < 2.08


@pytest.mark.parametrize("shift", [1, 2, 4])
def test_a_torus_that_winds_is_cut_open(shift: int) -> None:
    faces = grid_faces(9, 10, (True, True), shift)
    surface = surface_of(mesh_of(faces, 90))
    assert "cut open" in surface.metadata["recognised"]
    assert_same_faces(surface, faces)


@pytest.mark.parametrize("rows", [4, 5])
def test_surfaces_of_one_side_are_refused(rows: int) -> None:
    band = grid_faces(rows, 7)
    columns = 7
    band += [  # the last row is joined to the first, reversed
        [(rows - 1) * columns + c, (rows - 1) * columns + c + 1, columns - 2 - c, columns - 1 - c] for c in range(6)
    ]
    with pytest.raises(FormatError, match=r"two sides.*face \d+.*cut it open"):
        surface_of(mesh_of(band, rows * columns))


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        (
            [[0, 1, 2, 3], [1, 0, 4, 5], [0, 1, 6, 7]],
            r"got 3 at the edge from vertex 1 to 2: face 1, face 2 and face 3",
        ),
        ([[0, 1, 0, 2]], r"name each vertex once .* got face 1: remove"),
        ([[0, 0, 1]], r"name each vertex once .* got face 1: remove"),
        ([[0, 1, 2, 3], [2, 1, 4], [2, 4, 5]], r"triangles beside quads, .*: face 3; make quads of them"),
        (
            [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1], [1, 2, 5]],
            r"round poles: 4 are round vertex 1 of face 1, .* round 1 vertices",
        ),
        ([], "this mesh has no faces: save it with them"),
    ],
)
def test_meshes_that_are_no_grid_are_refused_with_a_reason(faces: list[list[int]], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        surface_of(mesh_of(faces, 8))


def test_a_soup_of_quads_is_refused() -> None:
    faces = [[4 * k, 4 * k + 1, 4 * k + 2, 4 * k + 3] for k in range(100)]
    with pytest.raises(FormatError, match=r"into 100 connected pieces, of 100 faces in all, .*: weld vertices"):
        surface_of(mesh_of(faces, 400))


def test_several_pieces_are_several_blocks_and_parts() -> None:
    faces = grid_faces(4, 5) + [[corner + 20 for corner in face] for face in grid_faces(3, 6, (False, True))]
    points = np.random.default_rng(0).random((20, 3))
    points = np.concatenate([points, points[:18]])  # at the same places, and nothing is joined
    surface = surface_of(Mesh.of(points, faces, {"number": np.arange(38)}))
    assert [block.shape for block in surface.blocks] == [(4, 5), (3, 6)]
    assert surface.metadata["recognised"] == "2 blocks, 3 x 6 to 4 x 5; 38 vertices"
    assert_same_faces(surface, faces)


def test_vertices_without_a_face_are_left_out_and_counted() -> None:
    surface = surface_of(mesh_of(grid_faces(3, 4), 14))
    assert surface.metadata["recognised"] == "grid, 3 x 4; 12 vertices; 2 vertices without a face left out"


def test_diagonals_that_change_from_cell_to_cell_are_kept() -> None:
    rng = np.random.default_rng(1)
    quads = grid_faces(9, 8)
    faces = [half for quad in quads for half in cut_in_two([quad], "main" if rng.integers(3) else "anti")]
    surface = surface_of(mesh_of(faces, 72, rng))
    assert surface.shape == (9, 8)
    assert_same_faces(surface, faces)
