"""Meshes to recognise, and the comparison of what came of them by the vertices that they had before."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream.formats.mesh_output import output_of
from lodestream.mesh import Mesh, walks
from lodestream.mesh.polygons import Polygons, prepare
from lodestream.surface import Surface

#: Faces as lists of vertices.
FaceList = list[list[int]]


def grid_faces(rows: int, columns: int, closed: tuple[bool, bool] = (False, False), shift: int = 0) -> FaceList:
    """Quads of a grid in row order; a closed first axis may come back `shift` columns further."""
    faces = []
    for r in range(rows - (not closed[0])):
        for c in range(columns - (not closed[1])):
            below, right = (r + 1) % rows, (c + 1) % columns
            s = shift if below == 0 else 0
            corners = ((r, c), (r, right), (below, right + s), (below, c + s))
            faces.append([i * columns + j % columns for i, j in corners])
    return faces


def star(arms: int, size: int) -> tuple[int, FaceList]:
    """Vertices and quads of so many square patches round one vertex."""
    number: dict[tuple[int, int, int], int] = {}

    def vertex(arm: int, i: int, j: int) -> int:
        if i == j == 0:
            arm = 0
        elif i == 0:  # the first column of an arm is the first row of the next
            arm, i, j = (arm + 1) % arms, j, 0
        return number.setdefault((arm, i, j), len(number))

    faces = [
        [vertex(a, i, j), vertex(a, i + 1, j), vertex(a, i + 1, j + 1), vertex(a, i, j + 1)]
        for a in range(arms)
        for i in range(size)
        for j in range(size)
    ]
    return len(number), faces


def cut_in_two(faces: FaceList, diagonal: str) -> FaceList:
    """Both halves of each quad; other faces as they are."""
    result = []
    for face in faces:
        if len(face) != 4:
            result.append(face)
            continue
        a, b, c, d = face
        result += [[a, b, c], [a, c, d]] if diagonal == "main" else [[a, b, d], [b, c, d]]
    return result


def collapse(faces: FaceList, row: Iterable[int], vertex: int) -> FaceList:
    """Let the vertices of a row be one; quads along it become triangles."""
    gone = set(row)
    result = []
    for face in faces:
        kept = [vertex if corner in gone else corner for corner in face]
        result.append([corner for k, corner in enumerate(kept) if corner != kept[k - 1]])
    return [face for face in result if len(face) > 2]


def scrambled(faces: FaceList, vertices: int, rng: np.random.Generator, flips: bool = True) -> FaceList:
    """Faces in another order, from other corners, some the other way round, over vertices with other numbers."""
    numbers = rng.permutation(vertices).tolist()
    result = []
    for index in rng.permutation(len(faces)).tolist():
        face = [numbers[corner] for corner in np.roll(faces[index], rng.integers(4)).tolist()]
        result.append(face[::-1] if flips and rng.integers(2) else face)
    return result


def mesh_of(faces: FaceList, vertices: int, rng: np.random.Generator | None = None) -> Mesh:
    """A mesh at random places, whose vertices carry their numbers."""
    rng = rng or np.random.default_rng(0)
    return Mesh.of(rng.random((vertices, 3)), faces, {"number": np.arange(vertices)})


def without_sense(faces: Iterable[Sequence[Any]]) -> Counter[tuple[Any, ...]]:
    """Faces in a form in which the first corner and the sense of rotation do not matter."""
    return Counter(
        min(tuple(turned[k:]) + tuple(turned[:k]) for turned in (face, face[::-1]) for k in range(len(face)))
        for face in map(list, faces)
    )


class Drawn(NamedTuple):
    """The mesh that the formats for meshes write."""

    vertices: NDArray[Any]
    quads: NDArray[np.int64]
    triangles: NDArray[np.int64]
    attributes: dict[str, NDArray[Any]]


def drawn(surface: Surface) -> Drawn:
    """The mesh of a surface, vertices as rows of x, y and z."""
    output = output_of(surface)
    return Drawn(np.stack(output.coordinates, axis=-1), output.quads, output.triangles, output.attributes)


def faces_out(surface: Surface) -> tuple[FaceList, dict[str, NDArray[Any]]]:
    """Faces of a surface's mesh, and its vertices' attributes."""
    mesh = drawn(surface)
    return [*mesh.quads.tolist(), *mesh.triangles.tolist()], mesh.attributes


def assert_same_faces(surface: Surface, faces: FaceList) -> None:
    """The surface's mesh has the faces, each vertex once, and all faces wound alike."""
    out, attributes = faces_out(surface)
    numbers = attributes["number"]
    assert len(set(numbers.tolist())) == len(numbers)
    assert without_sense(numbers[face].tolist() for face in out) == without_sense(faces)
    edges = Counter((face[k - 1], face[k]) for face in out for k in range(len(face)))
    assert max(edges.values()) == 1


