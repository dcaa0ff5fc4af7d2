"""Surfaces as xarray's Datasets and back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import lodestream as ls
from lodestream.coordinates.height_fields import coordinates
from tests.core.surfaces import terrain, torus

WGS84 = 'GEOGCRS["WGS 84",DATUM["World Geodetic System 1984",ELLIPSOID["WGS 84",6378137,298.257223563]]]'


def dataset(surface: ls.Surface) -> xr.Dataset:
    found = surface.to_xarray()
    assert isinstance(found, xr.Dataset)
    return found


def assert_same(found: ls.Surface, surface: ls.Surface) -> None:
    """Blocks, types, holes and attributes are the same, and so are the metadata."""
    assert len(found.blocks) == len(surface.blocks)
    for one, other in zip(found.blocks, surface.blocks, strict=True):
        assert one.closed == other.closed
        assert one.points.dtype == other.points.dtype
        assert (one.mask is None) == (other.mask is None)
        valid = np.ones(one.shape, np.bool_) if other.mask is None else other.mask
        assert one.mask is None or np.array_equal(one.mask, valid)
        assert np.array_equal(one.points[valid], other.points[valid])
        assert list(one.attributes) == list(other.attributes)
        for name, values in other.attributes.items():
            assert one.attributes[name].dtype == values.dtype
            assert np.array_equal(one.attributes[name], values, equal_nan=values.dtype.kind == "f")
    assert found.metadata == surface.metadata


def heights(dtype: str = "int16", **metadata: Any) -> ls.Surface:
    values = terrain((40, 50)).astype(dtype)
    attributes = {
        "speed": np.linspace(0, 1, 2000, dtype="f4").reshape(40, 50),
        "wind": np.arange(6000).reshape(40, 50, 3),
    }
    return ls.Surface(values, attributes=attributes, metadata=metadata)


def test_heights_lie_over_coordinates_with_crs_and_geotransform_as_rioxarray_has_them() -> None:
    surface = heights(geotransform=[100.0, 0.5, 0.0, 20.0, 0.0, -0.25], crs=WGS84, unit="m", name="hill")
    found = dataset(surface)
    assert found.z.dims == ("y", "x")
    assert found.z.dtype == np.int16
    assert found.z.attrs["units"] == "m"
    assert found.z.encoding["grid_mapping"] == "spatial_ref"
    assert found.x.values.tolist() == [100.25 + 0.5 * k for k in range(50)]
    assert found.y.values.tolist() == [19.875 - 0.25 * k for k in range(40)]
    assert found.x.attrs["standard_name"] == "longitude"
    assert found.spatial_ref.attrs["crs_wkt"] == WGS84
    assert found.spatial_ref.attrs["GeoTransform"] == "100.0 0.5 0.0 20.0 0.0 -0.25"
    assert found.wind.dims == ("y", "x", "wind_component")
    assert float(found.z.sel(x=100.25, y=19.875)) == surface.points[0, 0]
    assert_same(ls.Surface.from_xarray(found), surface)


@pytest.mark.parametrize("dtype", ls.surface.DTYPES)
def test_every_type_with_holes_comes_back(dtype: str) -> None:
    values = np.abs(terrain((30, 20))).astype("uint8").astype(dtype)
    mask = np.ones(values.shape, np.bool_)
    mask[3:9, 5:] = False
    surface = ls.Surface(values, mask=mask)
    found = dataset(surface)
    assert found.z.dtype.kind == "f"
    assert np.array_equal(np.isnan(found.z.values), ~mask)
    assert_same(ls.Surface.from_xarray(found), surface)


def test_the_value_for_holes_in_a_file_is_one_that_no_point_has(tmp_path: Path) -> None:
    values = np.arange(256, dtype="uint8").reshape(16, 16)
    values[values == 77] = 78
    mask = np.ones(values.shape, np.bool_)
    mask[0, 5] = mask[15, 15] = False
    values[0, 5], values[15, 14] = 9, 255
    surface = ls.Surface(values, mask=mask, metadata={"nodata": 9})
    found = dataset(surface)
    assert found.z.encoding["_FillValue"] == 5  # 9 is a value, so are both ends
    found.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "a.nc", mask_and_scale=False) as stored:
        assert stored.z.dtype == np.uint8
    with xr.open_dataset(tmp_path / "a.nc") as again:
        assert_same(ls.Surface.from_xarray(again), surface)


def test_integers_with_holes_that_a_double_does_not_hold_are_refused() -> None:
    surface = ls.Surface([[2**60 + 1, 2], [3, 4]], mask=[[True, True], [True, False]])
    with pytest.raises(ls.FormatError, match="holes are NaN in xarray"):
        surface.to_xarray()
    assert dataset(ls.Surface([[2**60 + 1, 2], [3, 4]])).z.values[0, 0] == 2**60 + 1


def test_kept_holes_stay_infinite() -> None:
    values = terrain((8, 9))
    values[2, 3], values[4, 4] = np.inf, np.nan
    found = dataset(ls.Surface(values))
    assert np.array_equal(found.z.values, values, equal_nan=True)


@pytest.mark.parametrize("width", [2, 3])
def test_points_lie_over_rows_and_columns_with_x_and_y_of_both(width: int) -> None:
    points = torus(24, 32)[..., :width]
    surface = ls.Surface(points, (True, True), attributes={"x": np.arange(768).reshape(24, 32)}, metadata={"name": "t"})
    found = dataset(surface)
    assert found.x.dims == ("row", "column")
    assert ("z" in found) == (width == 3)
    assert np.array_equal(found.y.values, points[..., 1])
    assert_same(ls.Surface.from_xarray(found), surface)


def test_channels_beyond_the_third_are_variables_and_come_back_as_attributes() -> None:
    points = np.concatenate([torus(8, 9), np.ones((8, 9, 1), "f4")], axis=2)
    back = ls.Surface.from_xarray(ls.Surface(points, (True, True)).to_xarray())
    assert np.array_equal(back.points, points[..., :3])
    assert (back.attributes["attribute_0"] == 1).all()


def test_a_rotated_raster_has_coordinates_over_both_and_comes_back_as_heights() -> None:
    surface = heights("float32", geotransform=[10.0, 0.5, 0.25, 20.0, 0.25, -0.5])
    found = dataset(surface)
    assert found.xc.dims == ("y", "x")
    assert np.array_equal(found.yc.values, coordinates(surface)[1])
    assert_same(ls.Surface.from_xarray(found), surface)
    part = ls.Surface.from_xarray(found.isel(x=slice(3, 9)))
    assert np.array_equal(part.points[..., 0], coordinates(surface)[0][:, 3:9])


@pytest.mark.parametrize(
    "metadata",
    [
        {"axes": {"x": [0, 2], "y": [5, 1], "rows": "x"}, "geotransform": [-1.0, 0.0, 2.0, 4.5, 1.0, 0.0]},
        {"axes": {"x": [*np.cumsum(np.linspace(1, 1.001, 50)).tolist(), "values"], "y": [0, 0.1]}},
    ],
)
def test_axes_of_their_own_are_coordinates(metadata: dict[str, Any]) -> None:
    surface = heights(**metadata)
    found = dataset(surface)
    x, y = coordinates(surface)
    x_axis = 0 if metadata["axes"].get("rows") else 1
    assert found.z.dims == (("x", "y") if x_axis == 0 else ("y", "x"))
    assert np.array_equal(np.broadcast_to(found.x.values[:, None] if x_axis == 0 else found.x.values, x.shape), x)
    back = ls.Surface.from_xarray(found)
    for one, other in zip(coordinates(back), (x, y), strict=True):
        assert np.array_equal(one, other)


def test_a_level_with_a_gap_has_its_coordinates() -> None:
    decoder = ls.Decoder()
    decoder.feed(ls.encode(heights(geotransform=[0.0, 1.0, 0.0, 0.0, 0.0, -1.0])))
    level = decoder.surface(1)
    found = dataset(level)
    x, y = coordinates(level)
    assert np.array_equal(found.x.values, x[0])
    assert np.array_equal(found.y.values, y[:, 0])


def test_several_blocks_are_a_tree_and_holes_and_closed_axes_come_back() -> None:
    mask = np.ones((5, 6), np.bool_)
    mask[2, 2] = False
    blocks = [ls.Block(torus(8, 9), (True, False)), ls.Block(torus(5, 6), mask=mask)]
    surface = ls.Surface(blocks=blocks, metadata={"unit": "mm"})
    tree = surface.to_xarray()
    assert isinstance(tree, xr.DataTree)
    assert list(tree.children) == ["block_0", "block_1"]
    assert_same(ls.Surface.from_xarray(tree), surface)


def test_tags_are_attributes_and_other_metadata_come_back() -> None:
    texts = {"NC_GLOBAL#title": "T", "depth#long_name": "depth of water", "speed#comment": "c", "other": "1"}
    tags = {"": texts, "IMAGE": {"a": "b"}}
    surface = heights(variable="depth", tags=tags, scalars={"t": 1.5}, foreign={"me": [1]})
    found = dataset(surface)
    assert found.attrs["title"] == "T"
    assert found.depth.attrs["long_name"] == "depth of water"
    assert_same(ls.Surface.from_xarray(found), surface)


def test_tags_about_how_a_file_packs_its_values_change_none(tmp_path: Path) -> None:
    packing = {"scale_factor": "0.1", "add_offset": "5", "_FillValue": "3", "grid_mapping": "crs"}
    tags = {"": {f"{name}#{key}": text for name in ("z", "speed") for key, text in packing.items()}}
    surface = heights(crs='LOCAL_CS["site"]', geotransform=[0, 1, 0, 0, 0, 1], tags=tags)
    found = dataset(surface)
    assert not set(packing) & {*found.z.attrs, *found.speed.attrs}
    assert_same(ls.Surface.from_xarray(found), surface)
    found.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as again:
        assert np.array_equal(again.speed, surface.attributes["speed"])
        assert np.array_equal(again.z, found.z, equal_nan=True)


def test_what_json_cannot_hold_is_left_out_with_a_note() -> None:
    with pytest.warns(ls.FormatWarning, match="without foreign"):
        heights(foreign={"me": b"\0"}).to_xarray()


def test_a_part_keeps_what_is_true_of_it_alone() -> None:
    surface = ls.Surface(torus(24, 32), (True, True), metadata={"unit": "m", "faces": {"diagonal": "main"}})
    part = ls.Surface.from_xarray(dataset(surface).isel(row=slice(4, 9)))
    assert part.closed == (False, True)
    assert part.metadata == {"unit": "m", "recognised": 0} or part.metadata == {"unit": "m"}


def test_arrays_and_datasets_of_others_are_read_as_netcdf_is() -> None:
    values = terrain((19, 36)).astype("f4")
    coords = {
        "lat": ("lat", np.linspace(-90, 90, 19), {"units": "degrees_north"}),
        "lon": ("lon", np.arange(0.0, 360.0, 10.0), {"units": "degrees_east"}),
    }
    array = xr.DataArray(values, coords, ("lat", "lon"), "temperature", {"units": "K"})
    surface = ls.Surface.from_xarray(array)
    assert surface.closed == (False, True)  # it goes around the Earth
    assert surface.metadata["unit"] == "K"
    assert surface.metadata["geotransform"] == [-5.0, 10.0, 0.0, -95.0, 0.0, 10.0]
    assert ls.Surface.from_xarray(array, closed=(False, False)).closed == (False, False)
    several = xr.Dataset({"temperature": array, "pressure": array + 1}, {"time": 3})
    with pytest.raises(ls.FormatError, match=r"temperature.*pressure.*variable="):
        ls.Surface.from_xarray(several)
    chosen = ls.Surface.from_xarray(several, variable="pressure")
    assert np.array_equal(chosen.points, values + 1)
    assert list(chosen.attributes) == ["temperature"]
    assert ls.Surface.from_xarray(several, variable="pressure", attributes=()).attributes == {}


def test_flags_become_0_and_1_and_what_is_no_number_is_named() -> None:
    values = terrain((6, 7))
    dates = np.full((6, 7), "2001-01-01", "datetime64[ns]")
    data = xr.Dataset({"depth": (("y", "x"), values), "land": (("y", "x"), values > 0)})
    found = ls.Surface.from_xarray(data)  # a flag is no second surface to choose from
    assert found.attributes["land"].dtype == np.uint8
    assert np.array_equal(found.attributes["land"] == 1, values > 0)
    assert list(ls.Surface.from_xarray(data, attributes=["land"]).attributes) == ["land"]
    assert np.array_equal(ls.Surface.from_xarray(data.land).points == 1, values > 0)
    assert ls.Surface.from_xarray(data[["land"]]).dtype == np.uint8
    texts = data.assign(word=(("y", "x"), dates.astype(str)))
    with pytest.warns(ls.FormatWarning, match="left out: word"):
        ls.Surface.from_xarray(texts)
    with pytest.raises(ls.OptionError, match=r"of numbers over y and x, got 'word' of <U"):
        ls.Surface.from_xarray(texts, attributes=["word"])
    dated = data.assign(day=(("y", "x"), dates))
    dated.day.encoding["units"] = "days since 2000-12-01"
    for surface in (ls.Surface.from_xarray(dated), ls.Surface.from_xarray(dated, attributes="day")):
        assert (surface.attributes["day"] == 31).all()  # as in a file
        assert surface.metadata["tags"][""]["day#units"] == "days since 2000-12-01"


@pytest.mark.parametrize("key", [{"row": slice(None, None, -1)}, {"column": slice(None, None, -1)}, "transposed"])
def test_rows_in_another_order_keep_nothing_that_is_true_of_their_order(key: Any) -> None:
    metadata = {
        "faces": {"diagonal": "main"},
        "poles": [{"block": 0, "side": "top", "kind": "fan"}],
        "turn": [0, 360.0, 1],
        "seam": "cols",
        "unit": "m",
    }
    surface = ls.Surface(torus(24, 24), (False, True), metadata=metadata)
    found = dataset(surface)
    assert_same(ls.Surface.from_xarray(found), surface)
    changed = found.transpose("column", "row") if key == "transposed" else found.isel(key)
    back = ls.Surface.from_xarray(changed)
    assert back.metadata == {"unit": "m"}
    assert back.closed == ((True, False) if key == "transposed" else (False, True))


def test_blocks_keep_what_is_true_of_their_order_where_none_has_another() -> None:
    blocks = [ls.Block(torus(8, 9)), ls.Block(torus(8, 9) + 9)]
    surface = ls.Surface(blocks=blocks, metadata={"faces": [{}, {"a": 1}]})
    tree: Any = surface.to_xarray()
    assert_same(ls.Surface.from_xarray(tree), surface)
    tree["block_1"] = tree["block_1"].isel(row=slice(None, None, -1))
    assert ls.Surface.from_xarray(tree).metadata == {}


@pytest.mark.parametrize("place", [{}, {"geotransform": [0.0, 1.0, 0.0, 0.0, 0.0, -1.0]}])
@pytest.mark.parametrize("width", [0, 3])
def test_attributes_called_lon_and_lat_are_no_coordinates(place: dict[str, Any], width: int, tmp_path: Path) -> None:
    beside = {"lon": terrain((8, 9), 1), "lat": terrain((8, 9), 2)}
    points = torus(8, 9) if width else terrain((8, 9))
    surface = ls.Surface(points, attributes=beside, metadata={} if width else place)
    found = dataset(surface)
    assert_same(ls.Surface.from_xarray(found), surface)
    if width:  # also of a Dataset that is not ours: coordinates of an array come before variables beside it
        del found.attrs["lodestream"]
        assert np.array_equal(ls.Surface.from_xarray(found).points, points)
    ls.write(surface, tmp_path / "a.nc")
    again = ls.read(tmp_path / "a.nc", attributes="lon,lat")
    assert np.array_equal(again.points, points)
    assert list(again.attributes) == ["lon", "lat"]


def test_what_a_file_says_of_its_coordinates_comes_back(tmp_path: Path) -> None:
    said = {"x": {"long_name": "east of the mast", "units": "km"}, "y": {"long_name": "north of it", "units": "km"}}
    coords = {name: (name, np.arange(float(n)), said[name]) for name, n in (("y", 6), ("x", 7))}
    data = xr.Dataset({"z": (("y", "x"), terrain((6, 7)), {"units": "m"})}, coords)
    surface = ls.Surface.from_xarray(data)
    ls.write(surface, tmp_path / "a.nc")
    for found in (dataset(surface), dataset(ls.read(tmp_path / "a.nc"))):
        for name, words in said.items():
            assert found[name].attrs == words | {"axis": name.upper()}
    assert_same(ls.Surface.from_xarray(dataset(surface)), surface)


def test_longitudes_without_a_crs_stay_longitudes(tmp_path: Path) -> None:
    units = {"lat": "degrees_north", "lon": "degrees_east"}
    places = {"lat": np.linspace(-80, 80, 17), "lon": np.arange(0.0, 360.0, 10.0)}
    data = xr.DataArray(terrain((17, 36)), {k: (k, v, {"units": units[k]}) for k, v in places.items()}, ("lat", "lon"))
    surface = ls.Surface.from_xarray(data)
    found = dataset(surface)
    assert found.x.attrs["standard_name"] == "longitude"
    assert found.x.attrs["units"] == "degrees_east"
    assert found.y.attrs["units"] == "degrees_north"
    assert_same(ls.Surface.from_xarray(found), surface)
    ls.write(surface, tmp_path / "a.nc")
    assert ls.read(tmp_path / "a.nc").closed == (False, True)


def test_a_plane_is_chosen_by_time_or_place_and_dask_is_computed() -> None:
    values = np.arange(2 * 3 * 8 * 9, dtype="f8").reshape(2, 3, 8, 9)
    dates = np.array(["2001-01-01", "2001-02-01"], "datetime64[ns]")
    data = xr.Dataset({"t": (("time", "depth", "y", "x"), values)}, {"time": dates}).chunk({"y": 4})
    with pytest.raises(ls.FormatError, match=r"time=.*at=depth:0 to 2"):
        ls.Surface.from_xarray(data)
    found = ls.Surface.from_xarray(data, time="2001-02", at="depth:1")
    assert np.array_equal(found.points, values[1, 1])
    assert np.array_equal(ls.Surface.from_xarray(data.t[0, 2]).points, values[0, 2])


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (np.zeros((3, 3)), "expected a Dataset, a DataArray or a DataTree"),
        (xr.Dataset({"a": ("x", [1.0, 2.0])}), "over two dimensions"),
        (xr.DataTree(), "expected a DataTree with a variable"),
    ],
)
def test_what_is_no_surface_is_refused(data: Any, words: str) -> None:
    with pytest.raises(ls.InputError, match=words):
        ls.Surface.from_xarray(data)


def test_attributes_that_are_not_there_or_do_not_fit_are_refused() -> None:
    data = dataset(heights()).assign(line=("x", np.arange(50.0)))
    with pytest.raises(ls.OptionError, match="got 'nothing'"):
        ls.Surface.from_xarray(data, attributes=["nothing"])
    with pytest.raises(ls.OptionError, match="got 'line' of float64 over x"):
        ls.Surface.from_xarray(data, attributes=["line"])
