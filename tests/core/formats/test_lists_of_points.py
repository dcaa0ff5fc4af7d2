"""Values whose longitude and latitude run along one dimension lie on no grid, and are refused as what they are."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr

import lodestream as ls
from lodestream.errors import FormatError, FormatWarning


def icon() -> xr.Dataset:
    """A field of ICON, whose file does not hold the triangles."""
    lon, lat = np.linspace(-3, 3, 90), np.linspace(-1.5, 1.5, 90)
    said = {"CDI_grid_type": "unstructured", "number_of_grid_in_reference": 1, "coordinates": "clat clon"}
    return xr.Dataset(
        {
            "t": (("height", "ncells"), np.ones((20, 90), "f4"), {**said, "units": "K"}),
            "clon": ("ncells", lon, {"standard_name": "longitude", "units": "radian", "bounds": "clon_bnds"}),
            "clat": ("ncells", lat, {"standard_name": "latitude", "units": "radian", "bounds": "clat_bnds"}),
            "clon_bnds": (("ncells", "vertices"), np.ones((90, 3))),
            "clat_bnds": (("ncells", "vertices"), np.ones((90, 3))),
            "height": ("height", np.arange(20.0), {"axis": "Z"}),
        }
    )


def stations() -> xr.Dataset:
    """Series of several stations (CF's discrete sampling geometries)."""
    return xr.Dataset(
        {
            "t": (("station", "time"), np.ones((30, 12))),
            "lon": ("station", np.linspace(0, 9, 30), {"units": "degrees_east"}),
            "lat": ("station", np.linspace(50, 59, 30), {"units": "degrees_north"}),
        }
    )


def coordinates_elsewhere() -> xr.Dataset:
    """ICON without its coordinates, which another file has."""
    return icon().drop_vars(["clon", "clat", "clon_bnds", "clat_bnds"])


def section() -> xr.Dataset:
    data = stations().rename(station="profile", time="z")
    data["lon"].attrs = {"standard_name": "longitude"}
    data["lat"].attrs = {"standard_name": "latitude"}
    return data


@pytest.mark.parametrize("made", [icon, stations, coordinates_elsewhere, section])
@pytest.mark.parametrize("options", [{}, {"variable": "t"}])
@pytest.mark.parametrize("engine", ["file", "xarray"])
def test_they_are_refused(tmp_path: Path, made: Any, options: dict[str, Any], engine: str) -> None:
    words = "a list of points" if made in (stations, section) else "an unstructured mesh"
    made().to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    data: Any = made() if engine == "xarray" else tmp_path / "a.nc"
    read = ls.Surface.from_xarray if engine == "xarray" else ls.read
    with pytest.raises(FormatError, match=f"expected a variable over a grid, got {words}"):
        read(data, **options)


def swath() -> xr.Dataset:
    """A swath with longitudes and latitudes of its pixels, and those below the satellite for each line."""
    rows, columns = np.indices((24, 32)).astype(float)
    east, north = {"units": "degrees_east"}, {"units": "degrees_north"}
    return xr.Dataset(
        {
            "t": (("line", "pixel"), rows + columns),
            "longitude": (("line", "pixel"), 0.1 * columns + 0.01 * rows, east),
            "latitude": (("line", "pixel"), 0.1 * rows, north),
            "nadir_longitude": ("line", np.arange(24) * 0.01 + 1.6, east),
            "nadir_latitude": ("line", np.arange(24) * 0.1, north),
        }
    )


def grid_and_stations() -> xr.Dataset:
    grid = xr.Dataset(
        {"depth": (("y", "x"), np.add.outer(np.arange(24.0), np.arange(32.0)))},
        {"x": ("x", np.arange(32.0), {"axis": "X"}), "y": ("y", np.arange(24.0), {"axis": "Y"})},
    )
    return grid.merge(stations().rename(t="temperature"))


@pytest.mark.parametrize(("made", "name"), [(swath, "t"), (grid_and_stations, "depth")])
def test_a_grid_beside_them_is_read(tmp_path: Path, made: Any, name: str) -> None:
    data = made()
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)
        surface = ls.read(tmp_path / "a.nc")
    values = surface.points if surface.points.ndim == 2 else surface.points[..., 2]
    np.testing.assert_array_equal(values, data[name].values)
