"""Surfaces as meshes: OBJ both ways, PLY out, and what other libraries read in them."""

from __future__ import annotations

import io
import tempfile
from pathlib import Path
from typing import Any

import hypothesis.extra.numpy as npst
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import formats
from lodestream.coordinates.seams import restore
from lodestream.errors import FormatError, FormatWarning, InputError
from lodestream.surface import Surface

CLOSED = [(False, False), (True, False), (False, True), (True, True)]


def text(surface: Surface) -> str:
    file = io.BytesIO()
    formats.write_stream(surface, "obj", file)
    return file.getvalue().decode("ascii")


def parse(content: str | bytes) -> Surface:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.obj"
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return formats.read(path)


def torus(rows: int, columns: int) -> NDArray[np.float64]:
    u = np.linspace(0, 2 * np.pi, rows, endpoint=False)[:, None]
    v = np.linspace(0, 2 * np.pi, columns, endpoint=False)[None, :]
    radius = 3 + np.cos(v)
    return np.stack((radius * np.cos(u), radius * np.sin(u), np.sin(v) + 0 * u), axis=-1)


@given(
    points=npst.arrays(
        st.sampled_from((np.float32, np.float64)),
        st.tuples(st.integers(2, 8), st.integers(2, 8), st.just(3)),
        elements=st.floats(width=32, allow_nan=False, allow_infinity=False),
    ),
    closed=st.sampled_from(CLOSED),
)
def test_obj_round_trip(points: NDArray[Any], closed: tuple[bool, bool]) -> None:
    assume(all(length > 2 for length, wraps in zip(points.shape[:2], closed, strict=True) if wraps))
    surface = restore(parse(text(Surface(points, closed))))  # of points drawn at random, some repeat at the end
    assert (surface.points.shape, surface.closed) == (points.shape, closed)
    np.testing.assert_array_equal(surface.points.astype(points.dtype), points)


@given(value=st.floats(allow_nan=False, allow_infinity=False))
def test_every_float64_reads_back_from_obj(value: float) -> None:
    points = np.zeros((2, 2, 3))
    points[1, 0, 2] = value
    assert parse(text(Surface(points))).points.tobytes() == points.tobytes()


@pytest.mark.parametrize("closed", CLOSED)
@pytest.mark.parametrize("shape", [(3, 3), (3, 4), (4, 3), (5, 5), (7, 12)])
def test_closed_axes_are_found_whatever_the_order_and_sense_of_faces(
    shape: tuple[int, int], closed: tuple[bool, bool]
) -> None:
    rng = np.random.default_rng(1)
    lines = text(Surface(torus(*shape), closed)).splitlines()
    points = [line for line in lines if line.startswith("v")]
    faces = [line.split()[1:] for line in lines if line.startswith("f")]
    shuffled = []
    for index in rng.permutation(len(faces)):
        corners = np.roll(faces[index], rng.integers(4)).tolist()
        shuffled.append("f " + " ".join(corners[::-1] if rng.integers(2) else corners))
    surface = parse("\n".join([*points, *shuffled]))
    assert (surface.shape, surface.closed) == (shape, closed)


@pytest.mark.filterwarnings("ignore::lodestream.errors.FormatWarning")  # of what is left out
def test_obj_forms_of_points_and_faces() -> None:
    heights = np.arange(6.0).reshape(2, 3)
    plain = text(Surface(heights))
    first = 'mtllib ../secret.mtl\n# quads\no "grid"\nusemtl none\n'
    forms = {
        "normals": plain.replace("f 1 2 5 4", "f 1//9 2//9 5//9 4//9"),
        "texture": "vt 0 0\nvn 0 0 1\n" + plain.replace("f 1 2 5 4", "f 1/1/1 2/1/1 5/1/1 4/1/1"),
        "texture only": plain.replace("f 2 3 6 5", "f 2/1 3/1 6/1 5/1"),
        "negative": plain.replace("f 1 2 5 4", "f -6 -5 -2 -3"),
        "weights": plain.replace("v 1 1 4.0", "v 1 1 4.0 1"),
        "spaces": plain.replace("v 1 1", "  v\t1   1").replace("f 1", " f\t1"),
        "line ends": plain.replace("\n", "\r\n"),
        "comments": plain.replace("\n", " # here\n"),
        "no last line end": plain.rstrip("\n"),
        "groups": plain.replace("f 2", "s off\ng second\nf 2"),
    }
    for name, form in forms.items():
        surface = parse(first + form)
        np.testing.assert_array_equal(surface.points[:, :, 2], heights, err_msg=name)
    latin = parse(b"# K\xfcste\n" + plain.encode())
    assert latin.points.shape == (2, 3, 3)


