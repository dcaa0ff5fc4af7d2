"""GLB, read: what this program writes comes back, scenes are one mesh, what trimesh would read wrongly is refused."""

from __future__ import annotations

import io
import json
import struct
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream import formats
from tests.core.remesh import scenes

trimesh = pytest.importorskip("trimesh")


def torus(rows: int = 12, columns: int = 16) -> ls.Surface:
    u, v = (np.arange(n) * 2 * np.pi / n for n in (rows, columns))
    ring = 3 + np.cos(u)[:, None]
    height = np.broadcast_to(np.sin(u)[:, None], (rows, columns))
    points = np.stack([ring * np.cos(v), ring * np.sin(v), height], axis=2).astype(np.float32)
    normal = np.stack([np.cos(u)[:, None] * np.cos(v), np.cos(u)[:, None] * np.sin(v), height], axis=2)
    attributes: dict[str, Any] = {
        "color": np.random.default_rng(0).integers(0, 255, (rows, columns, 4)).astype(np.uint8),
        "normal": normal.astype(np.float32),
        "uv": np.random.default_rng(1).random((rows, columns, 2)).astype(np.float32),
        "speed": np.random.default_rng(2).random((rows, columns)).astype(np.float32),
    }
    return ls.Surface(points, (True, True), attributes=attributes, metadata={"unit": "m"})


def glb(surface: ls.Surface) -> bytes:
    file = io.BytesIO()
    formats.write_stream(surface, "glb", file)
    return file.getvalue()


def changed(content: bytes, change: Callable[[dict[str, Any]], object]) -> bytes:
    """A file with another scene."""
    length = struct.unpack_from("<I", content, 12)[0]
    scene = json.loads(content[20 : 20 + length])
    change(scene)
    text = json.dumps(scene).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    return struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON") + text + rest


def rows_of(surface: ls.Surface, *names: str) -> np.ndarray:
    """Points and attributes of a surface, one row for each point, sorted."""
    block = surface.blocks[0]
    columns = [block.points, *(block.attributes[name] for name in names)]
    rows = np.concatenate(
        [np.asarray(c, np.float64).reshape(block.points.shape[0] * block.points.shape[1], -1) for c in columns], axis=1
    )
    return rows[np.lexsort(rows.T[::-1])]


def test_what_is_written_comes_back_as_the_same_grid(tmp_path: Path) -> None:
    surface = torus()
    (tmp_path / "a.glb").write_bytes(glb(surface))
    for back in (ls.read(tmp_path / "a.glb"), ls.read(tmp_path / "a.glb", remesh="yes")):
        assert (sorted(back.shape), back.closed, back.points.dtype.name) == ([12, 16], (True, True), "float32")
        assert (back.metadata["format"], back.metadata["unit"]) == ("glb", "m")
        shapes = {name: values.shape[2:] for name, values in surface.attributes.items()}
        assert {name: values.shape[2:] for name, values in back.attributes.items()} == shapes
        np.testing.assert_allclose(rows_of(back, *surface.attributes), rows_of(surface, *surface.attributes), atol=1e-6)


def test_points_that_need_more_than_float32_come_back_from_their_place(tmp_path: Path) -> None:
    surface = ls.Surface(torus().points.astype(np.float64) * 0.1 + [5e6, 4e5, 100])
    with pytest.warns(ls.FormatWarning, match="rounds coordinates"):
        (tmp_path / "a.glb").write_bytes(glb(surface))
    back = ls.read(tmp_path / "a.glb")
    np.testing.assert_allclose(rows_of(back), rows_of(surface), atol=1e-6)


def scene_of(*meshes: tuple[Any, np.ndarray]) -> bytes:
    scene = trimesh.Scene()
    for mesh, matrix in meshes:
        scene.add_geometry(mesh, transform=matrix)
    content: bytes = scene.export(file_type="glb")
    return content


