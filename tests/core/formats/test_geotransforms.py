"""Geotransforms of grid mappings: positions are those of GDAL and of the coordinates, or a note says so."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio
import rasterio.shutil
import xarray as xr
from numpy.typing import NDArray

import lodestream as ls
from lodestream.coordinates.height_fields import coordinates
from lodestream.errors import FormatWarning

from .openers import by_netcdf, by_xarray, by_zarr, noted

pytest.importorskip("h5netcdf")

SHAPE = (18, 36)
UTM = pyproj.CRS.from_epsg(32633).to_wkt()
WGS84 = pyproj.CRS.from_epsg(4326).to_wkt()


every_opener = pytest.mark.parametrize("opener", [by_netcdf, by_zarr, by_xarray])


def heights() -> NDArray[Any]:
    return np.add.outer(np.sin(np.arange(18) / 5), np.cos(np.arange(36) / 7)).astype("f4")


def mapped(transform: list[float], wkt: str = UTM, **more: Any) -> xr.Dataset:
    said = {"crs_wkt": wkt, "spatial_ref": wkt, "GeoTransform": " ".join(map(repr, transform)), **more}
    return xr.Dataset({"z": (("y", "x"), heights(), {"grid_mapping": "crs"}), "crs": ((), 0, said)})


def centres(transform: list[float]) -> tuple[NDArray[Any], NDArray[Any]]:
    column, row = np.meshgrid(np.arange(36) + 0.5, np.arange(18) + 0.5)
    x, dx_column, dx_row, y, dy_column, dy_row = transform
    return x + dx_column * column + dx_row * row, y + dy_column * column + dy_row * row


@pytest.mark.sweep(6)
@every_opener
@pytest.mark.parametrize(
    ("transform", "wkt"),
    [
        ([500000.0, 30.0, 0.0, 4100000.0, 0.0, -30.0], UTM),
        ([500000.0, 30.0, 4.0, 4100000.0, 4.0, -30.0], UTM),
        ([500000.0, 30.0, 0.0, 4100000.0, 0.0, 30.0], UTM),
        ([10.0, 0.1, 0.0, 50.0, 0.0, -0.1], WGS84),
    ],
)
def test_without_coordinates_the_geotransform_says_where_heights_lie(
    tmp_path: Path, opener: Callable[..., ls.Surface], transform: list[float], wkt: str
) -> None:
    data = mapped(transform, wkt)
    surface, notes = noted(lambda: opener(data, tmp_path))
    assert notes == []
    for ours, theirs in zip(coordinates(surface), centres(transform), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-14)
    data.to_netcdf(tmp_path / "g.nc", engine="h5netcdf")
    with rasterio.open(tmp_path / "g.nc") as raster:
        np.testing.assert_allclose(surface.metadata["geotransform"], raster.transform.to_gdal())
    ls.write(surface, tmp_path / "b.nc")
    again, notes = noted(lambda: ls.read(tmp_path / "b.nc"))
    assert notes == []
    for ours, theirs in zip(coordinates(again), centres(transform), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-14)


@every_opener
def test_without_coordinates_a_grid_around_the_earth_is_closed(
    tmp_path: Path, opener: Callable[..., ls.Surface]
) -> None:
    surface = opener(mapped([-180.0, 10.0, 0.0, 90.0, 0.0, -10.0], WGS84), tmp_path)
    assert surface.closed == (False, True)
    assert opener(mapped([-180.0, 10.0, 0.0, 90.0, 0.0, -10.0], UTM), tmp_path).closed == (False, False)


@pytest.mark.sweep(8)
@every_opener
@pytest.mark.parametrize("curved", [False, True])
@pytest.mark.parametrize(("shift", "words"), [(0.0, ""), (0.001, ""), (3.0, ""), (3.25, "by 3.25 cells")])
def test_a_geotransform_that_lies_elsewhere_is_named(
    tmp_path: Path, opener: Callable[..., ls.Surface], curved: bool, shift: float, words: str
) -> None:
    transform = [500000.0, 32.0, 0.0, 4100000.0, 0.0, -32.0]
    x, y = centres(transform)
    data = mapped([500000.0 + 32 * shift, *transform[1:]])
    if curved:
        data.z.attrs["coordinates"] = "xc yc"
        said = {letter: {"standard_name": f"projection_{letter}_coordinate", "units": "m"} for letter in "xy"}
        data = data.assign(xc=(("y", "x"), x, said["x"]), yc=(("y", "x"), y, said["y"]))
    else:
        data = data.assign_coords(x=x[0], y=y[:, 0])
    surface, notes = noted(lambda: opener(data, tmp_path))
    found = coordinates(surface) if surface.points.ndim == 2 else (surface.points[..., 0], surface.points[..., 1])
    np.testing.assert_array_equal(found[0], x)
    np.testing.assert_array_equal(found[1], y)
    assert notes == ([f"left out a GeoTransform that lies elsewhere than x and y, {words}"] if words else [])


@every_opener
def test_a_geotransform_of_other_cells_is_named(tmp_path: Path, opener: Callable[..., ls.Surface]) -> None:
    x, y = centres([500000.0, 32.0, 0.0, 4100000.0, 0.0, -32.0])
    data = mapped([500000.0, 64.0, 0.0, 4100000.0, 0.0, -64.0]).assign_coords(x=x[0], y=y[:, 0])
    surface, notes = noted(lambda: opener(data, tmp_path))
    np.testing.assert_array_equal(coordinates(surface)[0], x)
    assert notes == ["left out a GeoTransform that lies elsewhere than x and y, by 17.8 cells"]


@every_opener
@pytest.mark.parametrize("transform", [[0, 1e200, 0, 0, 0, 1e200], [0.0] * 6, [1e308, 1e308, 0, 1e308, 0, -1e308]])
def test_a_geotransform_that_no_raster_has_is_left_out(
    tmp_path: Path, opener: Callable[..., ls.Surface], transform: list[float]
) -> None:
    x, y = centres([500000.0, 32.0, 0.0, 4100000.0, 0.0, -32.0])
    data = mapped(transform).assign_coords(x=x[0], y=y[:, 0])
    surface, notes = noted(lambda: opener(data, tmp_path))
    np.testing.assert_array_equal(coordinates(surface)[0], x)
    assert len(notes) == 1
    assert "left out a GeoTransform" in notes[0]


@pytest.mark.parametrize("bottom_up", ["YES", "NO"])
def test_rows_from_the_south_as_gdal_writes_them_need_no_note(tmp_path: Path, bottom_up: str) -> None:
    transform = rasterio.transform.Affine(30, 0, 500000, 0, -30, 4100000)
    profile = {"height": 18, "width": 36, "count": 1, "dtype": "float32", "crs": UTM, "transform": transform}
    with rasterio.open(tmp_path / "a.tif", "w", driver="GTiff", **profile) as raster:
        raster.write(heights(), 1)
    rasterio.shutil.copy(tmp_path / "a.tif", tmp_path / "a.nc", driver="netCDF", WRITE_BOTTOMUP=bottom_up)
    surface, notes = noted(lambda: ls.read(tmp_path / "a.nc"))
    assert notes == []
    x, y = coordinates(surface)
    rows = np.rint((4100000 - 15 - y) / 30).astype(int)
    columns = np.rint((x - 500000 - 15) / 30).astype(int)
    np.testing.assert_array_equal(surface.points, heights()[rows, columns])


GEOSTATIONARY = {
    "grid_mapping_name": "geostationary",
    "perspective_point_height": 35786023.0,
    "semi_major_axis": 6378137.0,
    "semi_minor_axis": 6356752.31414,
    "longitude_of_projection_origin": -75.0,
    "latitude_of_projection_origin": 0.0,
    "sweep_angle_axis": "x",
}
HEIGHT = 35786023.0


def disk(units: str = "rad", factor: float = 1.0, kind: str = "projection") -> xr.Dataset:
    x, y = np.arange(-18, 18) * 5.6e-5, np.arange(9, -9, -1) * 5.6e-5
    said = {letter: {"standard_name": f"projection_{letter}_{kind}", "units": units} for letter in "xy"}
    data = xr.Dataset({"z": (("y", "x"), heights(), {"grid_mapping": "crs"}), "crs": ((), 0, GEOSTATIONARY)})
    return data.assign_coords(x=("x", x / factor, said["x"]), y=("y", y / factor, said["y"]))


@pytest.mark.sweep(10)
@every_opener
@pytest.mark.parametrize(
    ("units", "factor"),
    [("rad", 1.0), ("radian", 1.0), ("radians", 1.0), ("microradian", 1e-6), ("degrees", np.pi / 180)],
)
@pytest.mark.parametrize("kind", ["coordinate", "angular_coordinate"])
@pytest.mark.long
def test_angles_of_a_satellite_become_lengths_of_its_crs(
    tmp_path: Path, opener: Callable[..., ls.Surface], units: str, factor: float, kind: str
) -> None:
    data = disk(units, factor, kind)
    surface, notes = noted(lambda: opener(data, tmp_path))
    assert notes == [f"x and y are converted from {units!r} to the metre of the CRS, by {factor * HEIGHT:.10g}"]
    for ours, theirs in zip(coordinates(surface), np.meshgrid(data.x.values, data.y.values), strict=True):
        np.testing.assert_allclose(ours, theirs * factor * HEIGHT, rtol=1e-12, atol=1e-6)
    said = surface.to_xarray()
    assert isinstance(said, xr.Dataset)
    assert (said.x.attrs["units"], said.x.attrs["standard_name"]) == ("metre", "projection_x_coordinate")
    ls.write(surface, tmp_path / "b.nc")
    assert noted(lambda: ls.read(tmp_path / "b.nc"))[1] == []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)  # GDAL writes less of such a CRS
        ls.write(surface, tmp_path / "a.tif")
    expected = seen_from_the_satellite(*(axis * factor for axis in np.meshgrid(data.x.values, data.y.values)))
    with rasterio.open(tmp_path / "a.tif") as raster:
        places = rasterio.transform.xy(raster.transform, *np.indices(SHAPE).reshape(2, -1))
        in_tiff = pyproj.Transformer.from_crs(raster.crs.to_wkt(), "EPSG:4326", always_xy=True).transform(*places)
    crs = pyproj.CRS.from_wkt(surface.metadata["crs"])
    here = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True).transform(*coordinates(surface))
    for ours, theirs, wanted in zip(here, in_tiff, expected, strict=True):
        np.testing.assert_allclose(ours, wanted, atol=1e-6)
        np.testing.assert_allclose(np.reshape(theirs, SHAPE), wanted, atol=1e-6)


def seen_from_the_satellite(x: NDArray[Any], y: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Longitude and latitude of scan angles: GOES-R Product Definition and Users' Guide, volume 3, 5.1.2.8.1."""
    radius, polar = 6378137.0, 6356752.31414
    distance, flat = HEIGHT + radius, (radius / polar) ** 2
    a = np.sin(x) ** 2 + np.cos(x) ** 2 * (np.cos(y) ** 2 + flat * np.sin(y) ** 2)
    b, c = -2 * distance * np.cos(x) * np.cos(y), distance**2 - radius**2
    away = (-b - np.sqrt(b**2 - 4 * a * c)) / (2 * a)
    sx, sy, sz = away * np.cos(x) * np.cos(y), -away * np.sin(x), away * np.cos(x) * np.sin(y)
    north = np.arctan(flat * sz / np.hypot(distance - sx, sy))
    return -75 - np.degrees(np.arctan(sy / (distance - sx))), np.degrees(north)


@every_opener
@pytest.mark.parametrize(("shift", "count"), [(0.0, 1), (7.5, 2)])
def test_a_geotransform_in_metres_beside_angles_is_compared_in_metres(
    tmp_path: Path, opener: Callable[..., ls.Surface], shift: float, count: int
) -> None:
    data, step = disk(), 5.6e-5 * HEIGHT
    transform = [(-18.5 + shift) * step, step, 0.0, 9.5 * step, 0.0, -step]
    data.crs.attrs["GeoTransform"] = " ".join(map(repr, transform))
    surface, notes = noted(lambda: opener(data, tmp_path))
    assert len(notes) == count
    np.testing.assert_allclose(coordinates(surface)[0][0], data.x.values * HEIGHT, rtol=1e-12, atol=1e-6)
