"""A mesh that is written has the same faces after every layer: they follow from the structure, never from values."""

from __future__ import annotations

import io
import json
import struct
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from plyfile import PlyData

import lodestream as ls
from lodestream import formats
from lodestream.errors import FormatWarning
from lodestream.grid.connectivity import LatticeBlock
from lodestream.mesh import weld
from tests.examples import examples

from ..mesh.meshes import collapse, grid_faces
from .layouts import layouts, overlapping, tubes

#: What a container does not keep is another matter, see test_losses.
pytestmark = pytest.mark.filterwarnings("ignore:values of attributes at:lodestream.FormatWarning")

#: Number of vertices and the faces, or edges, over them, in the order of the file.
Topology = tuple[int, list[list[int]]]


def written(surface: ls.Surface, kind: str) -> bytes:
    file = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)  # of attributes and rounding, which are not looked at here
        formats.write_stream(surface, kind, file)
    return file.getvalue()


def of_obj(content: bytes) -> Topology:
    lines = content.decode().splitlines()
    faces = [[int(corner.split("/")[0]) for corner in line.split()[1:]] for line in lines if line[:2] in ("f ", "l ")]
    return sum(line.startswith("v ") for line in lines), faces


def of_ply(content: bytes) -> Topology:
    data = PlyData.read(io.BytesIO(content))
    faces = [list(map(int, row)) for row in data["face"].data["vertex_indices"]] if "face" in data else []
    edges = [[int(a), int(b)] for a, b in data["edge"].data] if "edge" in data else []
    return data["vertex"].count, faces + edges


def of_glb(content: bytes) -> Topology:
    length = struct.unpack_from("<I", content, 12)[0]
    scene = json.loads(content[20 : 20 + length])
    primitive = scene["meshes"][0]["primitives"][0]
    count = scene["accessors"][primitive["attributes"]["POSITION"]]["count"]
    if "indices" not in primitive:
        return count, []
    indices = scene["accessors"][primitive["indices"]]
    offset = 28 + length + scene["bufferViews"][indices["bufferView"]]["byteOffset"]
    corners = np.frombuffer(content, "<u4", indices["count"], offset)
    return count, corners.reshape(-1, 3 if primitive["mode"] == 4 else 2).tolist()


READERS = {"obj": of_obj, "ply": of_ply, "glb": of_glb}


def topologies(surface: ls.Surface) -> dict[str, Topology]:
    return {kind: read(written(surface, kind)) for kind, read in READERS.items()}


def edges_of(faces: list[list[int]]) -> Counter[frozenset[int]]:
    return Counter(frozenset((face[k - 1], face[k])) for face in faces for k in range(len(face)))


def roughly(surface: ls.Surface, bits: int = 1) -> ls.Surface:
    """The same surface, whose values keep so few bits that most points lie at few places."""
    for block in surface.blocks:
        for array in (block.points, *block.attributes.values()):
            if array.dtype.kind == "f":
                array[...] = np.floor(array * 2**bits)
            else:
                array[...] = array // 2 ** (21 - bits)
    return surface


def decoded(surface: ls.Surface, **options: Any) -> ls.Decoder:
    decoder = ls.Decoder()
    decoder.feed(ls.encode(surface, **options))
    decoder.finish()
    return decoder


def wing(around: int = 33, span: int = 12, tip: int = 5) -> ls.Surface:
    """A thin wing as a C-grid has it: upper and lower side, a sharp trailing edge, a flat tip, a root in two halves."""
    t = np.linspace(0, np.pi, around)
    chord, thickness = (1 + np.cos(t)) / 2, 0.02 * np.sin(t) * (1 + np.cos(t))
    y = np.linspace(0, 3, span)
    upper = np.stack(np.broadcast_arrays(chord[:, None], y[None], thickness[:, None]), axis=-1)
    lower = upper[::-1] * [1, 1, -1]
    across = np.linspace(1, -1, tip)
    cap = np.stack(np.broadcast_arrays(chord[:, None], 3.0, thickness[:, None] * across), axis=-1)
    root = np.stack(np.broadcast_arrays(chord[:, None], 0.0, thickness[:, None] * np.linspace(0, 1, tip)), axis=-1)
    blocks = [upper, lower, cap, root, root[::-1] * [1, 1, -1]]
    return ls.Surface(blocks=[ls.Block(block.astype(np.float32) + np.float32(0)) for block in blocks])