def test_all_meshes_of_a_scene_are_one_at_their_places(tmp_path: Path) -> None:
    pytest.importorskip("igl")
    points, faces = scenes.sphere()
    ball = trimesh.Trimesh(points, faces, process=False, vertex_attributes={"_height": points[:, 2].astype(np.float32)})
    mirror, shift = np.diag([-2.0, 2, 2, 1]), np.eye(4)
    shift[0, 3] = 10
    (tmp_path / "a.glb").write_bytes(scene_of((ball, mirror), (ball.copy(), shift)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        surface = ls.read(tmp_path / "a.glb", remesh="yes", blocks="24", remesh_error="1e-2")
    assert {face["part"] for face in surface.metadata["faces"]} == {0, 1}
    for block in surface.blocks:
        far = block.points[..., 0].mean() > 5
        centre, size = ([10, 0, 0], 1) if far else ([0, 0, 0], 2)
        outward = block.points - centre
        np.testing.assert_allclose(np.linalg.norm(outward, axis=-1), size, atol=0.1 * size)
        np.testing.assert_allclose(block.attributes["height"], outward[..., 2] / size, atol=0.05)
        steps = np.cross(block.points[1:, 1:] - block.points[:-1, :-1], block.points[1:, :-1] - block.points[:-1, 1:])
        # Mirrored faces still look outwards.
        assert ((steps * outward[1:, 1:]).sum(axis=-1) > 0).mean() > 0.9


def test_attributes_that_some_meshes_lack_are_left_out_with_a_note(tmp_path: Path) -> None:
    points, faces = scenes.cube()
    plain = trimesh.Trimesh(points, faces, process=False)
    valued = trimesh.Trimesh(points + 9, faces, process=False, vertex_attributes={"_t": np.ones(8, np.float32)})
    (tmp_path / "a.glb").write_bytes(scene_of((plain, np.eye(4)), (valued, np.eye(4))))
    pytest.importorskip("igl")
    with pytest.warns(ls.FormatWarning, match="t left out, which some of the meshes lack"):
        ls.read(tmp_path / "a.glb", remesh="yes", blocks="12", remesh_error="1e-1")


def _set(key: str, value: Any) -> Callable[[dict[str, Any]], object]:
    return lambda scene: scene.__setitem__(key, value)


REFUSED: dict[str, tuple[Callable[[bytes], bytes], str]] = {
    "cut short": (lambda content: content[:-9], "cut short: it says [0-9,]+ bytes, and has "),
    "a head": (lambda content: content[:15], "cut short in its header: it has 15 bytes"),
    "glTF 1": (
        lambda content: content[:4] + b"\1" + content[5:],
        "has version 1 of glTF: export it again with version 2",
    ),
    "no JSON": (lambda content: content[:20] + b"?" + content[21:], "has no chunk with a scene in JSON"),
    "a long chunk": (
        lambda content: content[:12] + b"\xff\xff\xff\x7f" + content[16:],
        "damaged: a chunk says 2,147,483,647 bytes",
    ),
    "Draco": (
        lambda content: changed(content, _set("extensionsRequired", ["KHR_draco_mesh_compression"])),
        "needs the extension KHR_draco_mesh_compression: export it again without",
    ),
    "another file": (
        lambda content: changed(content, lambda scene: scene["buffers"][0].update(uri="/etc/passwd")),
        "names another file, .*: export it again with",
    ),
    "a sparse array": (
        lambda content: changed(content, lambda scene: scene["accessors"][0].update(sparse={"count": 1})),
        "expected arrays of GLB that are stored whole",
    ),
    "an array of zeros": (
        lambda content: changed(content, lambda scene: scene["accessors"][0].pop("bufferView")),
        "expected arrays of GLB that are stored, got one of zeros",
    ),
    "an array without end": (
        lambda content: changed(content, lambda scene: scene["accessors"][0].update(count=10**12)),
        "got one of 1000000000000 values",
    ),
    "a view beyond the end": (
        lambda content: changed(content, lambda scene: scene["bufferViews"][0].update(byteLength=10**12)),
        "expected views of at most twice",
    ),
    "views of the same bytes": (
        lambda content: changed(content, lambda scene: scene["bufferViews"].extend(scene["bufferViews"] * 99)),
        "expected views of at most twice the [0-9,]+ bytes of the file",
    ),
    "a view of less than nothing beside large ones": (
        lambda content: changed(
            content, lambda scene: scene["bufferViews"].extend([*scene["bufferViews"] * 99, {"byteLength": -(10**12)}])
        ),
        "expected views of at most twice",
    ),
    "a view of no length": (
        lambda content: changed(content, lambda scene: scene["bufferViews"][0].pop("byteLength")),
        "expected views of at most",
    ),
    "a tall scene": (
        lambda content: changed(content, _set("nodes", [{"mesh": 0, "children": [k + 1]} for k in range(99)])),
        "expected at most 64 nodes above one another",
    ),
    "nodes in a circle": (
        lambda content: changed(content, _set("nodes", [{"mesh": 0, "children": [1]}, {"children": [0]}])),
        "expected at most 64 nodes above one another",
    ),
    "fans": (
        lambda content: changed(content, lambda scene: scene["meshes"][0]["primitives"][0].update(mode=6)),
        "fans of triangles: export it again",
    ),
    "lines": (
        lambda content: changed(content, lambda scene: scene["meshes"][0]["primitives"][0].update(mode=1)),
        "this GLB has no triangles in its scene",
    ),
    "nothing": (
        lambda content: changed(content, lambda scene: scene.clear()),
        "no triangles in its scene|trimesh cannot read",
    ),
    "lists for maps": (lambda content: changed(content, _set("meshes", [[]])), "meshes of the scene as a list of maps"),
    "a flat place": (
        lambda content: changed(content, lambda scene: scene["nodes"][0].update(scale=[1, 1, 0])),
        "that its matrix makes flat: export",
    ),
    "a place that is no number": (
        lambda content: changed(content, lambda scene: scene["nodes"][0].update(matrix=[float("nan")] * 16)),
        "with a matrix that is not finite, or beyond",
    ),
    "an infinite place": (
        lambda content: changed(content, lambda scene: scene["nodes"][0].update(translation=[float("inf"), 0, 0])),
        "with a matrix that is not finite, or beyond|trimesh cannot read",
    ),
    "a place beyond all numbers": (
        lambda content: changed(content, lambda scene: scene["nodes"][0].update(scale=[1e308] * 3)),
        "with a matrix that is not finite, or beyond|trimesh cannot read",
    ),
    "a corner that is not there": (
        lambda content: changed(content, lambda scene: scene["accessors"][0].update(count=2)),
        "trimesh cannot read|expected faces over",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_would_be_read_wrongly_or_without_limit_is_refused(case: str, tmp_path: Path) -> None:
    change, words = REFUSED[case]
    (tmp_path / "a.glb").write_bytes(change(glb(torus())))
    with pytest.raises(ls.FormatError, match=words) as caught:
        ls.read(tmp_path / "a.glb")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("asset", [[], "x", None, 5, {"extras": 5}])
def test_an_asset_that_is_no_map_says_nothing(tmp_path: Path, asset: object) -> None:
    (tmp_path / "a.glb").write_bytes(changed(glb(torus()), _set("asset", asset)))
    assert sorted(ls.read(tmp_path / "a.glb").shape) == [12, 16]


def test_further_shapes_are_left_out_with_a_note(tmp_path: Path) -> None:
    def add(scene: dict[str, Any]) -> None:
        primitive = scene["meshes"][0]["primitives"][0]
        primitive["targets"] = [{"POSITION": primitive["attributes"]["POSITION"]}]

    (tmp_path / "a.glb").write_bytes(changed(glb(torus()), add))
    with pytest.warns(ls.FormatWarning, match=r"further shapes \(morph targets\) left out"):
        ls.read(tmp_path / "a.glb")


def test_a_mesh_at_many_places_counts_as_often(tmp_path: Path) -> None:
    def repeat(scene: dict[str, Any]) -> None:
        scene["nodes"] = [{"mesh": 0}] * 40
        scene["scenes"][0]["nodes"] = list(range(40))

    (tmp_path / "a.glb").write_bytes(changed(glb(torus()), repeat))
    with pytest.raises(ls.TooLargeError, match="got 7,680 vertices of all meshes in the scene"):
        ls.read(tmp_path / "a.glb", max_vertices=5000)


@pytest.mark.parametrize("seed", range(5))
def test_damaged_files_are_refused_in_one_way(seed: int, tmp_path: Path) -> None:
    random = np.random.default_rng(seed)
    content = glb(ls.Surface(torus().points))
    for _ in range(40):
        damaged = np.frombuffer(content, np.uint8).copy()
        places = random.integers(12, len(damaged) if seed % 2 else 1200, random.integers(1, 6))
        damaged[places] = random.integers(0, 256, len(places))
        (tmp_path / "a.glb").write_bytes(damaged.tobytes())
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ls.FormatWarning)
            with suppress(ls.InputError):
                ls.read(tmp_path / "a.glb")
