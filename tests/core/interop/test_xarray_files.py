"""A Dataset that xarray has opened and decoded gives the surface that its file gives."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.coordinates.height_fields import coordinates
from lodestream.errors import OptionError

from ..formats.openers import noted

xr = pytest.importorskip("xarray")
pytest.importorskip("h5netcdf")

Array = NDArray[Any]

#: xarray warns of several missing values.
pytestmark = pytest.mark.filterwarnings("ignore:variable 'kind' has multiple fill values")

EAST = {"units": "degrees_east", "standard_name": "longitude"}
NORTH = {"units": "degrees_north", "standard_name": "latitude"}
DATES = {"units": "days since 2001-01-01", "calendar": "standard", "axis": "T", "standard_name": "time"}
SHAPE = (24, 32)


def curvilinear() -> tuple[Array, Array]:
    rows, columns = np.indices(SHAPE).astype(np.float64)
    return -70 + 0.05 * columns + 0.01 * rows, 35 + 0.04 * rows + 0.005 * columns


def field(steps: int = 0) -> Array:
    lon, lat = curvilinear()
    values = np.round(50 * np.sin(lon / 0.4) * np.cos(lat / 0.3)).astype("f4")
    return values if not steps else values + np.arange(steps, dtype="f4")[:, None, None]


def roms() -> Any:
    lon, lat = curvilinear()
    grid = ("eta_rho", "xi_rho")
    values = field(3)
    values[:, 5:9, 6:12] = 1e37
    said = {
        "units": "meter",
        "long_name": "free surface",
        "coordinates": "lon_rho lat_rho ocean_time",
        "time": "ocean_time",
        "_FillValue": np.float32(1e37),
    }
    times = {"units": "seconds since 1970-01-01 00:00:00", "calendar": "gregorian", "field": "time, scalar, series"}
    return xr.Dataset(
        {
            "zeta": (("ocean_time", *grid), values, said),
            "h": (grid, field() + 100, {"units": "meter", "coordinates": "lon_rho lat_rho"}),
            "mask_rho": (grid, (values[0] < 1e36).astype("f8"), {"option_0": "land", "coordinates": "lon_rho lat_rho"}),
            "lon_rho": (grid, lon, {**EAST, "field": "lon_rho, scalar"}),
            "lat_rho": (grid, lat, {**NORTH, "field": "lat_rho, scalar"}),
            "ocean_time": ("ocean_time", np.array([0.0, 86400.0, 172800.0]) + 9.8e8, times),
            "hc": ((), 5.0, {"units": "meter", "long_name": "S-coordinate parameter, critical depth"}),
        },
        attrs={"type": "ROMS/TOMS history file", "Conventions": "CF-1.4"},
    )


def wrf() -> Any:
    lon, lat = (it.astype("f4") for it in curvilinear())
    dims = ("Time", "south_north", "west_east")
    two = np.zeros((2, 1, 1), "f4")
    said = {"MemoryOrder": "XY ", "stagger": "", "FieldType": np.int32(104), "coordinates": "XLONG XLAT XTIME"}
    minutes = {"units": "minutes since 2000-01-24 12:00:00", "description": "minutes since simulation start"}
    return xr.Dataset(
        {
            "Times": (("Time",), np.array([b"2000-01-24_12:00:00", b"2000-01-25_12:00:00"])),
            "XLAT": (dims, two + lat, {"units": "degree_north", "description": "LATITUDE, SOUTH IS NEGATIVE"}),
            "XLONG": (dims, two + lon, {"units": "degree_east", "description": "LONGITUDE, WEST IS NEGATIVE"}),
            "XTIME": (("Time",), np.array([0, 1440], "f4"), minutes),
            "T2": (dims, field(2) + 273, {**said, "units": "K", "description": "TEMP at 2 M"}),
            "PSFC": (dims, field(2) + 1e5, {**said, "units": "Pa"}),
        },
        attrs={"TITLE": " OUTPUT FROM WRF V4", "DX": np.float32(30000), "MAP_PROJ": np.int32(1)},
    )


def geo_em() -> Any:
    lon, lat = (it.astype("f4")[None] for it in curvilinear())
    dims = ("Time", "south_north", "west_east")
    said = {"FieldType": np.int32(104), "MemoryOrder": "XY ", "stagger": "M", "sr_x": np.int32(1)}
    return xr.Dataset(
        {
            "XLAT_M": (dims, lat, {**said, "units": "degrees latitude", "description": "Latitude on mass grid"}),
            "XLONG_M": (dims, lon, {**said, "units": "degrees longitude", "description": "Longitude on mass grid"}),
            "HGT_M": (dims, field(1), {**said, "units": "meters MSL"}),
            "LANDMASK": (dims, (field(1) > 0).astype("f4"), {**said, "units": "none"}),
        },
        attrs={"TITLE": "OUTPUT FROM GEOGRID V4"},
    )


def nemo() -> Any:
    around, across = np.meshgrid(np.arange(32), np.arange(24))
    lon = ((around * 10.0 + 90 + 1.0371 * across + np.sin(across) / 7 + 180) % 360 - 180.0).astype("f4")
    lat = (60 - across * 2 + 2 * np.sin(around / 36 * 2 * np.pi)).astype("f4")
    said = {"units": "degC", "coordinates": "time_centered nav_lat nav_lon", "_FillValue": np.float32(1e20)}
    values = field(2)
    values[:, :3, :4] = 1e20
    times = {"units": "seconds since 1900-01-01 00:00:00", "calendar": "gregorian", "bounds": "time_counter_bounds"}
    return xr.Dataset(
        {
            "nav_lat": (("y", "x"), lat, {"units": "degrees_north", "nav_model": "grid_T"}),
            "nav_lon": (("y", "x"), lon, {"units": "degrees_east", "nav_model": "grid_T"}),
            "time_centered": ("time_counter", np.array([3.0e9, 3.1e9]), times),
            "time_counter": ("time_counter", np.array([3.0e9, 3.1e9]), {**times, "axis": "T"}),
            "time_counter_bounds": (("time_counter", "axis_nbounds"), np.array([[2.9e9, 3.1e9], [3.0e9, 3.2e9]])),
            "sosstsst": (("time_counter", "y", "x"), values, {**said, "online_operation": "average"}),
        },
        attrs={"name": "ORCA2_5d", "timeStamp": "2020-Jan-01"},
    )


def cordex() -> Any:
    lon, lat = curvilinear()
    rlat, rlon = np.arange(24) * 0.11 - 2, np.arange(32) * 0.11 - 5
    corners = np.stack([lon, lon + 0.1, lon + 0.1, lon], axis=-1)
    said = {"units": "K", "coordinates": "height lat lon", "grid_mapping": "rotated_pole", "cell_methods": "time: mean"}
    pole = {
        "grid_mapping_name": "rotated_latitude_longitude",
        "grid_north_pole_latitude": 39.25,
        "grid_north_pole_longitude": -162.0,
    }
    return xr.Dataset(
        {
            "tas": (("time", "rlat", "rlon"), field(2) + 280, {**said, "_FillValue": np.float32(1e20)}),
            "lon": (("rlat", "rlon"), lon, {**EAST, "bounds": "lon_vertices"}),
            "lat": (("rlat", "rlon"), lat, {**NORTH, "bounds": "lat_vertices"}),
            "lon_vertices": (("rlat", "rlon", "vertices"), corners),
            "lat_vertices": (("rlat", "rlon", "vertices"), corners + 50),
            "rlat": ("rlat", rlat, {"standard_name": "grid_latitude", "units": "degrees", "axis": "Y"}),
            "rlon": ("rlon", rlon, {"standard_name": "grid_longitude", "units": "degrees", "axis": "X"}),
            "time": ("time", np.array([15.5, 45.0]), {**DATES, "bounds": "time_bnds"}),
            "time_bnds": (("time", "bnds"), np.array([[0.0, 31.0], [31.0, 59.0]])),
            "height": ((), 2.0, {"units": "m", "standard_name": "height", "positive": "up", "axis": "Z"}),
            "rotated_pole": ((), np.int32(0), pole),
        },
        attrs={"Conventions": "CF-1.4", "driving_model_id": "X"},
    )


def goes() -> Any:
    stored = (np.arange(24 * 32) * 7 % 4000).reshape(SHAPE).astype("i2")
    stored[3, 4:9] = -1
    said = {
        "_FillValue": np.int16(-1),
        "_Unsigned": "true",
        "valid_range": np.array([0, 3990], "i2"),
        "scale_factor": np.float32(0.05),
        "add_offset": np.float32(170),
        "units": "K",
        "coordinates": "band_id t y x",
        "grid_mapping": "goes_imager_projection",
    }
    angle = {"add_offset": np.float32(-0.1), "scale_factor": np.float32(0.000056), "units": "rad"}
    names = {letter: {"axis": letter.upper(), "standard_name": f"projection_{letter}_coordinate"} for letter in "xy"}
    sphere = {
        "grid_mapping_name": "geostationary",
        "perspective_point_height": 35786023.0,
        "semi_major_axis": 6378137.0,
        "semi_minor_axis": 6356752.31414,
        "longitude_of_projection_origin": -75.0,
        "latitude_of_projection_origin": 0.0,
        "sweep_angle_axis": "x",
    }
    quality = {
        "_FillValue": np.int8(-1),
        "valid_range": np.array([0, 3], "i1"),
        "flag_values": np.arange(4, dtype="i1"),
    }
    return xr.Dataset(
        {
            "CMI": (("y", "x"), stored, said),
            "DQF": (("y", "x"), (stored % 4).astype("i1"), quality),
            "t": ((), 6.5e8, {"units": "seconds since 2000-01-01 12:00:00", "axis": "T", "standard_name": "time"}),
            "y": ("y", np.arange(24, dtype="i2") * 3, {**angle, **names["y"], "scale_factor": np.float32(-0.000056)}),
            "x": ("x", np.arange(32, dtype="i2") * 3, {**angle, **names["x"]}),
            "band_id": ("band", np.array([13], "i1"), {"units": "1", "long_name": "ABI band number"}),
            "goes_imager_projection": ((), np.int32(-2147483647), sphere),
        },
        attrs={"title": "ABI L2", "Conventions": "CF-1.7"},
    )


def mom6() -> Any:
    xh, yh = np.arange(-279.5, -279.5 + 320, 10.0), np.linspace(-60, 85, 24)
    lon, lat = np.meshgrid(xh, yh)
    bent = lon + 40 * np.clip((lat - 60) / 25, 0, 1) * np.sin(np.deg2rad(2 * lon))
    said = {"units": "degC", "cell_measures": "area: areacello", "missing_value": np.float32(1e20)}
    values = field(1)
    values[:, :3, :4] = 1e20
    return xr.Dataset(
        {
            "SST": (("time", "yh", "xh"), values, {**said, "_FillValue": np.float32(1e20)}),
            "geolon": (("yh", "xh"), bent, {"units": "degrees_east", "long_name": "Longitude of tracer (T) points"}),
            "geolat": (("yh", "xh"), lat, {"units": "degrees_north", "long_name": "Latitude of tracer (T) points"}),
            "areacello": (("yh", "xh"), field() + 1000, {"units": "m2"}),
            "xh": ("xh", xh, {"units": "degrees_east", "long_name": "h point nominal longitude", "axis": "X"}),
            "yh": ("yh", yh, {"units": "degrees_north", "long_name": "h point nominal latitude", "axis": "Y"}),
            "time": ("time", np.array([182.5]), DATES),
        },
        attrs={"filename": "ocean.nc"},
    )


def codes() -> Any:
    """Integers of which several numbers, in a list, are missing."""
    stored = (np.arange(24 * 32) * 7 % 4000).reshape(SHAPE).astype("i2")
    said = {"missing_value": np.array([-5, 7, 14], "i2"), "units": "1"}
    return xr.Dataset({"kind": (("lat", "lon"), stored, said)}).assign_coords(
        lat=("lat", np.arange(24.0), NORTH), lon=("lon", np.arange(32.0), EAST)
    )


def hurricanes() -> Any:
    """A classic layout without a name of a variable for its dimensions, packed in 64-bit floats."""
    stored = (np.arange(2 * 24 * 32) * 7 % 400).reshape(2, *SHAPE).astype("u1")
    said = {"scale_factor": 0.25, "add_offset": -3.0, "_FillValue": np.uint8(255), "valid_max": np.uint8(250)}
    return xr.Dataset(
        {"wind": (("t", "j", "i"), stored, said), "t": ("t", np.array([0, 6]), {"units": "hours since 2001-01-01"})}
    )


#: Datasets as their files have them, undecoded; options that choose; other variables that become attributes.
CASES: dict[str, tuple[Callable[[], Any], dict[str, Any], list[str]]] = {
    "roms": (roms, {"variable": "zeta", "time": "1"}, ["h", "mask_rho"]),
    "roms by date": (roms, {"variable": "zeta", "time": "2001-01-21"}, []),
    "roms without time": (roms, {"variable": "h"}, ["mask_rho"]),
    "wrf": (wrf, {"variable": "T2", "time": "1"}, ["PSFC"]),
    "wrf by date": (wrf, {"variable": "T2", "time": "2000-01-25"}, []),
    "geo_em": (geo_em, {"variable": "HGT_M"}, ["LANDMASK"]),
    "nemo": (nemo, {"time": "0"}, []),
    "nemo by date": (nemo, {"time": "1998-03-27"}, []),
    "cordex": (cordex, {"variable": "tas", "time": "2001-02"}, []),
    "goes": (goes, {"variable": "CMI"}, ["DQF"]),
    "mom6": (mom6, {"variable": "SST"}, ["areacello"]),
    "codes": (codes, {}, []),
    "hurricanes": (hurricanes, {"at": "t:1"}, []),
}


def assert_same(there: ls.Surface, here: ls.Surface) -> None:
    """Values, x and y, closed axes, attributes and metadata agree, but for the name of the file."""
    assert (there.points.shape, there.dtype, there.closed) == (here.points.shape, here.dtype, here.closed)
    masks = [np.ones(it.shape, np.bool_) if it.mask is None else it.mask for it in (there, here)]
    np.testing.assert_array_equal(masks[0], masks[1])
    if here.points.ndim == 2:
        np.testing.assert_array_equal(there.points[masks[0]], here.points[masks[0]])
        for ours, theirs in zip(coordinates(there), coordinates(here), strict=True):
            np.testing.assert_array_equal(ours, theirs)
    else:
        np.testing.assert_array_equal(there.points, here.points)
    assert sorted(there.attributes) == sorted(here.attributes)
    for name, values in here.attributes.items():
        assert there.attributes[name].dtype == values.dtype, name
        np.testing.assert_array_equal(there.attributes[name], values)
    metadata = [{k: v for k, v in it.metadata.items() if k not in ("name", "format")} for it in (there, here)]
    assert metadata[0] == metadata[1]


def words(notes: list[str]) -> list[str]:
    """All words of some notes; a store of Zarr has its variables in another order."""
    return sorted(" ".join(notes).replace(",", "").split())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where each Dataset is written once."""
    return tmp_path_factory.mktemp("written")