def cube_sphere(size: int = 8, holes: bool = False) -> ls.Surface:
    u, v = np.meshgrid(np.arange(size + 1), np.arange(size + 1), indexing="ij")
    faces = [np.roll(np.stack([np.full_like(u, w), u, v], -1), k, -1) for k in range(3) for w in (0, size)]
    blocks = []
    for face in faces:
        places = 2 * face / size - 1
        mask = None
        if holes:
            mask = np.ones(u.shape, bool)
            mask[2:4, 3:6] = False
        points = (places / np.linalg.norm(places, axis=-1, keepdims=True)).astype(np.float32)
        blocks.append(ls.Block(points, mask=mask))
    return ls.Surface(blocks=blocks)


def sphere(rows: int = 17, columns: int = 24, kind: str = "fan") -> ls.Surface:
    """One block with two poles, as a mesh that was recognised has it, with normals that differ at the poles."""
    a, b = np.linspace(0, np.pi, rows)[:, None], np.arange(columns) / columns * 2 * np.pi
    points = np.stack([np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.broadcast_to(np.cos(a), (rows, columns))], -1)
    points[0], points[-1] = (0, 0, 1), (0, 0, -1)
    uv = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(np.float32)
    poles = [{"block": 0, "side": side, "kind": kind} for side in ("first_row", "last_row")]
    return ls.Surface(points, (False, True), attributes={"uv": uv}, metadata={"poles": poles})


def halves(attributes: bool = False) -> ls.Surface:
    """A sphere of two blocks, each with its poles, which meet along two meridians; perhaps with a texture each."""
    whole = sphere(13, 20).points
    blocks = []
    for start in (0, 10):
        points = np.take(whole, np.arange(start, start + 11) % 20, axis=1)
        uv = np.stack(np.meshgrid(np.arange(11.0), np.arange(13.0)), axis=-1)
        shade = np.round(points[..., 2:], 3)  # a function of the place: equal where blocks meet
        blocks.append(ls.Block(points, attributes={"uv": uv, "shade": shade} if attributes else None))
    return ls.Surface(blocks=blocks)


def torus() -> ls.Surface:
    a, b = (np.arange(n)[:, None] / n * 2 * np.pi for n in (20, 36))
    x = (3 + np.cos(a)) * np.cos(b.T)
    y = (3 + np.cos(a)) * np.sin(b.T)
    return ls.Surface(np.stack([x, y, np.broadcast_to(np.sin(a), x.shape)], -1).astype(np.float32), (True, True))


def tori() -> ls.Surface:
    """A torus of two blocks that wrap along one axis, with holes, and with one that stands by itself."""
    points = torus().points
    ring = np.concatenate([points, points[:, :1]], axis=1)
    mask = np.ones((20, 19), bool)
    mask[5:8, 0:3] = False  # a hole at a side: both blocks lack it
    other = np.ones((20, 19), bool)
    other[5:8, -1:] = False
    pieces = [ls.Block(ring[:, :19], (True, False), mask=mask), ls.Block(ring[:, 18:], (True, False), mask=None)]
    pieces[1] = ls.Block(ring[:, 18:], (True, False), mask=other)
    return ls.Surface(blocks=[*pieces, ls.Block(points[:8, :8] + np.float32(9))])


def corners() -> ls.Surface:
    """Blocks that touch in nothing but a corner, and along a part of a side, beside a curve that ends at a block."""
    grid = np.stack(np.meshgrid(np.arange(9.0), np.arange(9.0), [0.0], indexing="ij"), -1)[:, :, 0]
    grid[..., 2] = np.sin(grid[..., 0]) * np.cos(grid[..., 1])
    pieces = grid[:5, :5], grid[4:, 4:], grid[4:, :3] + [0, 0, 1], grid[:5, 4:][:, ::-1]
    interface = np.stack([np.arange(8.0, 15), np.full(7, 8.0), np.zeros(7)], -1)
    interface[0] = grid[8, 8]
    return ls.Surface(blocks=[*map(ls.Block, pieces), ls.Block(interface[:, None])])


