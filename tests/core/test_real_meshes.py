"""Meshes that others made: what is recognised in them, and that nothing of them changes."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream import formats
from lodestream.coordinates.seams import restore
from lodestream.errors import FormatError
from lodestream.surface import Surface

from .mesh.meshes import drawn

DATA = Path(__file__).parents[3] / "shared" / "data"

#: A mesh of the capsule has one material, which is no part of its shape.
pytestmark = pytest.mark.filterwarnings("ignore:materials .* left out:lodestream.errors.FormatWarning")

READ = {
    "bamboo_pen.obj": "110 blocks, 2 x 2 to 9 x 11; 1146 vertices; cut at 72 irregular vertices",
    "capsule.obj": "grid, 52 x 101, from triangles; 5252 vertices; 2 poles; materials (usemtl) left out",
    "catmark_cube_creases1_level4.obj": "6 blocks, 33 x 33 each; 6146 vertices; cut at 8 irregular vertices",
    "catmark_square_hedit1_level4.obj": "grid, 97 x 97; 9409 vertices",
    "fandisk_quads.off": "52 blocks, 2 x 2 to 9 x 9; 766 vertices; cut at 30 irregular vertices",
    "mountain.obj": "grid, 160 x 160, from triangles; 25600 vertices",
    "torus_tri_blender.obj": (
        "torus, 96 x 24, from triangles; 2304 vertices; 2 diagonals fit, chosen by the order of the vertices"
    ),
}


def path_of(name: str) -> Path:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{name} is not beside the project, in shared/data")
    return path


def plain_mesh(path: Path) -> tuple[NDArray[np.float64], list[list[int]]]:
    """Points and faces, read in the simplest way that these files allow."""
    if path.suffix == ".off":
        lines = path.read_text().splitlines()[1:]
        count = int(lines[0].split()[0])
        points = [list(map(float, line.split())) for line in lines[1 : count + 1]]
        return np.array(points), [list(map(int, line.split()[1:])) for line in lines[count + 1 :] if line.strip()]
    words = [line.split() for line in path.read_text().splitlines()]
    points = [list(map(float, line[1:4])) for line in words if line[:1] == ["v"]]
    return np.array(points), [[int(word.split("/")[0]) - 1 for word in line[1:]] for line in words if line[:1] == ["f"]]


@functools.cache
def surface_of(name: str) -> Surface:
    """What is recognised in a file."""
    return formats.read(path_of(name))


Corner = tuple[float, ...]


def at_places(points: NDArray[np.float64], faces: list[list[int]]) -> Counter[tuple[Corner, ...]]:
    """Faces by the places of their corners, in their sense, from the least corner."""
    places = list(map(tuple, points.tolist()))
    result: Counter[tuple[Corner, ...]] = Counter()
    for face in faces:
        corners = [places[corner] for corner in face]
        result[min(tuple(corners[k:] + corners[:k]) for k in range(len(corners)))] += 1
    return result


def edges(faces: list[list[int]]) -> Counter[int]:
    """How many edges have how many faces."""
    count = Counter(frozenset((face[k - 1], face[k])) for face in faces for k in range(len(face)))
    return Counter(count.values())


@pytest.mark.parametrize("name", READ)
def test_what_is_recognised(name: str) -> None:
    assert surface_of(name).metadata["recognised"] == READ[name]


@pytest.mark.sweep(4)
@pytest.mark.parametrize("name", READ)
def test_the_mesh_is_the_same(name: str) -> None:
    points, faces = plain_mesh(path_of(name))
    mesh = drawn(restore(surface_of(name)))
    out = [*mesh.quads.tolist(), *mesh.triangles.tolist()]
    assert len(mesh.vertices) == len(points)
    assert at_places(mesh.vertices, out) == at_places(points, faces)
    assert edges(out) == edges(faces)


def shuffled(points: NDArray[np.float64], faces: list[list[int]]) -> str:
    """The mesh as OBJ, with its vertices and faces in another order."""
    rng = np.random.default_rng(4)
    order = rng.permutation(len(points))
    number = np.empty(len(points), np.int64)
    number[order] = np.arange(1, len(points) + 1)
    lines = ["v {!r} {!r} {!r}".format(*points[index].tolist()) for index in order]
    turned = (np.roll(number[faces[index]], rng.integers(4)).tolist() for index in rng.permutation(len(faces)).tolist())
    return "\n".join([*lines, *("f " + " ".join(map(str, face)) for face in turned)])


@pytest.mark.sweep(2)
@pytest.mark.parametrize("name", [name for name in READ if name != "torus_tri_blender.obj"])
@pytest.mark.long
def test_in_another_order(name: str, tmp_path: Path) -> None:
    points, faces = plain_mesh(path_of(name))
    path = tmp_path / "shuffled.obj"
    path.write_text(shuffled(points, faces))
    surface = formats.read(path)
    if len(surface.blocks) < 10:  # where lines stop at each other, it is the order that decides which do
        assert shapes(surface) == shapes(surface_of(name))
    mesh = drawn(restore(surface))
    out = [*mesh.quads.tolist(), *mesh.triangles.tolist()]
    assert at_places(mesh.vertices, out) == at_places(points, faces)


def shapes(surface: Surface) -> list[list[int]]:
    return sorted(sorted(block.shape) for block in surface.blocks)


def test_the_torus_in_another_order_is_told_by_its_geometry(tmp_path: Path) -> None:
    points, faces = plain_mesh(path_of("torus_tri_blender.obj"))
    path = tmp_path / "shuffled.obj"
    path.write_text(shuffled(points, faces))
    surface = formats.read(path)
    assert sorted(surface.shape) == [24, 96]
    assert surface.closed == (True, True)
    assert "2 diagonals fit, the longest chosen" in surface.metadata["recognised"]


def test_the_capsule_keeps_its_texture_and_normals_and_so_stays_open() -> None:
    surface = formats.read(path_of("capsule.obj"))
    assert (surface.shape, surface.closed) == ((52, 101), (False, False))
    np.testing.assert_array_equal(surface.points[:, 0], surface.points[:, -1])
    assert {name: array.shape for name, array in surface.attributes.items()} == {
        "normal": (52, 101, 3),
        "uv": (52, 101, 2),
    }
    np.testing.assert_allclose(surface.attributes["uv"][3, :, 0], np.arange(101) / 100)
    assert [pole["kind"] for pole in surface.metadata["poles"]] == ["repeated", "repeated"]


def test_the_monkey_is_refused_by_name_of_its_triangles() -> None:
    words = r"this mesh has triangles beside quads, .*: face 193 \(line 1205\), .* more; make quads"
    with pytest.raises(FormatError, match=words):
        formats.read(path_of("suzanne_quads_tris.obj"))


@pytest.mark.parametrize("export", ["obj", "off", "ply"])
def test_meshes_of_trimesh(export: str, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / f"mesh.{export}"
    shapes: dict[Callable[[], object], str] = {
        lambda: trimesh.creation.uv_sphere(count=[12, 16]): "sphere, 12 x 32, from triangles; 322 vertices; 2 poles",
        lambda: trimesh.creation.torus(3, 1): "torus, 32 x 32, from triangles; 1024 vertices",
        lambda: trimesh.creation.capsule(count=[12, 16]): "sphere, 14 x 16, from triangles; 194 vertices; 2 poles",
    }
    for make, words in shapes.items():
        mesh = make()
        mesh.export(path)  # type: ignore[attr-defined]
        surface = formats.read(path)
        assert words in surface.metadata["recognised"]
        back = drawn(surface)
        again = trimesh.Trimesh(back.vertices, back.triangles, process=False)
        assert again.is_watertight
        assert again.is_winding_consistent
        assert again.volume == pytest.approx(mesh.volume, rel=1e-6)  # type: ignore[attr-defined]
