"""What a file says beside values and positions is kept, or a note names it: fill values, types of axes, attributes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import xarray as xr

import lodestream as ls

from .openers import Opener, by_netcdf, by_xarray, by_zarr, noted

EAST, NORTH = {"units": "degrees_east"}, {"units": "degrees_north"}

every_opener = pytest.mark.parametrize("opener", [by_netcdf, by_zarr, by_xarray])


def field(dtype: str = "f4", **attributes: Any) -> xr.Dataset:
    """Heights of 24 latitudes and 32 longitudes."""
    values = (np.arange(24 * 32) % 300).reshape(24, 32).astype(dtype)
    lat, lon = -30 + 0.25 * np.arange(24), 10 + 0.25 * np.arange(32)
    return xr.Dataset(
        {"z": (("lat", "lon"), values, attributes)}, {"lat": ("lat", lat, NORTH), "lon": ("lon", lon, EAST)}
    )


# The number that stands for missing values


@pytest.mark.sweep(10)
@every_opener
@pytest.mark.parametrize("key", ["_FillValue", "missing_value"])
@pytest.mark.parametrize(("dtype", "number"), [("i2", 7), ("i4", -99999), ("u1", 255), ("f4", 1e20), ("f8", -9999.0)])
@pytest.mark.long
def test_the_fill_value_of_the_file_is_that_of_what_is_written(
    tmp_path: Path, opener: Opener, key: str, dtype: str, number: float
) -> None:
    data = field(dtype)
    fill = np.dtype(dtype).type(number)
    data.z.values[3, 4] = fill
    data.z.attrs[key] = fill
    surface = opener(data, tmp_path)
    assert surface.mask is not None
    assert (~surface.mask).sum() == (data.z.values == fill).sum()
    assert surface.metadata["nodata"] == fill.item()
    assert type(surface.metadata["nodata"]) is (float if dtype[0] == "f" else int)
    again = ls.decode(ls.encode(surface))
    ls.write(again, tmp_path / "b.nc")
    with xr.open_dataset(tmp_path / "b.nc", engine="h5netcdf", mask_and_scale=False) as back:
        assert back.z.attrs["_FillValue"] == fill
        np.testing.assert_array_equal(back.z.values, data.z.values)
    assert ls.read(tmp_path / "b.nc").metadata["nodata"] == fill.item()
    ls.write(again, tmp_path / "b.tif")
    with rasterio.open(tmp_path / "b.tif") as raster:
        assert raster.nodata == fill.item()
    if dtype[0] != "f":
        noted(lambda: ls.write(again, tmp_path / "b.npy"))  # which has no place for x and y
        np.testing.assert_array_equal(np.load(tmp_path / "b.npy"), data.z.values)


@every_opener
def test_a_missing_value_of_another_type_is_meant_as_the_values_have_it(tmp_path: Path, opener: Opener) -> None:
    """1e20 of double precision is no single-precision float."""
    data = field("f4")
    data.z.values[3, 4] = 1e20
    data.z.attrs["missing_value"] = np.float64(1e20)
    mask = opener(data, tmp_path).mask
    assert mask is not None
    assert np.argwhere(~mask).tolist() == [[3, 4]]


@pytest.mark.parametrize("opener", [by_netcdf, by_zarr])
@pytest.mark.parametrize("fill", [2**64 - 1, 2**63 + 1, 2**63])
def test_a_large_fill_value_is_exact(tmp_path: Path, opener: Opener, fill: int) -> None:
    data = field("u8")
    data.z.values[3, 4] = fill
    data.z.attrs["_FillValue"] = np.uint64(fill)
    surface = opener(data.drop_vars(["lat", "lon"]), tmp_path)
    assert surface.metadata["nodata"] == fill
    again = ls.decode(ls.encode(surface))
    for name in ("b.nc", "b.zarr"):
        ls.write(again, tmp_path / name)
        with xr.open_dataset(tmp_path / name, mask_and_scale=False) as back:
            assert back.z.attrs["_FillValue"] == np.uint64(fill)
            np.testing.assert_array_equal(back.z.values, data.z.values)
        assert ls.read(tmp_path / name).metadata["nodata"] == fill
    ls.write(again, tmp_path / "b.tif")
    np.testing.assert_array_equal(ls.read(tmp_path / "b.tif").mask, surface.mask)


@every_opener
@pytest.mark.parametrize("attributes", [{}, {"_FillValue": np.float32(np.nan)}, {"missing_value": np.float32(np.inf)}])
def test_no_number_stands_for_nan(tmp_path: Path, opener: Opener, attributes: dict[str, Any]) -> None:
    assert "nodata" not in opener(field(**attributes), tmp_path).metadata


def test_packed_values_have_none_of_their_own(tmp_path: Path) -> None:
    data = field("i2", _FillValue=np.int16(7), scale_factor=0.5)
    assert "nodata" not in by_netcdf(data, tmp_path).metadata


def test_a_number_that_a_writer_chose_is_none_of_the_surface(tmp_path: Path) -> None:
    mask = np.ones((4, 5), np.bool_)
    mask[1, 2] = False
    surface = ls.Surface(np.arange(20, dtype="i2").reshape(4, 5), mask=mask)
    ls.write(surface, tmp_path / "a.nc")
    assert "nodata" not in ls.read(tmp_path / "a.nc").metadata


# The type of axes


@pytest.mark.sweep(10)
@every_opener
@pytest.mark.parametrize("dtype", ["f4", "f8", "i2", "i4", "i8"])
@pytest.mark.parametrize("descending", [False, True])
@pytest.mark.long
def test_even_axes_keep_their_type(tmp_path: Path, opener: Opener, dtype: str, descending: bool) -> None:
    data = field()
    lat, lon = (4 * data[name].values for name in ("lat", "lon"))
    data = data.assign_coords(lat=("lat", lat.astype(dtype), NORTH), lon=("lon", lon.astype(dtype), EAST))
    data = data.isel(lat=slice(None, None, -1)) if descending else data
    surface = ls.decode(ls.encode(opener(data, tmp_path)))
    assert surface.metadata["geotransform"] is not None
    ls.write(surface, tmp_path / "b.nc")
    for found in (surface, ls.read(tmp_path / "b.nc")):
        back = found.to_xarray()
        for name, letter in (("lat", "y"), ("lon", "x")):
            assert back[letter].dtype == dtype
            np.testing.assert_array_equal(back[letter].values, data[name].values)
    ls.write(surface, tmp_path / "b.tif")
    with rasterio.open(tmp_path / "b.tif") as raster:
        assert list(raster.xy(0, 0)) == [data.lon.values[0], data.lat.values[0]]


# Attributes of the grid mapping


@every_opener
def test_attributes_of_a_grid_mapping_are_kept(tmp_path: Path, opener: Opener) -> None:
    said = {"grid_mapping_name": "latitude_longitude", "earth_radius": 6371000.0}
    further = {"epsg_code": "EPSG:4326", "long_name": "CRS definition", "version": np.int16(3)}
    data = field(grid_mapping="crs").assign(crs=((), np.int32(0), {**said, **further}))
    surface, notes = noted(lambda: opener(data, tmp_path))
    assert notes == []
    tags = surface.metadata["tags"][""]
    assert {key: text for key, text in tags.items() if key.startswith("spatial_ref#")} == {
        f"spatial_ref#{key}": str(value) for key, value in further.items()
    }
    ls.write(ls.decode(ls.encode(surface)), tmp_path / "b.nc")
    with xr.open_dataset(tmp_path / "b.nc", engine="h5netcdf", decode_coords="all") as back:
        assert {key: back.spatial_ref.attrs[key] for key in further} == further
        # JSON, which Zarr has attributes in, has no such types.
        assert back.spatial_ref.attrs["version"].dtype == (np.int64 if opener is by_zarr else np.int16)
        assert back.spatial_ref.attrs["grid_mapping_name"] == "latitude_longitude"
    again, notes = noted(lambda: ls.read(tmp_path / "b.nc"))
    assert notes == []
    assert again.metadata == {**surface.metadata, "name": again.metadata["name"], "format": "netcdf"}


@pytest.mark.parametrize("opener", [by_netcdf, by_zarr])
def test_a_grid_mapping_that_is_not_there_has_a_note(tmp_path: Path, opener: Opener) -> None:
    surface, notes = noted(lambda: opener(field(grid_mapping="nope"), tmp_path))
    assert "crs" not in surface.metadata
    assert notes == ["the grid mapping 'nope' of z is not there"]


# Groups


@pytest.mark.parametrize("kind", ["nc", "zarr"])
@pytest.mark.filterwarnings("ignore::zarr.errors.ZarrUserWarning")
def test_a_group_has_the_attributes_of_the_file(tmp_path: Path, kind: str) -> None:
    group = field().assign_attrs(title="of the group")
    file = xr.Dataset(attrs={"title": "of the file", "institution": "there", "version": np.int32(2)})
    tree = xr.DataTree.from_dict({"/": file, "/inner": group})
    path = tmp_path / f"a.{kind}"
    if kind == "nc":
        tree.to_netcdf(path, engine="h5netcdf")
    else:
        tree.to_zarr(path, consolidated=False)
    surface, notes = noted(lambda: ls.read(path, group="inner"))
    assert notes == []
    tags = surface.metadata["tags"][""]
    assert (tags["NC_GLOBAL#title"], tags["NC_GLOBAL#institution"]) == ("of the group", "there")
    assert surface.metadata["types"]["NC_GLOBAL#version"] == ("int32" if kind == "nc" else "int64")


@pytest.mark.parametrize(
    ("dtype", "limits"),
    [
        ("i8", {"valid_max": np.float64(2**63 - 1)}),
        ("i4", {"valid_max": np.float32(2**31 - 1)}),
        ("u8", {"valid_range": np.array([0, 2.0**64])}),
        ("u8", {"missing_value": np.float64(2.0**64)}),
        ("i8", {"missing_value": np.float64(2.0**63)}),
        ("i4", {"missing_value": np.complex128(1)}),
    ],
    ids=str,
)
def test_numbers_beyond_a_type_mask_nothing(dtype: str, limits: dict[str, Any]) -> None:
    surface, _ = noted(lambda: ls.Surface.from_xarray(field(dtype, **limits)))
    assert surface.mask is None


def test_a_tag_says_no_crs_where_there_is_another_or_none() -> None:
    wkt = rasterio.crs.CRS.from_epsg(32633).to_wkt()
    tags = {"": {"spatial_ref#crs_wkt": wkt, "spatial_ref#GeoTransform": "9 9 0 9 0 9", "spatial_ref#note": "x"}}
    place = [5e5, 30.0, 0.0, 4e6, 0.0, -30.0]
    heights = np.arange(72.0).reshape(8, 9)
    data = ls.Surface(heights, metadata={"geotransform": place, "tags": tags}).to_xarray()
    assert "crs_wkt" not in data["spatial_ref"].attrs
    assert data["spatial_ref"].attrs["note"] == "x"
    back, _ = noted(lambda: ls.Surface.from_xarray(data))
    assert "crs" not in back.metadata
    assert back.metadata["geotransform"] == place
    assert {"spatial_ref#crs_wkt", "spatial_ref#GeoTransform"} <= back.metadata["tags"][""].keys()


def test_nodata_of_a_geotiff_is_a_value_of_no_band(tmp_path: Path) -> None:
    place = [5e5, 30.0, 0.0, 4e6, 0.0, -30.0]
    heights = 1 + np.arange(72, dtype=np.int16).reshape(8, 9)
    surface = ls.Surface(heights, attributes={"w": heights % 2}, metadata={"nodata": 0, "geotransform": place})
    noted(lambda: ls.write(surface, tmp_path / "a.tif"))
    with rasterio.open(tmp_path / "a.tif") as dataset:
        assert dataset.read_masks(2).all()
