"""Meshes in OBJ, OFF and PLY: all that the files say about their vertices and corners, and what is refused where."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from lodestream import formats
from lodestream.errors import FormatError, FormatWarning, TooLargeError
from lodestream.surface import Surface

from .meshes import grid_faces

POINTS = [(x, y, x * y) for y in range(3) for x in range(4)]
FACES = grid_faces(3, 4)


def read(folder: Path, name: str, content: str | bytes) -> Surface:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return formats.read(path)


def obj(points: list[str], faces: list[str], more: str = "") -> str:
    return "\n".join([*(f"v {point}" for point in points), more, *(f"f {face}" for face in faces), ""])


def words(rows: Iterable[Iterable[float]]) -> list[str]:
    return [" ".join(map(str, row)) for row in rows]


def assert_points(surface: Surface) -> None:
    assert (surface.shape, surface.closed) == ((3, 4), (False, False))
    np.testing.assert_array_equal(surface.points.reshape(-1, 3), POINTS)


@pytest.mark.parametrize(
    ("corner", "names"),
    [("{0}", set()), ("{0}/{0}", {"uv"}), ("{0}//{0}", {"normal"}), ("{0}/{0}/{0}", {"uv", "normal"})],
)
@pytest.mark.parametrize("slow", [False, True])
def test_obj_corners(tmp_path: Path, corner: str, names: set[str], slow: bool) -> None:
    texture = "".join(f"vt {k / 12} {k}\n" for k in range(12))
    normals = "".join(f"vn 0 {k} 1\n" for k in range(12))
    faces = [" ".join(corner.format(index + 1) for index in face) for face in FACES]
    if slow:  # a comment makes lines be read one by one
        faces = [f"{face} # here" for face in faces]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        surface = read(tmp_path, "mesh.obj", obj(words(POINTS), faces, texture + normals))
    assert_points(surface)
    assert set(surface.attributes) == names
    unnamed = [("uv", "places in a texture (vt)"), ("normal", "normals (vn)")]
    expected = [f"{what} that no face names left out" for name, what in unnamed if name not in names]
    assert [str(warning.message) for warning in caught] == expected
    if "uv" in names:
        np.testing.assert_array_equal(surface.attributes["uv"].reshape(-1, 2)[:, 1], range(12))
    if "normal" in names:
        np.testing.assert_array_equal(surface.attributes["normal"].reshape(-1, 3)[:, 1], range(12))


def test_obj_numbers_from_the_end(tmp_path: Path) -> None:
    texture = "".join(f"vt {k} 0\n" for k in range(12))
    faces = [" ".join(f"{index - 12}/{index - 12}" for index in face) for face in FACES]
    surface = read(tmp_path, "mesh.obj", obj(words(POINTS), faces, texture))
    assert_points(surface)
    np.testing.assert_array_equal(surface.attributes["uv"][..., 0].reshape(-1), range(12))


@pytest.mark.parametrize(("more", "width"), [("0.5 {0} 0", 3), ("0.5 {0} 0 1", 4)])
def test_obj_colours(tmp_path: Path, more: str, width: int) -> None:
    points = [f"{point} {more.format(k / 12)}" for k, point in enumerate(words(POINTS))]
    surface = read(tmp_path, "mesh.obj", obj(points, [" ".join(str(c + 1) for c in face) for face in FACES]))
    assert_points(surface)
    assert surface.attributes["color"].shape == (3, 4, width)
    np.testing.assert_array_equal(surface.attributes["color"][..., 1].reshape(-1), np.arange(12) / 12)


def test_obj_curve_with_colours(tmp_path: Path) -> None:
    surface = read(tmp_path, "curve.obj", "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 1 1 0 0 0 1\nl 1 2 3 1\n")
    assert (surface.shape, surface.closed) == ((3, 1), (True, False))
    np.testing.assert_array_equal(surface.attributes["color"][:, 0], np.eye(3))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("v 0 0 0\nvt 1 2 3 4\n", r"line 2: expected 1 to 3 numbers, got 'vt 1 2 3 4'"),
        ("v 0 0 0\nvn 1 2\n", r"line 2: expected a normal of 3 numbers, got 'vn 1 2'"),
        ("vt 0 0\nvt 0 0 0\n", r"line 2: expected places in a texture of 2 values like those before, got 3"),
        ("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1 4/7\n", r"line 6: expected vt up to 1, got 7"),
        (
            "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1/-1 2/1 3/1 4/1\n",
            r"line 5: expected the number of one of the 0 places",
        ),
        ("v 0 0 0\nf 1 1 1 1 1\n", r"line 2: expected faces of 3 or 4 corners, got 5"),
        ("v 0 0 0\nf 1/x 1 1\n", r"line 2: expected the number of a point, got 'f 1/x 1 1'"),
        ("v 0 0 0\nf 99999999999999999999 1 1\n", r"line 2: expected the number of one of the 1 points"),
    ],
)
def test_obj_that_is_wrong(tmp_path: Path, content: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read(tmp_path, "mesh.obj", content)


def ply(kind: str, texture: bool = False) -> bytes:
    order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[kind]
    header = (
        f"ply\nformat {kind} 1.0\ncomment made by hand\nelement vertex 12\nproperty float x\nproperty float y\n"
        "property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nproperty double heat\n"
        "element face 6\nproperty list uchar int vertex_indices\n"
        + ("property list uchar float texcoord\n" if texture else "")
        + "end_header\n"
    )
    vertices = [[*point, k, 2 * k, 3, k / 7] for k, point in enumerate(POINTS)]
    faces: list[list[float]] = [[4, *face] for face in FACES]
    if texture:
        faces = [[*row, 8, *(v for c in face for v in (c / 4, c % 4))] for row, face in zip(faces, FACES, strict=True)]
    if not order:
        return (header + "".join(" ".join(map(str, row)) + "\n" for row in [*vertices, *faces])).encode()
    body = [struct.pack(f"{order}fffBBBd", *row) for row in vertices]
    code = f"{order}B4i" + "B8f" * texture
    body += [struct.pack(code, *(int(value) if k < 6 else value for k, value in enumerate(row))) for row in faces]
    return header.encode() + b"".join(body)


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("texture", [False, True])
def test_ply_meshes(tmp_path: Path, kind: str, texture: bool) -> None:
    surface = read(tmp_path, "mesh.ply", ply(kind, texture))
    assert_points(surface)
    assert surface.dtype == np.float32
    assert surface.attributes["color"].dtype == np.uint8
    np.testing.assert_array_equal(surface.attributes["color"][..., 1].reshape(-1), 2 * np.arange(12))
    np.testing.assert_array_equal(surface.attributes["heat"].reshape(-1), np.arange(12) / 7)
    assert ("uv" in surface.attributes) == texture
    if texture:
        np.testing.assert_array_equal(surface.attributes["uv"].reshape(-1, 2)[:, 0], np.arange(12) / 4)


def test_ply_properties_that_no_surface_keeps_are_named(tmp_path: Path) -> None:
    content = ply("ascii").decode().replace("vertex_indices\n", "vertex_index\nproperty int flags\n")
    lines = content.splitlines()
    lines[-6:] = [f"{line} 7" for line in lines[-6:]]
    with pytest.warns(FormatWarning, match="^flags of faces left out$"):
        surface = read(tmp_path, "mesh.ply", "\n".join(lines) + "\n")
    assert_points(surface)
    assert surface.metadata["recognised"].endswith("; flags of faces left out")


def test_ply_curve(tmp_path: Path) -> None:
    content = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element edge 2\nproperty int vertex1\nproperty int vertex2\nend_header\n0 0 0\n1 0 0\n2 0 1\n0 1\n1 2\n"
    )
    surface = read(tmp_path, "curve.ply", content)
    assert (surface.shape, surface.closed) == ((3, 1), (False, False))
    with pytest.raises(FormatError, match=r"edge 2: expected lines that join points one after another, got 3 2"):
        read(tmp_path, "curve.ply", content.replace("\n1 2\n", "\n2 1\n"))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("4 0 1 5 4", "5 0 1 5 4 3", r"faces of 3 or 4 corners, got 5 in face 1 \(line 27\)"),
        ("4 1 2 6 5", "4 1 2 12 5", r"vertices from 0 to 11, got 12 in face 2 \(line 28\)"),
        ("property float y", "property float w", r"expected vertices with x, y and z, got x, w"),
        ("vertex_indices", "corners", r"expected faces with a list vertex_indices, got corners"),
        (
            "element face 6",
            "element tristrips 6",
            r"this PLY has no faces, only vertex, tristrips, .*: save it with an element face",
        ),
    ],
)
def test_ply_that_is_wrong(tmp_path: Path, old: str, new: str, message: str) -> None:
    content = ply("ascii").decode()
    assert content.count(old) == 1
    with pytest.raises(FormatError, match=message):
        read(tmp_path, "mesh.ply", content.replace(old, new))


def off(head: str = "OFF\n12 6 0", extra: str = "", colours: str = "") -> str:
    points = [f"{point}{extra.format(k)}" for k, point in enumerate(words(POINTS))]
    faces = [f"4 {' '.join(map(str, face))}{colours}" for face in FACES]
    return "\n".join([head, "", "# a comment", *points, *faces, ""])


@pytest.mark.parametrize(
    ("head", "extra", "shapes"),
    [
        ("OFF\n12 6 0", "", {}),
        ("# first\nOFF # name\n12 6", "", {}),
        ("OFF 12 6 0", "", {}),
        ("NOFF\n12 6 0", " 0 {0} 1", {"normal": 3}),
        ("COFF\n12 6 0", " 255 {0} 3", {"color": 3}),
        ("COFF\n12 6 0", " 0.5 {0} 0.25 1", {"color": 4}),
        ("STOFF\n12 6 0", " 0 {0}", {"uv": 2}),
        ("STCNOFF\n12 6 0", " 0 {0} 0 255 {0} 0 1 0.5 {0}", {"normal": 3, "color": 4, "uv": 2}),
    ],
)
def test_off_meshes(tmp_path: Path, head: str, extra: str, shapes: dict[str, int]) -> None:
    surface = read(tmp_path, "mesh.off", off(head, extra))
    assert_points(surface)
    assert {name: array.shape[2] for name, array in surface.attributes.items()} == shapes
    for array in surface.attributes.values():
        np.testing.assert_array_equal(array[..., 1].reshape(-1), range(12))


def test_off_colours(tmp_path: Path) -> None:
    surface = read(tmp_path, "mesh.off", off("COFF\n12 6 0", " 255 {0} 3"))
    assert surface.attributes["color"].dtype == np.uint8
    with pytest.warns(FormatWarning, match="^colours of faces left out$"):
        surface = read(tmp_path, "mesh.off", off(colours=" 255 0 0"))
    assert surface.metadata["recognised"] == "grid, 3 x 4; 12 vertices; colours of faces left out"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("OFF BINARY\n12 6 0\n", "expected OFF as text, got OFF BINARY"),
        ("4OFF\n12 6 0\n", "expected OFF of three dimensions, got 4OFF"),
        ("OFF\n12\n", r"line 2: expected the numbers of vertices, faces and edges, got '12'"),
        ("OFF\n", "expected the numbers of vertices, faces and edges, got ''"),
        ("OFF\n99999999 1 0\n", r"cut short: it says 99,999,999 vertices and 1 faces, .* and has 17"),
        ("OFF\n2 1 0\n0 0 0\n1 0\n3 0 1 1\n", r"line 4: expected a vertex of 3 numbers, got '1 0'"),
        ("OFF\n2 1 0\n0 0 0\n1 0 x\n3 0 1 1\n", r"line 4: expected a vertex of 3 numbers, got '1 0 x'"),
        (
            "OFF\n2 1 0\n0 0 0\n1 0 0\n3 0 1 2\n",
            r"line 5: expected 3 or 4 and as many vertices from 0 to 1, got '3 0 1 2'",
        ),
        ("OFF\n2 1 0\n0 0 0\n1 0 0\n5 0 1 0 1 0\n", r"expected faces of 3 or 4 corners, got 5 in line 5; remesh=yes"),
        ("OFF\n2 2 0\n0 0 0\n1 0 0\n3 0 1 1\n", r"cut short: it says 2 faces, and 1 lines of them follow"),
        ("OFF\n2 1 0\n0 0 0\n1 0 0\n3 0 1 1\n7\n", r"line 6: expected the end of the file after its faces, got '7'"),
        ("#\rXYZ\nOFF\n1 1 0\n0 0 0\n3 0 0 0\n", "expected a line with OFF at the beginning, got another"),
        ("COFF\n1 1 0\n0 0 0 1 1\n3 0 0 0\n", r"line 3: expected a vertex with a colour of 3 or 4 numbers"),
        ("OFF\n0 0 0\n# nothing at all\n", "expected at least one vertex, got none"),
    ],
)
def test_off_that_is_wrong(tmp_path: Path, content: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        read(tmp_path, "mesh.off", content)


@pytest.mark.parametrize("name", ["mesh.obj", "mesh.off", "mesh.ply"])
def test_more_vertices_than_allowed(tmp_path: Path, name: str) -> None:
    contents = {
        "mesh.obj": obj(words(POINTS), [" ".join(str(corner + 1) for corner in face) for face in FACES]),
        "mesh.off": off(),
        "mesh.ply": ply("ascii").decode(),
    }
    path = tmp_path / name
    path.write_text(contents[name])
    with pytest.raises(TooLargeError, match="expected at most 11 vertices, got 12"):
        formats.read(path, max_vertices=11)


def test_a_repeated_last_column_of_a_mesh_is_merged_and_written_again(tmp_path: Path) -> None:
    u = np.arange(9) * np.pi / 4
    rows = [[(np.cos(a), np.sin(a), float(z)) for a in (*u[:8], u[0])] for z in range(4)]
    points = words([point for row in rows for point in row])
    faces = [" ".join(str(corner + 1) for corner in face) for face in grid_faces(4, 9)]
    surface = read(tmp_path, "tube.obj", obj(points, faces))
    assert (surface.shape, surface.closed, surface.metadata["seam"]) == ((4, 8), (False, True), "cols")
    assert surface.metadata["recognised"] == "cylinder, 4 x 8; 36 vertices"
    open_surface = formats.read(tmp_path / "tube.obj", closed="none")
    assert (open_surface.shape, open_surface.closed) == ((4, 9), (False, False))
