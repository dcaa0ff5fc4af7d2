"""Meshes of polygons with more than four corners: resampled if that is asked for, else refused with the option."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.mesh import Mesh, weld
from lodestream.mesh.model import name_faces

Floats = NDArray[np.float64]
OPTIONS: dict[str, Any] = {"remesh": True, "blocks": 12, "remesh_error": 1e-2}


def dodecahedron() -> tuple[Floats, list[list[int]]]:
    """Twelve pentagons, counter-clockwise as seen from outside."""
    phi = (1 + 5**0.5) / 2
    points: list[list[float]] = [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    for a in (-1 / phi, 1 / phi):
        for b in (-phi, phi):
            points += [[0, a, b], [a, b, 0], [b, 0, a]]
    vertices = np.array(points, np.float64)
    faces = []
    for axis in range(3):
        for s in (-1, 1):
            for t in (-1, 1):
                normal = np.roll([s, 0, t * phi], axis)
                face = np.argsort(-vertices @ normal)[:5]
                middle = vertices[face].mean(axis=0)
                first = vertices[face[0]] - middle
                second = np.cross(normal, first) / np.linalg.norm(normal)
                angle = np.arctan2((vertices[face] - middle) @ second, (vertices[face] - middle) @ first)
                faces.append(face[np.argsort(angle)].tolist())
    return vertices, faces


def obj(path: Path) -> None:
    vertices, faces = dodecahedron()
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    lines += [f"vt {x!r} {y!r}" for x, y in vertices[:, :2].tolist()]
    path.write_text("\n".join([*lines, *("f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in faces)]))


def off(path: Path) -> None:
    vertices, faces = dodecahedron()
    lines = [f"OFF\n{len(vertices)} {len(faces)} 0", *(" ".join(map(repr, row)) for row in vertices.tolist())]
    path.write_text("\n".join([*lines, *(" ".join(map(str, [len(face), *face])) for face in faces)]))


def ply(path: Path, binary: bool = False) -> None:
    vertices, faces = dodecahedron()
    kind = "binary_little_endian" if binary else "ascii"
    head = f"ply\nformat {kind} 1.0\nelement vertex {len(vertices)}\n"
    head += "".join(f"property double {axis}\n" for axis in "xyz")
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nproperty list uchar float texcoord\n"
    head += "end_header\n"
    texture = [[value for corner in face for value in vertices[corner, :2].tolist()] for face in faces]
    if binary:
        rows = [
            struct.pack(f"<B{len(f)}iB{len(t)}f", len(f), *f, len(t), *t) for f, t in zip(faces, texture, strict=True)
        ]
        path.write_bytes(head.encode() + vertices.tobytes() + b"".join(rows))
        return
    lines = [" ".join(map(repr, row)) for row in vertices.tolist()]
    lines += [" ".join(map(str, [len(f), *f, len(t), *t])) for f, t in zip(faces, texture, strict=True)]
    path.write_text(head + "\n".join(lines) + "\n")


FILES: dict[str, Callable[[Path], None]] = {"obj": obj, "off": off, "ply": ply}
FILES["binary.ply"] = lambda path: ply(path, binary=True)


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.long
def test_a_file_of_pentagons_is_refused_with_the_option_and_resampled_with_it(kind: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{kind}"
    FILES[kind](path)
    with pytest.raises(ls.FormatError, match=r"3 or 4 corners, got 5 in .*; remesh=yes resamples"):
        ls.read(path)
    pytest.importorskip("igl")
    options: dict[str, Any] = {name: str(value) for name, value in OPTIONS.items()}
    surface = ls.read(path, **options)
    check(surface)
    if kind != "off":
        for block in surface.blocks:
            np.testing.assert_allclose(block.attributes["uv"], block.points[..., :2], atol=1e-5)


def check(surface: ls.Surface) -> None:
    """It is closed, has no handle, and lies on the dodecahedron."""
    quads = weld(surface).quads
    edges = np.sort(np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).all()
    assert len(np.unique(quads)) - len(unique) + len(quads) == 2
    points = np.concatenate([block.points.reshape(-1, 3) for block in surface.blocks])
    phi = (1 + 5**0.5) / 2
    normals = np.array([np.roll([s, 0, t * phi], axis) for axis in range(3) for s in (-1, 1) for t in (-1, 1)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    vertices, faces = dodecahedron()
    height = (vertices[faces[0]].mean(axis=0) ** 2).sum() ** 0.5
    assert np.abs((points @ normals.T).max(axis=1) - height).max() < 1e-5
    assert surface.metadata["remesh"]["folds"] == 0


def test_faces_in_a_list_are_resampled() -> None:
    with pytest.raises(ls.InputError, match="remesh=True takes more"):
        ls.Surface.from_mesh(*dodecahedron())
    pytest.importorskip("igl")
    check(ls.Surface.from_mesh(*dodecahedron(), **OPTIONS))


def test_polygons_of_pyvista_are_resampled() -> None:
    pv = pytest.importorskip("pyvista")
    pytest.importorskip("igl")
    vertices, faces = dodecahedron()
    mesh = pv.PolyData(vertices, np.concatenate([[len(face), *face] for face in faces]))
    with pytest.raises(ls.FormatError, match="got 5 in face 1; remesh=yes"):
        ls.Surface.from_pyvista(mesh)
    check(ls.Surface.from_pyvista(mesh, **OPTIONS))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\n", "line 4: expected faces of 3 corners or more, got 2 in 'f 1 2'"),
        (
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3 4 5\n",
            "line 4: expected the number of one of the 3 points so far, got 4",
        ),
    ],
)
def test_what_is_no_face_is_refused_all_the_same(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(text)
    with pytest.raises(ls.FormatError, match=words):
        ls.read(path, remesh="yes")


#: Faces of three, five, four, six and three corners.
COUNTS = (3, 5, 4, 6, 3)


def circles() -> tuple[Floats, list[list[int]]]:
    corners = [np.arange(count) * 2 * np.pi / count for count in COUNTS]
    points = np.concatenate([np.stack([np.cos(a) + 3 * k, np.sin(a), 0 * a], axis=1) for k, a in enumerate(corners)])
    starts = np.cumsum([0, *COUNTS[:-1]])
    return points, [list(range(start, start + count)) for start, count in zip(starts, COUNTS, strict=True)]


@pytest.mark.parametrize("kind", ["obj", "off", "ply"])
def test_parts_of_a_face_have_its_name(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = circles()
    points = "".join(f"{x} {y} {z}\n" for x, y, z in vertices)
    lists = "".join(" ".join(map(str, [len(face), *face])) + "\n" for face in faces)
    text = {
        "obj": points.replace("\n", "\nv ").join(["v ", ""])[:-2]
        + "".join("f " + " ".join(str(k + 1) for k in face) + "\n" for face in faces),
        "off": f"OFF\n{len(vertices)} {len(faces)} 0\n{points}{lists}",
        "ply": f"ply\nformat ascii 1.0\nelement vertex {len(vertices)}\nproperty double x\nproperty double y\n"
        f"property double z\nelement face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        f"{points}{lists}",
    }[kind]
    (tmp_path / f"a.{kind}").write_text(text)
    first = text.splitlines().index((lists if kind != "obj" else text[text.index("f ") :]).splitlines()[0]) + 1
    module = {"obj": "obj.reader", "off": "off", "ply": "ply.mesh"}[kind]
    meshes = []

    def keep(_: object, mesh: Mesh, *more: object) -> ls.Surface:
        meshes.append(mesh)
        return ls.Surface(np.zeros((2, 2)))

    monkeypatch.setattr(f"lodestream.formats.{module}.surface_of", keep)
    ls.read(tmp_path / f"a.{kind}", remesh="yes")
    (mesh,) = meshes
    parents = np.repeat(np.arange(5), [1, 3, 1, 4, 1])
    assert [mesh.face_name(part) for part in range(10)] == [f"face {k + 1} (line {first + k})" for k in parents]
    assert name_faces(mesh, [1, 2, 3]) == f"face 2 (line {first + 1})"


def test_parts_of_a_face_in_a_list_have_its_number() -> None:
    mesh = Mesh.of(*circles(), polygons=True)
    assert [mesh.face_name(part) for part in range(10)] == [f"face {k}" for k in (1, 2, 2, 2, 3, 4, 4, 4, 4, 5)]


@pytest.mark.parametrize("far", ["inf", "nan", "1e308", "-1.7e308"])
def test_polygons_with_vertices_beyond_all_measure_are_refused(far: str, tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    FILES["obj"](path)
    path.write_text(path.read_text().replace("v ", f"v {far} ", 1).replace(" -1.0\n", "\n", 1))
    with pytest.raises(ls.FormatError, match=r"expected finite coordinates of vertices|with a diagonal from"):
        ls.read(path, remesh="yes")
