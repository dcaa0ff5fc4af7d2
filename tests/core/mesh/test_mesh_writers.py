"""OBJ, PLY, GLB and VTS: the same geometry, holes and attributes in the eyes of other libraries."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from plyfile import PlyData

from lodestream import formats
from lodestream.errors import FormatError, FormatWarning
from lodestream.surface import Block, Surface
from tests.examples import examples

from .meshes import drawn

SUFFIXES = ["obj", "ply", "glb", "vts"]
CLOSED = [(False, False), (True, False), (False, True), (True, True)]


def tube(rows: int, columns: int, seed: int = 0) -> NDArray[np.float32]:
    """Points of a bent sheet, no two of them at the same place."""
    random = np.random.default_rng(seed)
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(np.float32)
    return np.concatenate([grid, random.random((rows, columns, 1), np.float32)], axis=-1)


def written(surface: Surface, suffix: str) -> bytes:
    file = io.BytesIO()
    formats.write_stream(surface, suffix, file)
    return file.getvalue()


def chunks(content: bytes) -> tuple[Any, bytes]:
    """The JSON and the binary chunk of a GLB file."""
    magic, version, total, length, kind = struct.unpack_from("<4sIII4s", content)
    assert (magic, version, total, kind) == (b"glTF", 2, len(content), b"JSON")
    scene = json.loads(content[20 : 20 + length])
    size, kind = struct.unpack_from("<I4s", content, 20 + length)
    assert kind == b"BIN\0"
    assert size == len(content) - 28 - length
    return scene, content[28 + length :]


def accessor(scene: Any, binary: bytes, number: int) -> NDArray[Any]:
    described = scene["accessors"][number]
    view = scene["bufferViews"][described["bufferView"]]
    assert view["byteOffset"] % 4 == 0
    code = {5126: "<f4", 5125: "<u4", 5121: "u1"}[described["componentType"]]
    raw = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    values = np.frombuffer(raw, code)
    return values.reshape(described["count"], -1) if described["type"] != "SCALAR" else values


def polygons(path: Path) -> tuple[NDArray[Any], set[frozenset[int]]]:
    """Points, and the points of each face, as another library sees them; quads may come as two triangles."""
    if path.suffix == ".vts":
        pytest.importorskip("vtkmodules")
        from vtkmodules.util.numpy_support import vtk_to_numpy
        from vtkmodules.vtkIOXML import vtkXMLStructuredGridReader

        reader = vtkXMLStructuredGridReader()
        reader.SetFileName(str(path))
        reader.Update()
        grid = reader.GetOutput()
        points = vtk_to_numpy(grid.GetPoints().GetData())
        faces = set()
        for number in range(grid.GetNumberOfCells()):
            if grid.IsCellVisible(number):
                cell = grid.GetCell(number)
                faces.add(frozenset(cell.GetPointId(k) for k in range(cell.GetNumberOfPoints())))
        return points, faces
    trimesh = pytest.importorskip("trimesh")
    mesh = trimesh.load(path, process=False, force="mesh")
    return mesh.vertices, {frozenset(face) for face in mesh.faces.tolist()}


def triangles_in_space(points: NDArray[Any], faces: set[frozenset[int]]) -> set[frozenset[tuple[float, ...]]]:
    """Faces by the places of their corners, whatever the vertices' numbers; quads by all four."""
    places = [tuple(point) for point in np.asarray(points, np.float32).tolist()]
    return {frozenset(places[corner] for corner in face) for face in faces}


def expected_faces(surface: Surface, split: bool) -> set[frozenset[tuple[float, ...]]]:
    mesh = drawn(surface)
    quads = [tuple(quad) for quad in mesh.quads.tolist()]
    if split:
        halves = [half for a, b, c, d in quads for half in ((a, b, c), (a, c, d))]
        faces = {frozenset(half) for half in halves}
    else:
        faces = {frozenset(quad) for quad in quads}
    faces |= {frozenset(triangle) for triangle in mesh.triangles.tolist()}
    return triangles_in_space(mesh.vertices, faces)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("closed", CLOSED)
@given(seed=st.integers(0, 2**32))
@examples(2)
def test_another_library_sees_the_same_faces_and_holes(
    tmp_path_factory: pytest.TempPathFactory, suffix: str, closed: tuple[bool, bool], seed: int
) -> None:
    random = np.random.default_rng(seed)
    points = tube(7, 6, seed)
    mask = random.random((7, 6)) < 0.8
    mask[2:4, 2:4] = True
    points[~mask] = np.nan
    surface = Surface(points, closed, mask=mask)
    path = tmp_path_factory.mktemp("out") / f"a.{suffix}"
    formats.write(surface, path)
    places, faces = polygons(path)
    assert np.isfinite(places).all()
    assert triangles_in_space(places, faces) == expected_faces(surface, split=suffix != "vts")
    if suffix in ("ply", "glb"):
        np.testing.assert_array_equal(places.astype(np.float32), points[mask])


