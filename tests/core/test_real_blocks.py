"""The curvilinear and multi-block files of ../shared/data: read as their README says, streamed bit for bit, written."""

from __future__ import annotations

import functools
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream import formats
from lodestream.encoding.lattice_coordinates import lattice_coordinates
from lodestream.encoding.prepared import prepare
from lodestream.errors import FormatWarning
from lodestream.surface import Block, Surface

#: What these files have that a surface, or a mesh that is written, has not.
pytestmark = [
    pytest.mark.filterwarnings("ignore:VIEWPOINT .* left out:lodestream.errors.FormatWarning"),
    pytest.mark.filterwarnings("ignore:.* is written without single numbers.*:lodestream.errors.FormatWarning"),
]

DATA = Path(__file__).parents[3] / "shared" / "data"


@dataclass(frozen=True)
class Row:
    """What the README says of a file, and what follows from it.

    Attributes
    ----------
    shapes : tuple of (rows, columns)
        README has columns x rows, or i x j x k.
    vertices : int
        Of the welded mesh.
    edges : int
        Edges of its border; not looked at where there are holes.
    """

    files: tuple[str, ...]
    shapes: tuple[tuple[int, int], ...]
    vertices: int
    edges: int
    options: dict[str, Any] = field(default_factory=dict)
    holes: int = 0
    attributes: tuple[str, ...] = ()
    dtype: str = "float64"
    default_plane: bool = False


def perimeter(rows: int, columns: int) -> int:
    return 2 * (rows - 1) + 2 * (columns - 1)


M6 = ((17, 65), (65, 73), (65, 17), (73, 65), (17, 73), (73, 17), (17, 17), (17, 17), (17, 73))

ROWS = [
    Row(("m6_small.fmt",), M6, 15321, 176),
    Row(("uneven_sphere_large.fmt",), ((33, 33),) * 6, 6146, 0),
    Row(("step_grdgen.fmt",), ((65, 25), (113, 129)), 16200, 654, default_plane=True),
    Row(("combxyz.bin",), ((25, 33),), 825, perimeter(25, 33), dtype="float32", default_plane=True),
    Row(
        ("combxyz.bin", "combq.bin"),
        ((33, 57),),
        33 * 57,
        perimeter(33, 57),
        {"plane": "k-1"},
        attributes=("density", "momentum", "stagnation_energy"),
        dtype="float32",
    ),
    Row(("multi-bin.xyz",), ((12, 12),) * 2, 288, 88, default_plane=True),
    Row(("multi-bin-C.xyz",), ((12, 8),) * 2, 180, 50, {"plane": "j0"}),
    Row(("multi-ascii.xyz",), ((12, 8),), 96, perimeter(12, 8), {"plane": "k0", "block": "2"}),
    Row(("multi-bin-2D.xyz",), ((17, 11),) * 2, 357, 72),
    Row(
        ("StructuredGrid.vts",),
        ((12, 6),),
        72,
        perimeter(12, 6),
        {"plane": "k0"},
        attributes=("Density", "Momentum", "StagnationEnergy"),
        dtype="float32",
    ),
    Row(
        ("office.binary.vtk",),
        ((20, 20),),
        400,
        perimeter(20, 20),
        attributes=("scalars", "vectors"),
        dtype="float32",
        default_plane=True,
    ),
    Row(("plate_surf.cgns",), ((17, 17),), 289, perimeter(17, 17)),
    Row(("corner.cgns",), ((16, 16),) * 2, 496, 90),
    Row(("bun000.ply",), ((400, 512),), 40256, 0, holes=204800 - 40256, dtype="float32"),
    Row(("capture0001.pcd",), ((480, 640),), 307200 - 57553, 0, holes=57553, dtype="float32"),
]
names = [" ".join(row.files) + "".join(f" {key}={value}" for key, value in row.options.items()) for row in ROWS]


def read(row: Row) -> Surface:
    return _read(ROWS.index(row))


@functools.cache
def _read(number: int) -> Surface:
    row = ROWS[number]
    for name in row.files:
        if not (DATA / name).exists():
            pytest.skip(f"the real file {name} is not beside this project")
    if row.files[0].rpartition(".")[2] in ("vts", "vtk", "cgns"):
        pytest.importorskip("vtkmodules")
    paths = [DATA / name for name in row.files]
    if not row.default_plane:
        return formats.read(*paths, **row.options)
    with pytest.warns(FormatWarning, match="took plane i0 of a volume of"):
        return formats.read(*paths, **row.options)


def streamed(row: Row) -> bytes:
    return _streamed(ROWS.index(row))


@functools.cache
def _streamed(number: int) -> bytes:
    return ls.encode(_read(number))


def written(surface: Surface, kind: str) -> bytes:
    file = io.BytesIO()
    formats.write_stream(surface, kind, file)
    return file.getvalue()


@pytest.mark.sweep(8)
@pytest.mark.parametrize("row", ROWS, ids=names)
@pytest.mark.long
def test_a_real_file_is_read_as_its_readme_says(row: Row) -> None:
    surface = read(row)
    assert tuple(block.shape for block in surface.blocks) == row.shapes
    assert all(block.closed == (False, False) for block in surface.blocks)
    assert sum(block.holes for block in surface.blocks) == row.holes
    assert tuple(surface.blocks[0].attributes) == row.attributes
    assert surface.dtype.name == row.dtype
    assert ("plane" in surface.metadata) == (row.default_plane or "plane" in row.options)


