"""x and y in another unit than the CRS: positions agree with the CRS, and a note says so."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pytest
import rasterio
import xarray as xr
from numpy.typing import NDArray

import lodestream as ls
from lodestream.coordinates.height_fields import coordinates
from lodestream.formats.netcdf.units import conversions_of

from .openers import noted

SHAPE = (24, 32)

#: Metres, by names that files have.
METRES = {
    "km": 1000.0,
    "kilometers": 1000.0,
    "Kilometre": 1000.0,
    "1000 m": 1000.0,
    "1e3 meters": 1000.0,
    "cm": 0.01,
    "Mm": 1e6,
    "feet": 0.3048,
    "ft": 0.3048,
    "international_foot": 0.3048,
    "US_survey_foot": 1200 / 3937,
    "US survey feet": 1200 / 3937,
    "us-ft": 1200 / 3937,
    "nautical_mile": 1852.0,
    "miles": 1609.344,
}

LAMBERT = {
    "grid_mapping_name": "lambert_conformal_conic",
    "standard_parallel": [63.3, 63.3],
    "longitude_of_central_meridian": 15.0,
    "latitude_of_projection_origin": 63.3,
    "earth_radius": 6371000.0,
}


def mapped(units: str | None, crs: dict[str, Any] | None = None, dtype: str = "f8", curved: bool = False) -> xr.Dataset:
    x, y = 3.0 * np.arange(-16, 16), 3.0 * np.arange(11, -13, -1)
    said = {letter: {"standard_name": f"projection_{letter}_coordinate"} for letter in "xy"}
    for words in said.values():
        words |= {} if units is None else {"units": units}
    values = np.add.outer(np.sin(y / 9), np.cos(x / 7)).astype("f4")
    data = xr.Dataset({"t": (("y", "x"), values, {"grid_mapping": "crs"}), "crs": ((), np.int32(0), crs or LAMBERT)})
    if not curved:
        return data.assign_coords(x=("x", x.astype(dtype), said["x"]), y=("y", y.astype(dtype), said["y"]))
    east, north = np.meshgrid(x, y)
    data.t.attrs["coordinates"] = "xc yc"
    places = {"xc": (("y", "x"), east + north / 9, said["x"]), "yc": (("y", "x"), north + east / 7, said["y"])}
    return data.assign(places)


def _file(data: xr.Dataset, folder: Path) -> ls.Surface:
    data.to_netcdf(folder / "a.nc", engine="h5netcdf")
    return ls.read(folder / "a.nc")


def _decoded(data: xr.Dataset, folder: Path) -> ls.Surface:
    data.to_netcdf(folder / "a.nc", engine="h5netcdf")
    with xr.open_dataset(folder / "a.nc", engine="h5netcdf", decode_coords="all") as opened:
        return ls.Surface.from_xarray(opened)


def positions(surface: ls.Surface) -> tuple[NDArray[Any], NDArray[Any]]:
    return coordinates(surface) if surface.points.ndim == 2 else (surface.points[..., 0], surface.points[..., 1])


@pytest.mark.sweep(6)
@pytest.mark.parametrize(
    ("opener", "units"),
    [*((_file, units) for units in METRES), (_decoded, "km"), (_decoded, "1000 m"), (_decoded, "ft")],
)
@pytest.mark.long
def test_lengths_become_those_of_the_crs(tmp_path: Path, opener: Any, units: str) -> None:
    data = mapped(units)
    surface, notes = noted(lambda: opener(data, tmp_path))
    for found, axis in zip(positions(surface), np.meshgrid(data.x.values, data.y.values), strict=True):
        np.testing.assert_allclose(found, axis * METRES[units], rtol=1e-12, atol=1e-9)
    assert len(notes) == 1
    assert notes[0].startswith(f"x and y are converted from {units!r} to the metre of the CRS, by ")
    assert surface.metadata["tags"][""]["x#units"] == "metre"
    ls.write(surface, tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as raster:
        assert raster.crs.linear_units_factor[1] == 1.0
        np.testing.assert_allclose(raster.xy(0, 0), np.array([-48, 33]) * METRES[units])
    ls.write(surface, tmp_path / "b.nc")
    again, notes = noted(lambda: ls.read(tmp_path / "b.nc"))
    assert notes == []
    for there, here in zip(positions(again), positions(surface), strict=True):
        np.testing.assert_array_equal(there, here)


#: More metres, and degrees, by names of UDUNITS-2.
FURTHER = {
    "um": 1e-6,
    "micrometer": 1e-6,
    "mm": 1e-3,
    "millimetres": 1e-3,
    "centimeter": 0.01,
    "dm": 0.1,
    "decimeters": 0.1,
    "dam": 10.0,
    "decameter": 10.0,
    "hm": 100.0,
    "hectometres": 100.0,
    "megameter": 1e6,
    "inches": 0.0254,
    "yards": 0.9144,
    "statute_mile": 1609.344,
    "US_statute_mile": 5280 * 1200 / 3937,
    "fathom": 6 * 1200 / 3937,
    "nmile": 1852.0,
}
DEGREES = {
    "radians": 180 / np.pi,
    "mrad": 0.18 / np.pi,
    "microradian": 1.8e-4 / np.pi,
    "gon": 0.9,
    "grads": 0.9,
    "arc_minutes": 1 / 60,
    "arcsec": 1 / 3600,
    "0.5 degree": 0.5,
}


@pytest.mark.parametrize("units", [*METRES, *FURTHER, *DEGREES])
def test_names_of_units_are_those_of_udunits(units: str) -> None:
    """Of each name, where files are read with some only."""
    crs = pyproj.CRS.from_epsg(4326) if units in DEGREES else pyproj.CRS.from_cf(LAMBERT)
    conversions, _ = conversions_of({"x": units}, crs.to_wkt())
    assert conversions["x"].factor == pytest.approx((METRES | FURTHER | DEGREES)[units], rel=1e-12)
    assert conversions["x"].unit == ("degree" if units in DEGREES else "metre")


@pytest.mark.parametrize("opener", [_file, _decoded])
@pytest.mark.parametrize("dtype", ["f4", "i4", "i2"])
def test_values_of_every_type_are_converted(tmp_path: Path, opener: Any, dtype: str) -> None:
    data = mapped("km", dtype=dtype)
    surface, _ = noted(lambda: opener(data, tmp_path))
    for found, axis in zip(positions(surface), np.meshgrid(data.x.values, data.y.values), strict=True):
        np.testing.assert_array_equal(found, axis * 1000.0)


@pytest.mark.parametrize("opener", [_file, _decoded])
def test_arrays_are_converted(tmp_path: Path, opener: Any) -> None:
    data = mapped("km", curved=True)
    surface, notes = noted(lambda: opener(data, tmp_path))
    np.testing.assert_array_equal(positions(surface)[0], data.xc.values * 1000)
    np.testing.assert_array_equal(positions(surface)[1], data.yc.values * 1000)
    assert len(notes) == 1


@pytest.mark.parametrize("units", ["ms", "mn", "m_east", "kms", "degrees_east", "m2", "fts", "ins", "es", "mtrue"])
def test_other_units_are_no_lengths(tmp_path: Path, units: str) -> None:
    data = mapped(units)
    surface, notes = noted(lambda: _file(data, tmp_path))
    np.testing.assert_array_equal(positions(surface)[0][0], data.x.values)
    assert notes == [f"x and y are in {units!r}, which is not converted to the metre of the CRS"]


@pytest.mark.parametrize(
    ("code", "units", "factor"),
    [
        (2263, "m", 3937 / 1200),
        (2263, "feet", 0.3048 * 3937 / 1200),
        (2263, "US_survey_foot", None),
        (32633, "m", None),
        (32633, "metres", None),
        (32633, None, None),
    ],
)
def test_the_unit_is_that_of_the_crs(tmp_path: Path, code: int, units: str | None, factor: float | None) -> None:
    crs = pyproj.CRS.from_epsg(code)
    data = mapped(units, {"crs_wkt": crs.to_wkt()})
    surface, notes = noted(lambda: _file(data, tmp_path))
    np.testing.assert_allclose(positions(surface)[0][0], data.x.values * (factor or 1), rtol=1e-12)
    assert notes == (
        []
        if factor is None
        else [f"x and y are converted from {units!r} to the {crs.axis_info[0].unit_name} of the CRS, by {factor:.10g}"]
    )
    if factor is None:
        np.testing.assert_array_equal(positions(surface)[0][0], data.x.values)


@pytest.mark.parametrize("units", ["furlong", "degrees_east", "1", "km2", "s"])
def test_other_units_are_named(tmp_path: Path, units: str) -> None:
    data = mapped(units)
    data.x.attrs["units"] = units
    data.y.attrs["units"] = "m"
    surface, notes = noted(lambda: _file(data, tmp_path))
    np.testing.assert_array_equal(positions(surface)[0][0], data.x.values)
    assert notes == [f"x is in {units!r}, which is not converted to the metre of the CRS"]
    assert surface.metadata["tags"][""]["x#units"] == units


def test_without_a_crs_units_stay(tmp_path: Path) -> None:
    data = mapped("km").drop_vars("crs")
    del data.t.attrs["grid_mapping"]
    surface, notes = noted(lambda: _file(data, tmp_path))
    assert notes == []
    assert surface.metadata["tags"][""]["x#units"] == "km"
    np.testing.assert_array_equal(positions(surface)[0][0], data.x.values)