def cut_sphere() -> ls.Surface:
    """What the mesh of a sphere with poles, one diagonal in each quad, is recognised as."""
    faces = [list(map(int, face)) for face in collapse(grid_faces(12, 16, (False, True)), range(16), 0)]
    points = sphere(12, 16).points.reshape(-1, 3)
    from lodestream.mesh import Mesh
    from lodestream.mesh.recognise import recognise

    return recognise(Mesh.of(points, faces)).surface()


SURFACES: dict[str, Callable[[], ls.Surface]] = {
    "wing": wing,
    "cube-sphere": cube_sphere,
    "cube-sphere-holes": lambda: cube_sphere(holes=True),
    "sphere": sphere,
    "sphere-degenerate": lambda: sphere(kind="degenerate"),
    "halves": halves,
    "halves-attributes": lambda: halves(attributes=True),
    "torus": torus,
    "tori": tori,
    "corners": corners,
    "recognised": cut_sphere,
}


@pytest.mark.sweep(4)
@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.long
def test_faces_are_the_same_after_every_layer(name: str) -> None:
    surface = SURFACES[name]()
    expected = topologies(surface)
    decoder = decoded(surface)
    assert len(decoder.layers) > 1
    for view in decoder.layers:
        assert topologies(view.surface()) == expected, view.number
    assert topologies(roughly(decoder.surface())) == expected


@pytest.mark.sweep(4)
@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.long
def test_faces_of_a_level_are_the_same_after_every_layer(name: str) -> None:
    decoder = decoded(SURFACES[name]())
    assert decoder.header is not None
    for level in range(decoder.header.levels + 1):
        expected = weld(decoder.surface(level))
        for shown in (*(view.surface(level) for view in decoder.layers), roughly(decoder.surface(level))):
            found = weld(shown)
            for field in ("source", "quads", "triangles", "edges", "joined"):
                np.testing.assert_array_equal(getattr(found, field), getattr(expected, field))


@pytest.mark.parametrize("name", ["cube-sphere", "sphere", "sphere-degenerate", "halves", "torus", "wing"])
def test_closed_surfaces_are_closed_at_every_level(name: str) -> None:
    decoder = decoded(SURFACES[name]())
    assert decoder.header is not None
    for level in range(1, decoder.header.levels + 1):
        for view in (decoder.layers[0], decoder.layers[-1]):
            _, faces = of_obj(written(view.surface(level), "obj"))
            counts = edges_of([[a for a, b in zip(f, f[1:] + f[:1], strict=True) if a != b] for f in faces])
            assert set(counts.values()) == {2}, (level, view.number)


@pytest.mark.parametrize("name", ["wing", "halves", "corners"])
@pytest.mark.parametrize("options", [{"precision": "5%"}, {"rms": "3%"}])
def test_a_precision_joins_nothing_that_was_apart(name: str, options: dict[str, str]) -> None:
    surface = SURFACES[name]()
    expected = topologies(surface)
    for view in decoded(surface, **options).layers:
        assert topologies(view.surface()) == expected


def test_a_prefix_of_the_file_has_the_faces_too() -> None:
    surface = halves(attributes=True)
    container, expected = ls.encode(surface), topologies(surface)
    decoder = ls.Decoder()
    for place in range(0, len(container), 100):
        for view in decoder.feed(container[place : place + 100]):
            assert topologies(view.surface()) == expected  # metadata and index have not come


def test_sides_nearly_at_one_place_stay_apart_although_they_are_coded_as_one() -> None:
    grid = np.random.default_rng(0).random((9, 17, 3))
    blocks = [grid[:, :9], grid[:, 8:] + 0.0]
    blocks[1][3, 0, 0] = np.nextafter(blocks[1][3, 0, 0], 2)
    surface = ls.Surface(blocks=[ls.Block(block) for block in blocks])
    decoder = decoded(surface)
    assert decoder.header is not None
    assert len(weld(surface).source) == 2 * 81 - 8
    for view in decoder.layers:
        assert topologies(view.surface()) == topologies(surface)
    places = [block.points.reshape(-1, 3) for block in decoder.surface().blocks]
    text = written(decoder.surface(), "ply")
    vertices = PlyData.read(io.BytesIO(text))["vertex"]
    found = {tuple(map(float, row)) for row in vertices.data}
    assert {tuple(row) for row in np.concatenate(places).tolist()} == found  # no value is lost