@pytest.fixture(params=["netcdf", "zarr"])
def written(
    request: pytest.FixtureRequest, folder: Path
) -> Callable[[Callable[[], Any]], tuple[Path, Callable[..., Any]]]:
    """Write the Dataset that a function makes, and give the path and what opens it in xarray."""

    def write(make: Callable[[], Any]) -> tuple[Path, Callable[..., Any]]:
        path = folder / f"{make.__name__}.{'nc' if request.param == 'netcdf' else 'zarr'}"
        if request.param == "netcdf":
            if not path.exists():
                make().to_netcdf(path, engine="h5netcdf")
            return path, lambda **how: xr.open_dataset(path, engine="h5netcdf", **how)
        pytest.importorskip("zarr")
        if not path.exists():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of texts of fixed length
                make().to_zarr(path, consolidated=False)
        return path, lambda **how: xr.open_dataset(path, engine="zarr", consolidated=False, **how)

    return write


@contextmanager
def named(case: object) -> Iterator[None]:
    """Say of a failure which case of a loop it is of."""
    try:
        yield
    except BaseException as error:
        error.add_note(f"the case is {case}")
        raise


DECODINGS: list[dict[str, Any]] = [{}, {"decode_times": False}, {"mask_and_scale": False}, {"decode_coords": "all"}]