def test_negative_indices_count_from_the_points_so_far() -> None:
    surface = parse("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf -4 -3 -1 -2\nv 0 2 0\nv 1 2 0\nf -4 -3 -1 -2\n")
    assert surface.shape == (3, 2)


def test_obj_of_more_points_than_one_block_of_text_holds() -> None:
    points = torus(400, 300)
    surface = parse(text(Surface(points, (True, True))))
    assert surface.closed == (True, True)
    np.testing.assert_array_equal(surface.points, points)


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("shape", [(5, 1, 3), (1, 5, 3)])
def test_curves_are_written_as_lines(shape: tuple[int, int, int], closed: bool) -> None:
    points = np.arange(15.0).reshape(shape)
    surface = parse(text(Surface(points, (closed, False) if shape[1] == 1 else (False, closed))))
    assert (surface.points.shape, surface.closed) == ((5, 1, 3), (closed, False))
    np.testing.assert_array_equal(surface.points.reshape(shape), points)


def test_heights_are_drawn_over_columns_and_rows_or_where_they_lie() -> None:
    heights = np.array([[7, 8, 9], [10, 11, 12]], np.int16)
    assert text(Surface(heights)).splitlines()[:4] == ["v 0 0 7", "v 1 0 8", "v 2 0 9", "v 0 1 10"]
    placed = Surface(heights, metadata={"geotransform": [100.0, 10.0, 1.0, 500.0, 2.0, -20.0]})
    assert text(placed).splitlines()[3] == "v 106.5 471.0 10"
    assert text(Surface(np.zeros((2, 2, 2), np.uint8))).splitlines()[0] == "v 0 0 0"
    with pytest.raises(InputError, match="a geotransform of six numbers"):
        text(Surface(heights, metadata={"geotransform": [1, 2]}))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", "line 4: expected faces of 3 or 4 corners, got 2 in 'f 1 2'"),
        (
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
            r"cut in two: .* some are no half of a quad: face 1 \(line 4\)",
        ),
        ("v 0 0\nv 1 0 0\n", "line 1: expected a point of 3 numbers .*, got 'v 0 0'"),
        ("v 0 0 zero\n", "line 1: expected a point of 3 numbers"),
        ("v 0 0 0 0.5\n", "line 1: expected a point of 3 numbers"),
        ("v 0 0 0\nv 0 0 0 1 1 1\n", "line 2: expected points of 3 values like those before, got 6"),
        ("v 0 0 0\nf 1 2 3 4\n", "line 2: expected the number of one of the 1 points so far, got 2"),
        ("v 0 0 0\nf 0 1 1 1\n", "line 2: expected the number of one of the 1 points so far, got 0"),
        ("v 0 0 0\nf -2 1 1 1\n", "line 2: expected the number of one of the 1 points so far, got -2"),
        ("v 0 0 0\nf a b c d\n", "line 2: expected the number of a point, got 'f a b c d'"),
        ("v 0 0 0\nv 1 0 0 \\\n", "line 2: expected a statement on one line, got one that is continued"),
        ("v 0 0 0\nv 1 1 1\n", "this OBJ has 2 points and no faces, .*: save it with"),
        ("# nothing\n", r"this OBJ has no points \(v x y z\)"),
        ("hello world\n", "line 1: expected an OBJ statement of points and faces .*, got 'hello world'"),
        ("v 0 0 0\ncurv 0 1\n", "line 2: expected an OBJ statement"),
        ("v 0 0 0\n1 2 3\n", "line 2: expected an OBJ statement of points and faces .*, got '1 2 3'"),
        ("t crease 1\nv 0 0 0\n", "line 1: expected an OBJ statement"),
        ("v 0 0 0\nt crease 1 \\\n", "line 2: expected a statement on one line"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nl 1 3 2\n", "line 4: expected lines that join points one after another, got 1 3"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nl 1 2\n", "expected lines that join all 3 points, got 1 segments"),
        ("v 0 0 0\nv 1 0 0\nl 1 2 1 2\n", "line 3: expected lines that join points one after another, got 1 2"),
    ],
)
def test_obj_that_is_no_grid(content: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        parse(content)


def test_obj_lines_that_are_no_geometry_are_passed_over() -> None:
    plain = text(Surface(np.zeros((4, 5))))
    with pytest.warns(FormatWarning) as notes:
        surface = parse(plain + "t crease 2/1/0 1 4 4.7\n" * 3 + "t interpolateboundary 1/0/0 2\nxyz_hint 7\n")
    assert [str(note.message) for note in notes] == [
        "statements that are no geometry left out: t crease (3), t interpolateboundary (1), xyz_hint (1)"
    ]
    np.testing.assert_array_equal(surface.points, parse(plain).points)
    with pytest.warns(FormatWarning, match=r"k15 \(1\), others \(9,984\)$"):
        parse(plain + "".join(f"k{number} 1\n" for number in range(10_000)))


def test_faces_that_are_no_grid_are_named() -> None:
    lines = text(Surface(np.zeros((4, 5)))).splitlines()
    crossed = [*lines[:-1], "f 14 20 15 19"]
    with pytest.raises(
        FormatError, match=r"the first of them vertex 14 of face 7 \(line 27\), face 8 .* and face 12 \(line 32\)"
    ):
        parse("\n".join(crossed))
    twice = [*lines[:-1], lines[-2]]
    with pytest.raises(FormatError, match=r"got 3 at the edge .*: face 7 \(line 27\), face 11 \(line 31\) and face 12"):
        parse("\n".join(twice))
    # Six quads on the sides of a cube: closed, and no grid.
    cube = "".join(f"v {i & 1} {i >> 1 & 1} {i >> 2}\n" for i in range(8))
    cube += "f 1 2 4 3\nf 5 6 8 7\nf 1 2 6 5\nf 3 4 8 7\nf 1 3 7 5\nf 2 4 8 6\n"
    with pytest.raises(FormatError, match="expected"):
        parse(cube)


@pytest.mark.parametrize("suffix", ["obj", "ply"])
@pytest.mark.parametrize("closed", CLOSED)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_trimesh_sees_the_same_mesh(tmp_path: Path, suffix: str, closed: tuple[bool, bool], dtype: Any) -> None:
    trimesh = pytest.importorskip("trimesh")
    points = torus(8, 6).astype(dtype)
    path = tmp_path / f"torus.{suffix}"
    formats.write(Surface(points, closed), path)
    mesh = trimesh.load(path, process=False)
    np.testing.assert_array_equal(mesh.vertices.astype(dtype), points.reshape(-1, 3))
    assert len(mesh.faces) == 2 * (8 - (not closed[0])) * (6 - (not closed[1]))  # it cuts quads in two
    assert mesh.is_winding_consistent
    assert mesh.is_watertight == all(closed)
    assert mesh.euler_number == (1 if not any(closed) else 0)


@pytest.mark.parametrize("suffix", ["obj", "ply"])
def test_meshio_sees_the_same_quads(tmp_path: Path, suffix: str) -> None:
    meshio = pytest.importorskip("meshio")
    heights = np.arange(-7, 8, dtype=np.int32).reshape(3, 5) * 100_000_000
    path = tmp_path / f"heights.{suffix}"
    formats.write(Surface(heights), path)
    mesh = meshio.read(path)
    np.testing.assert_array_equal(mesh.points[:, 2], heights.reshape(-1))
    rows, columns = np.divmod(np.arange(15), 5)
    np.testing.assert_array_equal(mesh.points[:, :2], np.stack((columns, rows), axis=-1))
    (cells,) = mesh.cells
    assert cells.type == "quad"
    expected = [[i, i + 1, i + 6, i + 5] for i in (0, 1, 2, 3, 5, 6, 7, 8)]
    assert cells.data.tolist() == expected


def test_ply_of_attributes_and_of_curves() -> None:
    file = io.BytesIO()
    formats.write_stream(Surface(np.arange(16.0).reshape(2, 2, 4)), "ply", file)
    header, body = file.getvalue().split(b"end_header\n", 1)
    assert b"property double z\nproperty double attribute_0\nelement face 1\n" in header
    assert np.frombuffer(body[:128], "<f8").tolist() == list(range(16))
    assert body[128:] == b"\x04" + np.array([0, 1, 3, 2], "<i4").tobytes()
    file = io.BytesIO()
    formats.write_stream(Surface(np.zeros((3, 1, 3), np.uint8), (True, False)), "ply", file)
    header, body = file.getvalue().split(b"end_header\n", 1)
    assert b"property float z\nelement edge 3\nproperty int vertex1\nproperty int vertex2\n" in header
    assert np.frombuffer(body[36:], "<i4").tolist() == [0, 1, 1, 2, 2, 0]


def test_ply_refuses_integers_that_it_cannot_hold() -> None:
    file = io.BytesIO()
    with pytest.raises(FormatError, match=r"up to 2\^53\), got z from 0 to 9007199254740993"):
        formats.write_stream(Surface(np.array([[0, 2**53 + 1]])), "ply", file)
    assert file.getvalue() == b""