def cube_sides() -> list[Block]:
    """Two blocks at a right angle that share a side, the second with its rows the other way."""
    one = tube(5, 4)
    two = tube(3, 5, 1)[::-1].copy()
    two[:, :, 0] += 100
    two[0] = one[:, -1][::-1]
    return [Block(one), Block(two)]


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb"])
def test_blocks_are_one_welded_mesh(tmp_path: Path, suffix: str) -> None:
    surface = Surface(blocks=cube_sides())
    formats.write(surface, tmp_path / f"a.{suffix}")
    places, faces = polygons(tmp_path / f"a.{suffix}")
    assert len(places) == 5 * 4 + 3 * 5 - 5
    assert triangles_in_space(places, faces) == expected_faces(surface, split=True)
    assert max(max(face) for face in faces) < len(places)


def test_blocks_are_stacked_in_one_vts_with_a_warning(tmp_path: Path) -> None:
    surface = Surface(blocks=cube_sides())
    with pytest.warns(FormatWarning, match="VTS is written with 2 blocks stacked in its one grid, with hidden cells"):
        formats.write(surface, tmp_path / "a.vts")
    places, faces = polygons(tmp_path / "a.vts")
    assert len(places) == (5 + 3) * 5
    assert triangles_in_space(places, faces) == expected_faces(surface, split=False)


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb"])
def test_triangles_and_poles_go_out_as_they_came(tmp_path: Path, suffix: str) -> None:
    points = tube(5, 6)
    points[0] = points[0, 0]
    poles = [{"block": 0, "side": "first_row", "kind": "fan"}]
    for metadata in ({"faces": {"diagonal": "anti"}, "poles": poles}, {"poles": poles}):
        surface = Surface(points, metadata=metadata)
        formats.write(surface, tmp_path / f"a.{suffix}")
        places, faces = polygons(tmp_path / f"a.{suffix}")
        assert len(places) == 1 + 4 * 6
        assert len(faces) == 5 + 2 * 15
        assert triangles_in_space(places, faces) == expected_faces(surface, split=True)


def colored(dtype: Any = np.float32) -> Surface:
    points = tube(3, 4).astype(dtype)
    normals = np.zeros((3, 4, 3), np.float32)
    normals[..., 2] = 1
    attributes: dict[str, NDArray[Any]] = {
        "color": np.arange(36, dtype=np.uint8).reshape(3, 4, 3) * 7,
        "normal": normals,
        "uv": points[:, :, :2] / 8,
        "heat": np.arange(12, dtype=np.int16).reshape(3, 4),
        "flow": np.arange(60, dtype=np.float32).reshape(3, 4, 5),
    }
    mask = np.ones((3, 4), np.bool_)
    mask[1, 1] = False
    return Surface(points, mask=mask, attributes=attributes, metadata={"name": "a b", "crs": 'GEOGCS["X",\n  1]'})


def valid(surface: Surface, name: str) -> NDArray[Any]:
    assert surface.mask is not None
    values: NDArray[Any] = surface.attributes[name][surface.mask]
    return values


def test_ply_has_all_attributes(tmp_path: Path) -> None:
    surface = colored()
    formats.write(surface, tmp_path / "a.ply")
    data = PlyData.read(tmp_path / "a.ply")
    assert data.comments == ["name a b", 'crs GEOGCS["X", 1]']
    vertices = data["vertex"]
    names = [*"xyz", "red", "green", "blue", "nx", "ny", "nz", "s", "t", "heat", *(f"flow_{k}" for k in range(5))]
    assert [it.name for it in vertices.properties] == names
    for name, columns in (("color", ("red", "green", "blue")), ("uv", "st"), ("flow", names[-5:])):
        np.testing.assert_array_equal(np.stack([vertices[it] for it in columns], axis=-1), valid(surface, name))
    np.testing.assert_array_equal(vertices["heat"], valid(surface, "heat"))
    assert vertices["heat"].dtype == np.int16
    assert len(data["face"].data) == 2


def test_ply_renames_what_it_cannot_call_so_and_warns_of_rounded_integers() -> None:
    large = np.array([[2**60 + 1, 0], [1, 2]])
    attributes = {"x": np.ones((2, 2)), "é b": np.ones((2, 2)), "large": large, "small": np.array([[1, 2], [3, 4]])}
    surface = Surface(tube(2, 2), attributes=attributes)
    with pytest.warns(FormatWarning) as caught:
        head = written(surface, "ply").split(b"end_header")[0].decode("ascii")
    assert [str(warning.message) for warning in caught] == [
        "PLY is written without the last bits of large, whose integers it rounds to doubles",
        "PLY is written with x, é b under other names: it is read back as x_, __b, large, small",
    ]
    assert [line.split()[-1] for line in head.splitlines() if "property double" in line] == [
        "x_",
        "__b",
        "large",
        "small",
    ]