def grown(rng: np.random.Generator, triangles: int) -> tuple[int, FaceList]:
    """Vertices and triangles of a disc to which so many are added at random: on an edge, or between two."""
    border, edges, faces = [0, 1, 2], {frozenset(edge) for edge in ((0, 1), (1, 2), (0, 2))}, [[0, 1, 2]]
    count = 3
    for place in rng.integers(0, 1 << 30, triangles).tolist():
        j = place % len(border)
        before, vertex, after = border[j - 1], border[j], border[(j + 1) % len(border)]
        if place & 1 and frozenset((before, after)) not in edges:
            faces.append([before, after, vertex])
            edges.add(frozenset((before, after)))
            del border[j]
        else:
            faces.append([before, count, vertex])
            edges |= {frozenset((before, count)), frozenset((count, vertex))}
            border.insert(j, count)
            count += 1
    return count, faces


def any_faces(seed: int, kind: str = "") -> tuple[FaceList, int]:
    """Faces in any order over so many vertices: grids that are closed, holed, collapsed or cut, and several of them."""
    rng = np.random.default_rng(seed)
    faces: FaceList = []
    vertices = 0
    for _ in range(rng.integers(1, 4)):
        rows, columns = (int(size) for size in rng.integers(3, 8, 2))
        closed = (bool(rng.integers(2)), bool(rng.integers(2)))
        more = grid_faces(rows, columns, closed, int(rng.integers(columns)) if closed == (True, True) else 0)
        count = rows * columns
        if rng.integers(3) == 0:
            count, more = star(int(rng.integers(3, 7)), int(rng.integers(1, 4)))
        elif rng.integers(3) == 0 and kind != "quads":
            more = collapse(more, range(columns), 0)
        if rng.integers(3) == 0 and kind != "quads":
            count, more = grown(rng, int(rng.integers(1, 40)))
        if rng.integers(2):
            more = [face for face in more if rng.random() < 0.8] or more
        if kind == "triangles" or (kind == "" and rng.integers(2)):
            more = cut_in_two(more, "main")
        faces += [[vertex + vertices for vertex in face] for face in more]
        vertices += count
    return scrambled(faces, vertices, rng), vertices


def corners_of(faces: FaceList) -> NDArray[np.int32]:
    """Rows of four corners, -1 in the last place of triangles."""
    return np.array([face + [-1] * (4 - len(face)) for face in faces], np.int32).reshape(-1, 4)


def wound_alike(seed: int, kind: str = "") -> tuple[Polygons, int]:
    """Any faces, turned round so that all of a piece are wound alike, and how many vertices there are."""
    faces, vertices = any_faces(seed, kind)
    mesh = Mesh.of(np.random.default_rng(seed).random((vertices, 3)), faces)
    return prepare(mesh, (), np.zeros((0, len(faces), 4), np.int32)), vertices


@contextmanager
def calls_of(steps: int) -> Iterator[None]:
    """Let kernels over meshes take so many steps or faces in a call."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(walks, "_STEPS_PER_CALL", steps)
        yield
