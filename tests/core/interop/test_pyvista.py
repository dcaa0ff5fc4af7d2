"""Surfaces as pyvista's grids and back; containers read by pyvista."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream.formats.placed import Coordinate, place
from lodestream.interop import pyvista_grids
from tests.core.surfaces import terrain, torus

pv = pytest.importorskip("pyvista")


def test_heights_stand_over_their_coordinates_and_holes_are_hidden() -> None:
    mask = np.ones((20, 30), np.bool_)
    mask[4:8, 10:12] = False
    attributes = {"speed": np.arange(600.0).reshape(20, 30), "normal": np.ones((20, 30, 3), "f4")}
    metadata = {"geotransform": [0.0, 2.0, 0.0, 0.0, 0.0, -1.0], "unit": "m", "name": "hill", "crs": 'LOCAL_CS["x"]'}
    surface = ls.Surface(terrain((20, 30)).astype("i2"), mask=mask, attributes=attributes, metadata=metadata)
    grid = surface.to_pyvista()
    assert isinstance(grid, pv.StructuredGrid)
    assert grid.dimensions == (30, 20, 1)
    points = grid.points.reshape(20, 30, 3)
    assert np.array_equal(points[mask][:, 2], surface.points[mask])
    assert np.array_equal(points[0, 1:, 0], np.arange(3, 60, 2))
    assert grid.point_data.active_normals_name == "normal"
    assert grid.bounds.z_min >= surface.points[mask].min()
    # What VTK draws: the faces without a corner in a hole.
    whole = mask[:-1, :-1] & mask[:-1, 1:] & mask[1:, :-1] & mask[1:, 1:]
    drawn = grid.extract_surface(algorithm="dataset_surface")
    assert (drawn.cell_data["vtkGhostType"] == 0).sum() == whole.sum()
    grid.field_data.remove("lodestream")  # as of a grid that somebody else has made
    back = ls.Surface.from_pyvista(grid)
    assert back.mask is not None
    assert np.array_equal(back.mask, mask)
    assert np.array_equal(back.points[mask], points[mask])
    assert np.array_equal(back.attributes["speed"], attributes["speed"])
    assert {key: back.metadata[key] for key in ("unit", "name", "crs")} == {
        key: metadata[key] for key in ("unit", "name", "crs")
    }


def test_closed_axes_repeat_their_first_points_and_are_closed_again() -> None:
    surface = ls.Surface(torus(24, 32), (True, True))
    grid = surface.to_pyvista()
    assert grid.dimensions == (33, 25, 1)
    back = ls.Surface.from_pyvista(grid)
    assert back.closed == (True, True)
    assert np.array_equal(back.points, surface.points)


def around() -> ls.Surface:
    """Heights around the Earth, whose longitudes go on over 180 degrees, with a column that repeats the first."""
    values = terrain((9, 36)).astype("f4")
    metadata = {
        "geotransform": [95.0, 10.0, 0.0, 45.0, 0.0, -10.0],
        "angles": [{"channel": 0, "period": 360.0, "low": -180.0}],
        "seam": "cols",
    }
    return ls.Surface(values, (False, True), metadata=metadata)


def curved() -> ls.Surface:
    """Points on a curved grid around the Earth, with longitudes in float32 that jump."""
    lat, lon = np.meshgrid(np.linspace(-60, 60, 13), np.arange(0.0, 360.0, 10.0), indexing="ij")
    east = (lon + 100.1 + lat / 10 + 180) % 360 - 180
    found = place(
        terrain((13, 36)).astype("f4"),
        Coordinate(east.astype("f4"), None, True),
        Coordinate(lat.astype("f4"), None),
        closed=None,
    )
    assert found.closed == (False, True)
    assert {"angles", "dtype"} <= set(found.metadata)
    return found


def surfaces() -> dict[str, ls.Surface]:
    mask = np.ones((20, 30), np.bool_)
    mask[4:8, 10:12] = False
    place = {"geotransform": [0.0, 2.0, 0.0, 0.0, 0.0, -1.0], "unit": "m", "nodata": -9999, "tags": {"": {"a": "b"}}}
    heights = terrain((20, 30))
    return {
        "integers with holes": ls.Surface(
            heights.astype("i2"), mask=mask, attributes={"n": mask.astype("u1")}, metadata=place
        ),
        "planar": ls.Surface(torus(8, 9)[..., :2], (True, False)),
        "integers in space": ls.Surface((torus(8, 9) * 1000).astype("i4"), (True, True), metadata={"name": "t"}),
        "closed heights": ls.Surface(heights, (False, True), metadata={"geotransform": place["geotransform"]}),
        "around the Earth": around(),
        "curved": curved(),
        "blocks": ls.Surface(
            blocks=[ls.Block(torus(8, 9), (True, False)), ls.Block(torus(5, 6) + 9)],
            metadata={"faces": [{"left_out": [3, 1]}, {}], "unit": "mm"},
        ),
    }


@pytest.mark.parametrize("name", surfaces())
def test_type_place_holes_and_closed_axes_come_back(name: str, tmp_path: Path) -> None:
    surface = surfaces()[name]
    grid = surface.to_pyvista()
    grid.save(tmp_path / ("a.vtm" if len(surface.blocks) > 1 else "a.vts"))
    for found in (grid, pv.read(tmp_path / ("a.vtm" if len(surface.blocks) > 1 else "a.vts"))):
        back = ls.Surface.from_pyvista(found)
        assert back.metadata == surface.metadata
        for one, other in zip(back.blocks, surface.blocks, strict=True):
            assert (one.closed, one.points.dtype) == (other.closed, other.points.dtype)
            valid = np.ones(one.shape, np.bool_) if other.mask is None else other.mask
            assert (one.mask is None) == (other.mask is None)
            assert one.mask is None or np.array_equal(one.mask, valid)
            assert np.array_equal(one.points[valid], other.points[valid])


@pytest.mark.parametrize("change", ["moved", "raised", "cut", "hidden", "text"])
def test_what_has_changed_in_pyvista_is_kept(change: str) -> None:
    surface = surfaces()["integers with holes"]
    grid: Any = surface.to_pyvista()
    if change == "moved":
        grid.points[:, 0] += 1
    elif change == "raised":
        grid.points[:, 2] += 0.5
    elif change == "cut":
        grid = grid.extract_subset((0, 9, 0, 8, 0, 0))
    elif change == "hidden":
        grid.hide_points([0])
    else:
        grid.field_data["lodestream"] = ['{"block": 0, "blocks": 1, "shape": 3}']
    back = ls.Surface.from_pyvista(grid)
    if change == "raised":  # the place is still true, the type is not
        assert back.metadata == surface.metadata
        assert np.array_equal(back.points[back.mask], surface.points[surface.mask] + 0.5)
    else:
        assert "geotransform" not in back.metadata
        assert back.points.shape == (*((9, 10) if change == "cut" else (20, 30)), 3)


@pytest.mark.parametrize("name", ["around the Earth", "curved", "closed heights"])
def test_longitudes_do_not_jump_in_a_mesh(name: str) -> None:
    surface = surfaces()[name]
    grid: Any = surface.to_pyvista()
    columns, rows, _ = grid.dimensions
    assert columns == surface.shape[1] + 1
    x = grid.points[:, 0].reshape(rows, columns)
    steps = np.diff(x, axis=1)
    assert (steps > 0).all()
    assert steps.max() < 1.5 * steps.min()


def test_a_valid_point_among_holes_and_a_closed_axis_with_holes_come_back() -> None:
    points = torus(12, 16)
    mask = np.ones((12, 16), np.bool_)
    mask[:, 15] = mask[3:8, :4] = False
    mask[5, 1] = True
    back = ls.Surface.from_pyvista(ls.Surface(points, (True, True), mask=mask).to_pyvista())
    assert back.closed == (True, True)
    assert back.mask is not None
    assert np.array_equal(back.mask, mask)


def test_several_blocks_are_a_multiblock() -> None:
    surface = ls.Surface(blocks=[ls.Block(torus(8, 9)), ls.Block(torus(5, 6))])
    blocks = surface.to_pyvista()
    assert isinstance(blocks, pv.MultiBlock)
    assert blocks.keys() == ["block_0", "block_1"]
    nested = pv.MultiBlock([pv.MultiBlock([blocks[0]]), None, blocks[1]])
    back = ls.Surface.from_pyvista(nested)
    assert [block.shape for block in back.blocks] == [(8, 9), (5, 6)]
    assert np.array_equal(back.blocks[1].points, surface.blocks[1].points)


def test_hidden_cells_between_valid_points_come_back() -> None:
    grid = ls.Surface(torus(8, 9)).to_pyvista()
    grid.hide_cells([12, 13], inplace=True)
    back = ls.Surface.from_pyvista(grid)
    assert back.mask is None
    again = back.to_pyvista()
    assert np.array_equal(again.cell_data["vtkGhostType"], grid.cell_data["vtkGhostType"])


@pytest.mark.parametrize("flat", [0, 1, 2])
def test_a_plane_in_any_direction_of_other_grids_is_a_surface(flat: int) -> None:
    dims = [4, 5, 6]
    dims[flat] = 1
    image = pv.ImageData(dimensions=dims)
    image["v"] = np.arange(image.n_points)
    surface = ls.Surface.from_pyvista(image)
    assert surface.points.reshape(-1, 3).tolist() == image.points.tolist()
    assert surface.attributes["v"].ravel().tolist() == list(range(image.n_points))
    assert ls.Surface.from_pyvista(image.cast_to_rectilinear_grid()).shape == surface.shape


def test_polygons_that_are_a_grid_become_one() -> None:
    grid = ls.Surface(torus(8, 9), attributes={"n": np.arange(72).reshape(8, 9)}).to_pyvista()
    mesh = grid.cast_to_unstructured_grid().extract_surface(algorithm="dataset_surface")
    surface = ls.Surface.from_pyvista(mesh)
    assert sorted(surface.shape) == [8, 9]
    assert sorted(surface.attributes["n"].ravel().tolist()) == list(range(72))
    assert ls.Surface.from_pyvista(mesh.triangulate()).points.shape == surface.points.shape


def test_data_of_cells_are_left_out_with_a_note() -> None:
    grid = ls.Surface(torus(8, 9)).to_pyvista()
    grid.cell_data["pressure"] = np.arange(grid.n_cells)
    with pytest.warns(ls.FormatWarning, match="pressure"):
        ls.Surface.from_pyvista(grid)


def refused() -> list[tuple[Any, str]]:
    return [
        (pv.ImageData(dimensions=(3, 4, 5)), "got a volume of 3 x 4 x 5"),
        (pv.MultiBlock(), "without any"),
        (pv.UnstructuredGrid(), "got UnstructuredGrid"),
        (pv.PolyData(np.zeros((4, 3))), "no face"),
        (pv.Polygon(n_sides=5), "got 5 in face 1"),
        (np.zeros((3, 3, 3)), "expected a grid of pyvista, got ndarray"),
    ]


@pytest.mark.parametrize(("data", "words"), refused())
@pytest.mark.filterwarnings("ignore::pyvista.core.errors.PyVistaDeprecationWarning")
def test_what_is_no_surface_is_refused(data: Any, words: str) -> None:
    with pytest.raises(ls.InputError, match=words):
        ls.Surface.from_pyvista(data)


def test_a_container_is_read_whole_or_at_a_level(tmp_path: Path) -> None:
    surface = ls.Surface(terrain((65, 80)).astype("f4"), attributes={"n": np.ones((65, 80), "u1")})
    path = tmp_path / "a.lode"
    path.write_bytes(ls.encode(surface))
    grid = pyvista_grids.read(path)
    assert np.array_equal(grid.points[:, 2].reshape(65, 80), surface.points)
    coarse = pyvista_grids.read(path, level=2)
    decoder = ls.Decoder()
    decoder.feed(path.read_bytes())
    assert coarse.dimensions[:2] == decoder.surface(2).shape[::-1]
    with pytest.raises(ls.OptionError, match="level"):
        pyvista_grids.read(path, level=99)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(ls.TruncatedStreamError) as cut:
        pyvista_grids.read(path)
    assert cut.value.__notes__ == [f"in {path}"]


@pytest.mark.parametrize("polygons", [False, True])
def test_data_that_are_no_numbers_are_left_out_with_a_note(polygons: bool) -> None:
    rows, columns = np.mgrid[0:4.0, 0:5.0]
    grid: Any = ls.Surface(np.stack((columns, rows, rows * columns), axis=-1)).to_pyvista()
    grid.point_data["flag"] = np.ones(20, bool)
    with pytest.warns(ls.FormatWarning, match="no numbers: flag"):
        found = ls.Surface.from_pyvista(grid.extract_surface(algorithm=None) if polygons else grid)
    assert "flag" not in found.attributes