def test_obj_has_colours_normals_and_textures(tmp_path: Path) -> None:
    surface = colored()
    with pytest.warns(FormatWarning, match="OBJ is written without heat, flow, which it cannot hold"):
        formats.write(surface, tmp_path / "a.obj")
    text = (tmp_path / "a.obj").read_text()
    assert text.startswith('# name a b\n# crs GEOGCS["X", 1]\nv ')
    corners = [tuple(map(int, corner.split("/"))) for corner in text.split("\nf ")[1].split()[:4]]
    assert all(place == texture == normal for place, texture, normal in corners)
    lines = [line.split() for line in text.splitlines()]
    for keyword, name in (("vt", "uv"), ("vn", "normal")):
        rows = [list(map(float, words[1:])) for words in lines if words[0] == keyword]
        np.testing.assert_array_equal(np.array(rows, np.float32), valid(surface, name))
    colors = np.array([words[4:] for words in lines if words[0] == "v"], np.float64)
    np.testing.assert_array_equal(np.rint(colors * 255), valid(surface, "color"))


def test_a_seam_in_a_texture_is_one_line_of_vertices_in_obj(tmp_path: Path) -> None:
    points = tube(3, 5)
    points[:, -1] = points[:, 0]
    uv = np.stack(np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 3)), axis=-1)
    surface = Surface(points, attributes={"uv": uv}, metadata={"faces": {"joined": True}})
    text = written(surface, "obj").decode()
    assert text.count("\nv ") + text.startswith("v ") == 12
    assert text.count("\nvt ") == 15


def test_glb_has_all_attributes() -> None:
    surface = colored()
    scene, binary = chunks(written(surface, "glb"))
    assert scene["asset"]["extras"] == {"name": "a b", "crs": 'GEOGCS["X", 1]'}
    (primitive,) = scene["meshes"][0]["primitives"]
    assert primitive["mode"] == 4
    names = ["POSITION", "COLOR_0", "NORMAL", "TEXCOORD_0", "_HEAT", *(f"_FLOW_{k}" for k in range(5))]
    assert list(primitive["attributes"]) == names
    values = {name: accessor(scene, binary, number) for name, number in primitive["attributes"].items()}
    np.testing.assert_array_equal(values["POSITION"], surface.points[surface.mask])
    assert scene["accessors"][0]["min"] == values["POSITION"].min(axis=0).tolist()
    np.testing.assert_array_equal(values["COLOR_0"][:, :3], valid(surface, "color"))
    assert (values["COLOR_0"][:, 3] == 255).all()
    np.testing.assert_array_equal(values["TEXCOORD_0"], valid(surface, "uv") * [1, -1] + [0, 1])
    np.testing.assert_array_equal(values["_FLOW_3"], valid(surface, "flow")[:, 3])
    assert accessor(scene, binary, primitive["indices"]).max() == 10
    assert "translation" not in scene["nodes"][0]