def test_a_seam_that_repeats_in_the_file_is_joined_to_its_block_at_every_layer(tmp_path: Path) -> None:
    from lodestream.coordinates.seams import merge

    points = torus().points.astype(np.float64)
    ring = np.concatenate([points, points[:, :1]], axis=1)
    rings = [np.concatenate([patch, patch[:1]]) for patch in (ring[:, :19], ring[:, 18:])]
    rings = [rings[0], ring[:, 18:] + 0.0, ring[:8, :5] + 7.0]
    rings[1] = np.concatenate([rings[1], rings[1][:1]])
    surface = merge(ls.Surface(blocks=[ls.Block(patch) for patch in rings]))
    assert surface.metadata["seam"] == ["rows", "rows", ""]
    expected = topologies(surface)
    for view in decoded(surface).layers:
        assert topologies(view.surface()) == expected


def test_a_window_has_the_faces_of_its_patch() -> None:
    surface = sphere()
    decoder = decoded(surface)
    region = (0, 9), (3, 14)
    expected = topologies(decoder.layers[-1].window(region))
    for view in decoder.layers:
        assert topologies(view.window(region)) == expected
    assert expected["obj"] == (9 * 11, expected["obj"][1])


def test_interfaces_that_meet_share_the_vertex() -> None:
    line = np.stack([np.arange(5.0), np.zeros(5), np.sin(np.arange(5.0))], -1)[:, None]
    blocks = [ls.Block(line), ls.Block(line[-1] + line[:, 0][:, None] - line[0, 0])]
    surface = ls.Surface(blocks=blocks)
    expected = 9, [[k, k + 1] for k in range(1, 9)]
    assert of_obj(written(surface, "obj")) == expected
    for view in decoded(surface).layers:
        assert of_obj(written(view.surface(), "obj")) == expected


def surface_of(blocks: list[LatticeBlock], kind: str, seed: int) -> ls.Surface | None:
    """Points of layouts as a surface, with attributes that agree where points do, nowhere, here and there, or none."""
    rng = np.random.default_rng(seed)
    usable = [b for b in blocks if b.coordinates[..., 0].size > 1 and (b.mask is None or b.mask.any())]
    if not usable:
        return None
    made = []
    for block in usable:
        points = block.coordinates.astype(np.int64)
        values = {
            "none": None,
            "agree": points[..., 0] % 7,
            "apart": rng.integers(0, 2**40, points.shape[:2]),
            "mixed": points[..., 0] % 7 + (rng.random(points.shape[:2]) < 0.1),
        }[kind]
        made.append(
            ls.Block(points, block.closed, mask=block.mask, attributes=None if values is None else {"a": values})
        )
    return ls.Surface(blocks=made)


KINDS = st.sampled_from(["none", "agree", "apart", "mixed"])


@examples(8)
@given(
    blocks=st.one_of(layouts(largest=6), overlapping(largest=6), tubes()),
    kind=KINDS,
    bits=st.integers(0, 4),
    seed=st.integers(0, 99),
    joined=st.booleans(),
)
def test_rough_values_do_not_change_the_faces(
    blocks: list[LatticeBlock], kind: str, bits: int, seed: int, joined: bool
) -> None:
    surface = surface_of(blocks, kind, seed)
    if surface is None:
        return
    if joined:
        surface.metadata["faces"] = {"joined": True}
    expected = weld(surface)
    decoder = decoded(surface)
    assert decoder.header is not None
    for view in decoder.layers:
        for shown in (view.surface(), roughly(view.surface(), bits)):
            found = weld(shown)
            for field in ("source", "quads", "triangles", "edges", "joined"):
                np.testing.assert_array_equal(getattr(found, field), getattr(expected, field))
    for level in range(decoder.header.levels):
        coarse = weld(decoder.surface(level))
        found = weld(roughly(decoder.surface(level), bits))
        for field in ("source", "quads", "triangles", "edges", "joined"):
            np.testing.assert_array_equal(getattr(found, field), getattr(coarse, field))


def test_places_of_points_are_not_compared_where_the_structure_is_known() -> None:
    container = ls.encode(cube_sphere())
    surface = ls.decode(container)
    expected: list[NDArray[np.int64]] = [weld(surface).quads, weld(surface).joined]
    for block in surface.blocks:
        block.points[...] = 0  # all at one place
    assert np.array_equal(weld(surface).quads, expected[0])
    assert np.array_equal(weld(surface).joined, expected[1])