@pytest.mark.sweep(5)
@pytest.mark.parametrize("row", ROWS, ids=names)
@pytest.mark.long
def test_a_real_file_streams_bit_for_bit(row: Row) -> None:
    surface = read(row)
    back = ls.decode(streamed(row))
    assert len(back.blocks) == len(surface.blocks)
    for got, given in zip(back.blocks, surface.blocks, strict=True):
        assert got.closed == given.closed
        assert (got.mask is None) == (given.mask is None)
        valid = np.ones(given.shape, np.bool_) if given.mask is None else given.mask
        if got.mask is not None:
            np.testing.assert_array_equal(got.mask, valid)
        assert got.points[valid].tobytes() == given.points[valid].tobytes()
        assert got.attributes.keys() == given.attributes.keys()
        for name, values in given.attributes.items():
            assert got.attributes[name][valid].tobytes() == values[valid].tobytes()
    for key, value in surface.metadata.items():
        assert back.metadata[key] == value


@pytest.mark.sweep(5)
@pytest.mark.parametrize("row", ROWS, ids=names)
@pytest.mark.long
def test_a_real_file_is_written_as_one_welded_mesh(row: Row) -> None:
    trimesh = pytest.importorskip("trimesh")
    surface = read(row)
    for kind in ("ply", "glb") if not row.attributes else ("ply",):
        if kind == "glb" and row.dtype == "float64":
            continue  # it rounds to float32, which tests of the writer look at
        mesh = trimesh.load(io.BytesIO(written(surface, kind)), file_type=kind, process=False, force="mesh")
        assert len(mesh.vertices) == row.vertices
        assert mesh.is_winding_consistent or len(surface.blocks) > 1
        if not row.holes:
            edges, counts = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
            assert (counts <= 2).all()
            assert int((counts == 1).sum()) == row.edges
            assert len(np.unique(edges)) == row.vertices
        valid = np.concatenate([_valid(block) for block in surface.blocks])
        if len(surface.blocks) == 1:
            np.testing.assert_array_equal(mesh.vertices, valid)
        else:
            assert set(map(tuple, valid.tolist())) == set(map(tuple, mesh.vertices.tolist()))


def _valid(block: Block) -> NDArray[Any]:
    points = block.points.reshape(-1, block.points.shape[2]).astype(np.float64)
    points = points if block.mask is None else points[block.mask.reshape(-1)]
    if points.shape[1] == 2:
        points = np.concatenate([points, np.zeros((len(points), 1))], axis=1)
    result: NDArray[Any] = points + 0.0
    return result


@pytest.mark.parametrize("name", ["combxyz.bin", "StructuredGrid.vts", "bun000.ply"])
def test_levels_are_within_the_lattice_of_the_optimum_of_the_filled_grid(name: str) -> None:
    row = next(row for row in reversed(ROWS) if row.files[0] == name)
    surface = read(row)
    decoder = ls.Decoder()
    decoder.feed(streamed(row))
    decoder.finish()
    prepared = prepare(surface, ls.Quality())
    assert decoder.header is not None
    for channel, lattice in enumerate(decoder.header.lattices[:3]):  # those of attributes follow
        filled = lattice_coordinates(prepared, channel, lattice)[0]
        for number, optimum in enumerate(ls.hierarchy(filled, surface.closed)):
            level = decoder.surface(number)
            if level.mask is None and surface.mask is not None:
                continue  # no node of so coarse a level stands for a valid one
            valid = np.ones(level.shape, np.bool_) if level.mask is None else level.mask
            away = lattice.coordinates(level.points[..., channel][valid]) - optimum[valid]
            assert np.abs(away).max() <= 5  # four steps, and one where values are rounded to their type


def sides(block: Block) -> list[NDArray[Any]]:
    points = block.points
    return [points[0], points[-1], points[:, 0], points[:, -1]]


@pytest.mark.parametrize(
    ("name", "shared", "free"), [("m6_small.fmt", 16, 4), ("uneven_sphere_large.fmt", 12, 0), ("corner.cgns", 1, 6)]
)
def test_sides_are_shared_bit_for_bit(name: str, shared: int, free: int) -> None:
    surface = read(next(row for row in ROWS if row.files == (name,)))
    lines = [min(side.tobytes(), side[::-1].tobytes()) for block in surface.blocks for side in sides(block)]
    counts = np.unique(np.array([hash(line) for line in lines]), return_counts=True)[1]
    assert (int((counts == 2).sum()), int((counts == 1).sum())) == (shared, free)
    if name == "m6_small.fmt":
        alone = [side for block in surface.blocks for side in sides(block) if lines.count(_either(side)) == 1]
        assert all((side[:, 2] == 0).all() for side in alone)


def _either(side: NDArray[Any]) -> bytes:
    return min(side.tobytes(), side[::-1].tobytes())


def test_the_planes_of_the_step_are_identical() -> None:
    row = next(row for row in ROWS if row.files == ("step_grdgen.fmt",))
    first = read(row)
    second = formats.read(DATA / "step_grdgen.fmt", plane="i1")
    for one, two in zip(first.blocks, second.blocks, strict=True):
        np.testing.assert_array_equal(one.points[..., [0, 2]], two.points[..., [0, 2]])
        assert len(np.unique(one.points[..., 1])) == len(np.unique(two.points[..., 1])) == 1


def test_one_grid_in_three_files_is_one_surface() -> None:
    surfaces = []
    for name in ("multi-bin.xyz", "multi-bin-C.xyz", "multi-ascii.xyz"):
        if not (DATA / name).exists():
            pytest.skip(f"the real file {name} is not beside this project")
        surfaces.append(formats.read(DATA / name, plane="k3"))
    for block, other, text in zip(*(surface.blocks for surface in surfaces), strict=True):
        np.testing.assert_array_equal(block.points, other.points)
        np.testing.assert_allclose(block.points, text.points, atol=1e-6)