@pytest.mark.sweep(13)
@pytest.mark.parametrize("name", CASES)
@pytest.mark.long
def test_a_dataset_is_the_surface_of_its_file(name: str, written: Any) -> None:
    make, options, attributes = CASES[name]
    path, opened = written(make)
    here, said = noted(lambda: ls.read(path, **options, attributes=attributes))
    rest = [text for text in said if not text.startswith("left out variables of the same grid")]
    for decoded in DECODINGS:
        with named(decoded), opened(**decoded) as data:
            there, notes = noted(partial(ls.Surface.from_xarray, data, **options, attributes=attributes))
            assert_same(there, here)
            assert words(notes) == words(rest)


@pytest.mark.sweep(13)
@pytest.mark.parametrize("name", CASES)
@pytest.mark.long
def test_every_variable_along_the_grid_is_taken_or_named(name: str, written: Any) -> None:
    make, options, attributes = CASES[name]
    data = make()
    path, opened = written(make)
    surface, said = noted(lambda: ls.read(path, **options, attributes=attributes))
    with opened() as decoded:
        there, notes = noted(lambda: ls.Surface.from_xarray(decoded, **options, attributes=attributes))
    grid = data[surface.metadata["variable"]].dims[-2:]
    taken = {surface.metadata["variable"], *surface.attributes, *surface.metadata.get("scalars", ()), *grid}
    taken |= {"lon_rho", "lat_rho", "XLONG", "XLAT", "XLONG_M", "XLAT_M", "nav_lon", "nav_lat", "geolon", "geolat"}
    for variable in data.variables:
        if set(data[variable].dims) & set(grid) and variable not in taken:
            assert variable in " ".join(said).replace(",", " ").replace(";", " ").split()
    assert_same(there, surface)
    assert words(notes) == words([text for text in said if not text.startswith("left out variables of the same grid")])


