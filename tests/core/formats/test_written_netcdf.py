"""What NetCDF and Zarr are written with: positions and values under land, single coordinates, references."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray

import lodestream as ls
from lodestream.coordinates.height_fields import coordinates

from ..surfaces import terrain
from ..test_non_finite import plane
from .openers import noted

Array = NDArray[Any]

EAST = {"units": "degrees_east", "standard_name": "longitude"}
NORTH = {"units": "degrees_north", "standard_name": "latitude"}
SHAPE = (24, 32)

both = pytest.mark.parametrize("suffix", [".nc", ".zarr"])


def opened(path: Path) -> Any:
    return xr.open_zarr(path) if path.suffix == ".zarr" else xr.open_dataset(path, engine="h5netcdf")


def land() -> NDArray[np.bool_]:
    rows, columns = np.indices(SHAPE)
    return np.asarray(np.hypot(columns - 10, rows - 12) < 5)


def curvilinear() -> tuple[Array, Array]:
    rows, columns = np.indices(SHAPE).astype(np.float64)
    return -70 + 0.05 * columns + 0.01 * rows, 35 + 0.04 * rows + 0.005 * columns


# Land


@both
@pytest.mark.parametrize("nodata", [None, -9999.0])
@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_coordinates_under_land_are_written(tmp_path: Path, suffix: str, nodata: float | None, dtype: str) -> None:
    lon, lat = (it.astype(dtype) for it in curvilinear())
    z = np.where(land(), np.nan, np.add.outer(np.arange(24), np.arange(32))).astype(dtype)
    z[0, :3] = np.inf, -np.inf, np.nan
    lon[1, 1] = np.nan  # a value without a place
    metadata = {} if nodata is None else {"nodata": nodata}
    surface = ls.Surface(np.stack([lon, lat, z], axis=-1), metadata=metadata)
    _, notes = noted(lambda: ls.write(surface, tmp_path / f"a{suffix}"))
    assert notes == []
    with opened(tmp_path / f"a{suffix}") as data:
        np.testing.assert_array_equal(data.x.values, lon)
        np.testing.assert_array_equal(data.y.values, lat)
        np.testing.assert_array_equal(data.z.values, z)
    back, _ = noted(lambda: ls.read(tmp_path / f"a{suffix}"))
    np.testing.assert_array_equal(back.points, surface.points)
    np.testing.assert_array_equal(back.mask, surface.mask)


@both
@pytest.mark.parametrize("kind", ["even", "uneven", "rotated"])
def test_heights_that_are_missing_have_a_place(tmp_path: Path, suffix: str, kind: str) -> None:
    z = np.where(land(), np.nan, terrain(SHAPE))
    z[0, :2] = np.inf, -np.inf
    place: dict[str, Any] = {"geotransform": [5.0, 2.0, 0.5 * (kind == "rotated"), 9.0, 0.0, -1.0]}
    if kind == "uneven":
        place = {"axes": {"x": [*(np.arange(32.0) ** 2).tolist(), "values"], "y": [0, 2]}}
    surface = ls.Surface(z, metadata=place)
    _, notes = noted(lambda: ls.write(surface, tmp_path / f"a{suffix}"))
    assert notes == []
    x, y = coordinates(surface)
    with opened(tmp_path / f"a{suffix}") as data:
        for letter, plane in (("x", x), ("y", y)):
            found = data[f"{letter}c" if kind == "rotated" else letter]
            np.testing.assert_array_equal(found.broadcast_like(data.z).values, plane)
        np.testing.assert_array_equal(data.z.values, z)


@both
def test_any_point_that_is_missing_in_part_comes_back(tmp_path: Path, suffix: str) -> None:
    points = plane()[:30, :40]
    points[3, 4], points[5, 6, 0], points[7, 8, 2], points[9, 9, 1] = np.nan, np.inf, np.nan, np.nan
    surface = ls.Surface(points)
    _, notes = noted(lambda: ls.write(surface, tmp_path / f"a{suffix}"))
    assert notes == []
    with opened(tmp_path / f"a{suffix}") as data:
        for channel, name in enumerate(("x", "y", "z")):
            np.testing.assert_array_equal(data[name].values, points[..., channel])


# Coordinates of one value


def single() -> xr.Dataset:
    """A field of one time and at one height, of steps of a forecast of which one is chosen."""
    lon, lat = curvilinear()
    values = np.add.outer(np.arange(3.0), lon * lat)[None].astype("f4")
    said = {"units": "K", "coordinates": "height lead lat lon", "_FillValue": np.float32(1e20)}
    days = {"units": "days since 2001-01-01", "calendar": "standard", "axis": "T", "bounds": "time_bnds"}
    height = {"units": "m", "standard_name": "height", "positive": "up", "axis": "Z"}
    return xr.Dataset(
        {
            "tas": (("time", "step", "y", "x"), values, said),
            "time": ("time", np.array([15.5]), days),
            "time_bnds": (("time", "two"), np.array([[15.0, 16.0]])),
            "lead": ("step", np.array([6, 12, 18], "i4"), {"units": "hours", "valid_min": np.int32(0)}),
            "height": ((), 2.0, height),
            "lon": (("y", "x"), lon, EAST),
            "lat": (("y", "x"), lat, NORTH),
        },
        attrs={"title": "T"},
    )


def read_single(folder: Path, engine: str, **options: Any) -> ls.Surface:
    data = single()
    data.to_netcdf(folder / "in.nc", engine="h5netcdf")
    if engine == "file":
        return ls.read(folder / "in.nc", **options)
    with xr.open_dataset(folder / "in.nc", engine="h5netcdf") as decoded:
        return ls.Surface.from_xarray(decoded, **options)


@pytest.mark.parametrize("engine", ["file", "xarray"])
def test_coordinates_of_one_value_are_kept(tmp_path: Path, engine: str) -> None:
    surface, notes = noted(lambda: read_single(tmp_path, engine, at="step:1"))
    assert surface.metadata["scalars"] == {"time": 15.5, "height": 2.0, "lead": 12}
    assert surface.metadata["tags"][""]["time#units"] == "days since 2001-01-01"
    assert surface.metadata["tags"][""]["height#standard_name"] == "height"
    assert "NC_GLOBAL#coordinates" not in surface.metadata["tags"][""]
    assert notes == ["left out: time_bnds"]


@both
def test_coordinates_of_one_value_are_written(tmp_path: Path, suffix: str) -> None:
    surface, _ = noted(lambda: read_single(tmp_path, "file", at="step:1"))
    surface = ls.decode(ls.encode(surface))
    _, notes = noted(lambda: ls.write(surface, tmp_path / f"a{suffix}"))
    assert notes == []
    with opened(tmp_path / f"a{suffix}") as data:
        assert data.tas.time.values == np.datetime64("2001-01-16T12")
        assert data.tas.height.values == 2.0
        assert data.height.attrs["standard_name"] == "height"
        assert data.lead.attrs["units"] == "hours" or data.lead.dtype.kind == "m"
    back, notes = noted(lambda: ls.read(tmp_path / f"a{suffix}"))
    assert notes == []
    assert back.metadata == {**surface.metadata, "format": back.metadata["format"]}


def test_coordinates_of_one_value_reach_xarray_and_come_back(tmp_path: Path) -> None:
    surface, _ = noted(lambda: read_single(tmp_path, "file", at="step:1"))
    data: Any = surface.to_xarray()
    assert float(data.tas.time) == 15.5
    assert data.time.attrs["units"] == "days since 2001-01-01"
    assert xr.decode_cf(data).time.values == np.datetime64("2001-01-16T12")
    for it in (data, xr.decode_cf(data)):
        back = ls.Surface.from_xarray(it)
        assert back.metadata["scalars"] == surface.metadata["scalars"]
        assert back.metadata["tags"] == surface.metadata["tags"]
    without = ls.Surface.from_xarray(data.drop_vars("height"))
    assert without.metadata["scalars"] == {"time": 15.5, "lead": 12}
    taken = ls.Surface(surface.points, metadata={**surface.metadata, "scalars": {"tas": 3, "time": 1}})
    assert ls.Surface.from_xarray(taken.to_xarray()).metadata["scalars"] == {"tas": 3, "time": 1}


@both
def test_names_of_coordinates_dangle_nowhere(tmp_path: Path, suffix: str) -> None:
    data = single().isel(time=0, step=0).set_coords(["time", "height", "lead", "lon", "lat"])
    data.to_netcdf(tmp_path / "in.nc", engine="h5netcdf")
    surface, _ = noted(lambda: ls.read(tmp_path / "in.nc"))
    for written in (surface, ls.Surface(surface.points[..., :2], metadata=surface.metadata)):
        path = tmp_path / f"a{written.points.shape[2]}{suffix}"
        ls.write(written, path)
        if suffix == ".nc":
            with h5py.File(path) as file:
                names, attributes = set(file), [dict(file.attrs), *(dict(it.attrs) for it in file.values())]
        else:
            with xr.open_zarr(path, decode_cf=False) as store:
                names = set(map(str, store.variables))
                attributes = [dict(store.attrs), *(dict(it.attrs) for it in store.variables.values())]
        for said in attributes:
            for key in ("coordinates", "grid_mapping", "bounds", "ancillary_variables"):
                assert set(str(said.get(key, "")).split()) <= names


@both
def test_numbers_of_other_formats_are_written(tmp_path: Path, suffix: str) -> None:
    scalars = {"dx": 2.5, "zone": 32, "z": 7, "word": "no", "a/b": 3}
    surface = ls.Surface(terrain(SHAPE), metadata={"scalars": scalars})
    _, notes = noted(lambda: ls.write(surface, tmp_path / f"a{suffix}"))
    assert notes == []
    with opened(tmp_path / f"a{suffix}") as data:
        assert (float(data.dx), float(data.zone)) == (2.5, 32)
    assert ls.read(tmp_path / f"a{suffix}").metadata["scalars"] == scalars