def test_glb_stores_large_coordinates_from_their_middle_and_warns(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    points = tube(4, 5).astype(np.float64) / 7 + [500_000.0, 4_100_000.0, 0.1]
    attributes = {
        "time": np.full((4, 5), 0.1),
        "gap": np.full((4, 5), np.nan),
        "normal": np.ones((4, 5, 3), np.float32),
    }
    with pytest.warns(FormatWarning, match="GLB is written with float32, to which it rounds coordinates, time, gap"):
        formats.write(Surface(points, attributes=attributes), tmp_path / "a.glb")
    mesh = trimesh.load(tmp_path / "a.glb", process=False, force="mesh")
    np.testing.assert_allclose(mesh.vertices, points.reshape(-1, 3), atol=1e-7, rtol=0)
    scene, binary = chunks((tmp_path / "a.glb").read_bytes())
    names = scene["meshes"][0]["primitives"][0]["attributes"]
    assert list(names) == ["POSITION", "_TIME", "_GAP", "_NORMAL"]
    assert accessor(scene, binary, names["_GAP"]).tolist() == [0.0] * 20
    with pytest.raises(FormatError, match="coordinates that float32 of GLB can hold"):
        written(Surface(points * 1e40), "glb")


def test_vts_has_all_attributes_in_their_types(tmp_path: Path) -> None:
    surface = colored(np.float64)
    formats.write(surface, tmp_path / "a.vts")
    back = formats.read(tmp_path / "a.vts")
    np.testing.assert_array_equal(back.points[surface.mask], surface.points[surface.mask])
    assert back.mask is not None
    np.testing.assert_array_equal(back.mask, surface.mask)
    assert back.attributes.keys() == surface.attributes.keys()
    for name, values in surface.attributes.items():
        assert back.attributes[name].dtype == values.dtype
        np.testing.assert_array_equal(back.attributes[name], values)
    text = (tmp_path / "a.vts").read_bytes()
    assert b'<PointData Scalars="color" Normals="normal" TCoords="uv">' in text
    codes = text.split(b'Name="crs" NumberOfTuples="1" format="ascii">')[1].split(b"<")[0]
    assert bytes(map(int, codes.split())) == b'GEOGCS["X", 1]\0'


def test_vts_comes_back_closed(tmp_path: Path) -> None:
    pytest.importorskip("vtkmodules")
    for closed in CLOSED:
        surface = Surface(tube(5, 6), closed)
        formats.write(surface, tmp_path / "a.vts")
        back = formats.read(tmp_path / "a.vts")
        assert back.closed == closed
        np.testing.assert_array_equal(back.points, surface.points)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_heights_stand_over_their_coordinates(tmp_path: Path, suffix: str) -> None:
    heights = np.arange(12, dtype=np.int16).reshape(3, 4)
    metadata = {"geotransform": [100.0, 2.0, 0.0, 200.0, 0.0, -4.0]}
    formats.write(Surface(heights, metadata=metadata), tmp_path / f"a.{suffix}")
    places, _ = polygons(tmp_path / f"a.{suffix}")
    rows, columns = np.divmod(np.arange(12), 4)
    expected = np.stack([101 + 2 * columns, 198 - 4 * rows, np.arange(12)], axis=-1)
    np.testing.assert_array_equal(places, expected)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_planar_points_and_integers(tmp_path: Path, suffix: str) -> None:
    points = np.arange(24, dtype=np.int64).reshape(3, 4, 2) ** 2
    formats.write(Surface(points), tmp_path / f"a.{suffix}")
    places, faces = polygons(tmp_path / f"a.{suffix}")
    np.testing.assert_array_equal(places[:, :2], points.reshape(-1, 2))
    assert (places[:, 2] == 0).all()
    assert len(faces) == (6 if suffix == "vts" else 12)


def test_curves_with_holes(tmp_path: Path) -> None:
    points = tube(9, 1)
    points[3] = np.nan
    surface = Surface(points, (True, False))
    assert b"\nl 1 2\nl 2 3\nl 4 5\nl 5 6\nl 6 7\nl 7 8\nl 8 1\n" in written(surface, "obj")
    assert PlyData.read(io.BytesIO(written(surface, "ply")))["edge"].count == 7
    scene, binary = chunks(written(surface, "glb"))
    primitive = scene["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 1
    assert accessor(scene, binary, primitive["indices"]).tolist()[-2:] == [7, 0]
    alone = np.full((2, 3, 3), np.nan, np.float32)
    alone[0, 0] = 1
    scene, _ = chunks(written(Surface(alone), "glb"))
    assert scene["meshes"][0]["primitives"][0] == {"attributes": {"POSITION": 0}, "mode": 0}
    formats.write(Surface(tube(9, 1)), tmp_path / "a.vts")
    assert polygons(tmp_path / "a.vts")[0].shape == (9, 3)


def test_channels_beyond_the_third_are_attributes() -> None:
    points = np.arange(24.0).reshape(2, 2, 6)
    assert written(Surface(points), "obj").startswith(b"v 0.0 1.0 2.0 3.0 4.0 5.0\n")
    with pytest.warns(FormatWarning, match="OBJ is written without attribute_0, attribute_1,"):
        assert written(Surface(points[:, :, :5]), "obj").startswith(b"v 0.0 1.0 2.0\n")
    scene, binary = chunks(written(Surface(points), "glb"))
    names = scene["meshes"][0]["primitives"][0]["attributes"]
    assert accessor(scene, binary, names["_ATTRIBUTE_2"]).tolist() == [5, 11, 17, 23]
    assert b'Name="attribute_1"' in written(Surface(points), "vts")


def test_a_transparent_colour_is_kept_or_warned_of() -> None:
    color = np.full((2, 2, 4), 128, np.uint8)
    surface = Surface(tube(2, 2), attributes={"color": color})
    with pytest.warns(FormatWarning, match="OBJ is written without the fourth component of color"):
        written(surface, "obj")
    scene, binary = chunks(written(surface, "glb"))
    assert (accessor(scene, binary, 1) == 128).all()
    assert b"property uchar alpha\n" in written(surface, "ply")
    color[..., 3] = 255
    assert written(Surface(tube(2, 2), attributes={"color": color}), "obj").startswith(b"v 0 0 ")