@pytest.mark.sweep(13)
@pytest.mark.parametrize("name", CASES)
@pytest.mark.long
def test_without_a_choice_all_that_the_file_offers_becomes_attributes(name: str, written: Any) -> None:
    make, options, _ = CASES[name]
    path, opened = written(make)
    _, said = noted(lambda: ls.read(path, **options))
    offered = [text for text in said if text.startswith("left out variables of the same grid: ")]
    names = offered[0].split(": ")[1].split(";")[0].split(", ") if offered else []
    here, _ = noted(lambda: ls.read(path, **options, attributes=names))
    with opened() as data:
        there, _ = noted(lambda: ls.Surface.from_xarray(data, **options))
    assert_same(there, here)


@pytest.mark.sweep(13)
@pytest.mark.parametrize("name", CASES)
@pytest.mark.long
def test_containers_are_the_same(name: str, written: Any) -> None:
    make, options, attributes = CASES[name]
    path, opened = written(make)
    here, _ = noted(lambda: ls.decode(ls.encode(ls.read(path, **options, attributes=attributes))))
    with opened() as data:
        there, _ = noted(lambda: ls.decode(ls.encode(ls.Surface.from_xarray(data, **options, attributes=attributes))))
    assert_same(there, here)
    back, _ = noted(lambda: ls.Surface.from_xarray(here.to_xarray()))
    assert_same(back, here)


def test_an_option_that_is_none_is_refused() -> None:
    data = codes()
    with pytest.raises(OptionError, match=r"expected an option of .*variable, x, y, time, at.*got 'level'"):
        ls.Surface.from_xarray(data, level="3")


@pytest.mark.parametrize("nodata", [0, "0", 7.0])
def test_nodata_masks_as_in_a_file(nodata: Any, written: Any) -> None:
    def plain() -> Any:
        return xr.Dataset({"z": (("y", "x"), field())})

    path, opened = written(plain)
    here, said = noted(lambda: ls.read(path, nodata=nodata))
    assert here.mask is not None
    with opened() as data:
        there, notes = noted(lambda: ls.Surface.from_xarray(data, nodata=nodata))
    assert_same(there, here)
    assert notes == said


@pytest.mark.parametrize("holes", [False, True])
def test_longitudes_of_32_bits_that_were_unwrapped_come_back(holes: bool, tmp_path: Path) -> None:
    data = nemo()
    if not holes:
        data["sosstsst"] = (data.sosstsst.dims, field(2), {k: data.sosstsst.attrs[k] for k in ("units", "coordinates")})
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    surface, _ = noted(lambda: ls.read(tmp_path / "a.nc", time=0))
    assert surface.dtype == np.float64  # which holds what was unwrapped, and whole turns
    found = surface.to_xarray()
    for letter, name in (("x", "nav_lon"), ("y", "nav_lat")):
        assert found[letter].dtype == np.float32
        np.testing.assert_array_equal(found[letter].values, data[name].values)
    assert found.sosstsst.dtype == np.float32


def test_flags_are_those_of_the_file(tmp_path: Path) -> None:
    data = xr.Dataset({"z": (("y", "x"), field()), "land": (("y", "x"), field() > 0)})
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    here = ls.read(tmp_path / "a.nc", attributes="land")
    with xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as opened:
        assert_same(ls.Surface.from_xarray(opened), here)
    assert here.attributes["land"].dtype == np.uint8
    np.testing.assert_array_equal(here.attributes["land"] == 1, field() > 0)
    flags, _ = noted(lambda: ls.read(tmp_path / "a.nc", variable="land"))
    np.testing.assert_array_equal(flags.points == 1, field() > 0)
