"""NetCDF: which variable, over which coordinates, when, and what its values stand for."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream import formats
from lodestream.coordinates.height_fields import coordinates, to_xyz
from lodestream.coordinates.seams import restore
from lodestream.errors import (
    Choice,
    ChoiceError,
    FormatError,
    FormatWarning,
    OptionError,
    SwitchedOffError,
    UnavailableError,
)
from lodestream.surface import Surface

xarray = pytest.importorskip("xarray")
pytest.importorskip("h5netcdf")

Array = NDArray[Any]
Variables = dict[str, tuple[Any, ...]]

ENGINES = {"classic": ("scipy", "NETCDF3_CLASSIC"), "offset": ("scipy", "NETCDF3_64BIT"), "4": ("h5netcdf", "NETCDF4")}
EAST = {"units": "degrees_east"}
NORTH = {"units": "degrees_north"}


def save(path: Path, variables: Variables, kind: str = "4", **encoding: Any) -> Path:
    """Write variables as they are given: (dimensions, values, attributes)."""
    engine, format_name = ENGINES[kind]
    dataset = xarray.Dataset({name: xarray.Variable(*parts) for name, parts in variables.items()})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        dataset.to_netcdf(path, engine=engine, format=format_name, encoding=encoding or None)
    return path


def hills(shape: tuple[int, ...] = (6, 9), dtype: Any = np.float32) -> Array:
    return (np.arange(np.prod(shape)).reshape(shape) * 7 % 101).astype(dtype)


@pytest.mark.parametrize("kind", ENGINES)
@pytest.mark.parametrize("dtype", ["int16", "int32", "float32", "float64"])
def test_even_axes_become_a_geotransform(tmp_path: Path, kind: str, dtype: str) -> None:
    x, y = 500000.0 + 30 * np.arange(9), 900.0 - 20 * np.arange(6)
    path = save(
        tmp_path / "a.nc",
        {
            "z": (("y", "x"), hills(dtype=dtype), {"units": "m", "grid_mapping": "utm"}),
            "x": ("x", x, {"standard_name": "projection_x_coordinate"}),
            "y": ("y", y),
            "utm": ((), 0, {"crs_wkt": "PROJCS[here]"}),
        },
        kind,
    )
    surface = formats.read(path)
    assert (surface.dtype.name, surface.closed) == (dtype, (False, False))
    np.testing.assert_array_equal(surface.points, hills())
    assert surface.metadata == {
        "name": "a",
        "format": "netcdf",
        "variable": "z",
        "unit": "m",
        "crs": "PROJCS[here]",
        "geotransform": [499985.0, 30.0, 0.0, 910.0, 0.0, -20.0],
    }


@pytest.mark.parametrize("order", [("lat", "lon"), ("lon", "lat")])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("step", [1 / 3, 0.1, 0.125])
def test_axes_are_made_again_bit_for_bit(tmp_path: Path, order: tuple[str, str], dtype: str, step: float) -> None:
    lon = (20.1666667 + step * np.arange(9)).astype(dtype)
    lat = (-89.8333333 + step * np.arange(6)).astype(dtype)
    shape = (6, 9) if order[0] == "lat" else (9, 6)
    surface = formats.read(
        save(
            tmp_path / "a.nc",
            {"z": (order, hills(shape)), "lon": ("lon", lon, EAST), "lat": ("lat", lat, NORTH)},
        )
    )
    assert surface.points.ndim == 2
    x, y = coordinates(surface)
    assert ("axes" in surface.metadata) or step == 0.125
    assert x.dtype.name == (dtype if "axes" in surface.metadata else "float64")
    x, y = (plane if order[0] == "lat" else plane.T for plane in (x, y))
    np.testing.assert_array_equal(x, np.broadcast_to(lon[None, :], (6, 9)))
    np.testing.assert_array_equal(y, np.broadcast_to(lat[:, None], (6, 9)))
    turned = surface.metadata["geotransform"][2] != 0
    assert turned == (order[0] == "lon")


def test_nearly_even_axes_keep_their_numbers(tmp_path: Path) -> None:
    lon, lat = np.round(np.arange(9) / 30 + 234, 4).astype(np.float32), np.arange(6.0, dtype=np.float32)
    surface = formats.read(
        save(tmp_path / "a.nc", {"z": (("lat", "lon"), hills()), "lon": ("lon", lon), "lat": ("lat", lat)})
    )
    assert surface.points.ndim == 2
    np.testing.assert_array_equal(coordinates(surface)[0][0], lon)


def read_over(path: Path, lon: Array, lat: Array, **options: Any) -> Surface:
    """Heights of `hills` over these longitudes and latitudes, from a file."""
    z = ("lat", "lon"), hills((len(lat), len(lon)))
    return formats.read(save(path, {"z": z, "lon": ("lon", lon, EAST), "lat": ("lat", lat, NORTH)}), **options)


def test_uneven_axes_are_listed(tmp_path: Path) -> None:
    lon, lat = np.arange(9.0) ** 2, np.arange(6.0)
    surface = read_over(tmp_path / "a.nc", lon, lat)
    np.testing.assert_array_equal(surface.points, hills())
    assert "geotransform" not in surface.metadata
    np.testing.assert_array_equal(to_xyz(surface).points, np.dstack((*np.meshgrid(lon, lat), hills())))


def test_even_longitudes_over_uneven_latitudes_are_unwrapped_and_closed(tmp_path: Path) -> None:
    lon, lat = ((np.arange(36) * 10.0 + 180) % 360), np.degrees(np.arcsin(np.linspace(-0.99, 0.99, 15)))
    surface = read_over(tmp_path / "a.nc", lon, lat)
    assert (surface.points.ndim, surface.closed) == (2, (False, True))
    for plane, wanted in zip(coordinates(restore(surface)), np.meshgrid(lon, lat), strict=True):
        assert plane.tobytes() == wanted.tobytes()


AROUND = np.cumsum(np.tile([8.0, 10.0, 12.0, 10.0], 9)) - 8


@pytest.mark.parametrize(
    ("lon", "options", "closed"),
    [
        (AROUND, {}, True),
        (AROUND[::-1], {}, True),
        ((AROUND + 200) % 360, {}, True),
        (AROUND, {"closed": "none"}, False),
        (AROUND[:-9], {}, False),
        ((AROUND[:-9] + 200) % 360, {}, False),  # they jump
        (((AROUND[:-9] + 200) % 360).astype("f4"), {}, False),
        (((AROUND[:-9] + 200) % 360).astype("i4"), {}, False),
        (np.append(AROUND[:-9], 0.0), {}, False),  # x ends where it begins, once around
    ],
)
def test_uneven_longitudes_that_go_around_or_jump_are_axes(
    lon: Array, options: dict[str, str], closed: bool, tmp_path: Path
) -> None:
    lat = (np.arange(6.0) ** 2).astype(lon.dtype)
    surface = read_over(tmp_path / "a.nc", lon, lat, **options)
    assert (surface.points.ndim, surface.closed) == (2, (False, closed))
    for plane, wanted in zip(coordinates(restore(surface)), np.meshgrid(lon, lat), strict=True):
        assert (plane.dtype, plane.tobytes()) == (wanted.dtype, wanted.tobytes())
    steps = np.diff(surface.metadata["axes"]["x"][:-1])
    assert (np.abs(steps) < 180).all()  # unwrapped
    assert len(steps) == len(lon) - 1 + closed
    assert not closed or abs(steps.sum()) == 360  # once around, with the step over the seam


@pytest.mark.parametrize("jump", [0, 200])
def test_a_column_that_repeats_the_first_of_uneven_longitudes_is_merged(jump: int, tmp_path: Path) -> None:
    lon, lat = (np.append(AROUND, 360.0) + jump) % (360 if jump else 1000), np.arange(6.0) ** 2
    z = hills((6, len(AROUND)))
    z = np.concatenate((z, z[:, :1]), axis=1)
    path = save(tmp_path / "a.nc", {"z": (("lat", "lon"), z), "lon": ("lon", lon, EAST), "lat": ("lat", lat, NORTH)})
    surface = formats.read(path)
    assert (surface.shape, surface.closed) == ((6, len(AROUND)), (False, True))
    back = restore(surface)
    assert back.points.tobytes() == z.tobytes()
    assert coordinates(back)[0][0].tobytes() == lon.tobytes()


def test_axes_that_no_metadata_hold_become_points(tmp_path: Path) -> None:
    lat = np.arange(3.0) ** 2
    for lon, ndim in (
        (np.linspace(0, 2, 8000) ** 3, 3),
        (2**60 + np.arange(9) ** 3, 3),
        (np.append(np.arange(8.0) ** 2, np.nan), 3),
        (np.linspace(0, 2, 6000) ** 3, 2),
    ):
        z = ("y", "x"), hills((3, len(lon)), np.int64)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of heights without an x
            surface = formats.read(
                save(
                    tmp_path / "a.nc",
                    {"z": z, "x": ("x", lon), "y": ("y", lat.astype(np.int64) if lon.dtype.kind == "i" else lat)},
                )
            )
        assert surface.points.ndim == ndim
        np.testing.assert_array_equal(to_xyz(surface).points[1, :, 0], lon)


def test_a_variable_without_coordinates_is_heights(tmp_path: Path) -> None:
    surface = formats.read(save(tmp_path / "a.nc", {"z": (("j", "i"), hills()), "note": ((), 7)}))
    assert surface.metadata == {"name": "a", "format": "netcdf", "variable": "z", "scalars": {"note": 7}}
    half = formats.read(save(tmp_path / "b.nc", {"z": (("j", "i"), hills()), "j": ("j", np.arange(6.0) * 2)}))
    assert half.metadata["geotransform"] == [-0.5, 1.0, 0.0, -1.0, 0.0, 2.0]


@pytest.mark.parametrize("kind", ["classic", "4"])
def test_fill_values_are_holes(tmp_path: Path, kind: str) -> None:
    heights = hills()
    heights[1, 2], heights[3, 4], heights[5, 5] = 1e34, -7, np.nan
    attributes = {"_FillValue": np.float32(1e34), "missing_value": np.float32(-7)}
    path = save(tmp_path / "a.nc", {"z": (("y", "x"), heights, attributes)}, kind)
    surface = formats.read(path)
    assert surface.mask is not None
    assert np.argwhere(~surface.mask).tolist() == [[1, 2], [3, 4], [5, 5]]


def test_packed_values_are_unpacked(tmp_path: Path) -> None:
    packed = hills(dtype=np.int16)
    single = {"scale_factor": np.float32(0.1), "_FillValue": np.int16(0)}
    double = {"scale_factor": 0.1, "add_offset": -5.0}
    unsigned = {"_Unsigned": "true"}
    cases: list[tuple[Array, dict[str, Any], Array]] = [
        (packed, single, (packed * float(np.float32(0.1))).astype(np.float32)),
        (packed, double, packed * 0.1 - 5.0),
        (np.full((6, 9), -1, np.int8), unsigned, np.full((6, 9), 255, np.uint8)),
    ]
    for number, (values, attributes, expected) in enumerate(cases):
        surface = formats.read(save(tmp_path / f"{number}.nc", {"z": (("y", "x"), values, attributes)}))
        assert surface.dtype == expected.dtype
        valid = np.ones((6, 9), np.bool_) if surface.mask is None else surface.mask
        np.testing.assert_array_equal(surface.points[valid], expected[valid])
        assert (surface.mask is not None) == ("_FillValue" in attributes)


def test_the_conventions_tell_coordinates_from_variables(tmp_path: Path) -> None:
    rows, columns = np.indices((6, 9)).astype(np.float64)
    variables: Variables = {
        "temp": (("j", "i"), hills(), {"coordinates": "where_e where_n"}),
        "where_e": (("j", "i"), columns + rows / 9, {**EAST, "bounds": "where_e_bnds"}),
        "where_n": (("j", "i"), rows - columns / 9, NORTH),
        "where_e_bnds": (("j", "i", "corner"), np.zeros((6, 9, 4))),
    }
    with pytest.warns(FormatWarning, match="left out: where_e_bnds$"):
        surface = formats.read(save(tmp_path / "a.nc", variables))
    np.testing.assert_array_equal(surface.points, np.dstack((columns + rows / 9, rows - columns / 9, hills())))
    del variables["where_e_bnds"]
    # Vectors that the conventions know, in another unit, are before arrays; others behind.
    vectors: Variables = {
        "i": ("i", np.arange(9.0) * 5, {"axis": "X", "units": "m"}),
        "j": ("j", np.arange(6.0) * 4, {"axis": "Y", "units": "m"}),
    }
    with pytest.warns(FormatWarning, match="x and y are i and j; where_e and where_n are kept as attributes"):
        known = formats.read(save(tmp_path / "b.nc", variables | vectors))
    assert known.metadata["geotransform"] == [-2.5, 5.0, 0.0, -2.0, 0.0, 4.0]
    np.testing.assert_array_equal(known.attributes["where_e"], columns + rows / 9)
    plain = {name: parts[:2] for name, parts in vectors.items()}
    with pytest.warns(FormatWarning, match="x and y are where_e and where_n; left out: j, i"):
        behind = formats.read(save(tmp_path / "c.nc", variables | plain))
    np.testing.assert_array_equal(behind.points, surface.points)


@pytest.mark.filterwarnings("ignore:left out:lodestream.errors.FormatWarning")
def test_options_name_the_variable_and_its_coordinates(tmp_path: Path) -> None:
    rows, columns = np.indices((6, 9)).astype(np.float64)
    path = save(
        tmp_path / "a.nc",
        {
            "R": (("x", "y"), rows + 1),
            "Z": (("x", "y"), columns),
            "psi": (("x", "y"), hills()),
            "shift": ("x", np.arange(6.0) ** 2),
        },
    )
    with pytest.raises(
        ChoiceError, match="one variable over a surface, got R, Z, psi: choose with variable="
    ) as refused:
        formats.read(path)
    assert refused.value.choices == (
        *(Choice({"variable": name}, (6, 9)) for name in ("R", "Z", "psi")),
        Choice({"x": "R", "y": "Z"}, (6, 9)),
    )
    for choice in refused.value.choices:
        assert formats.read(path, closed="auto", **dict[str, Any](choice.options)).shape == choice.shape
    planar = formats.read(path, x="R", y="Z", attributes="psi")
    np.testing.assert_array_equal(planar.points, np.dstack((rows + 1, columns)))
    np.testing.assert_array_equal(planar.attributes["psi"], hills())
    raised = formats.read(path, x="R", y="Z", variable="psi")
    np.testing.assert_array_equal(raised.points, np.dstack((rows + 1, columns, hills())))
    mixed = formats.read(path, x="Z", y="shift", variable="psi")
    np.testing.assert_array_equal(mixed.points[4, 5], [5, 16, hills()[4, 5]])
    for options, error, message in (
        ({"variable": "rho"}, OptionError, "variable= one of R, Z, psi, shift, got 'rho'"),
        ({"variable": "shift"}, FormatError, "two dimensions of shift, got x"),
        ({"variable": "psi", "attributes": "shift"}, OptionError, "attributes= of numbers over x and y, got 'shift'"),
        ({"variable": "psi", "time": "0"}, OptionError, "expected no time=, got one: the dimensions are x, y"),
        ({"variable": "psi", "at": "z:0"}, OptionError, "at= with one of x, y, got 'z'"),
        ({"variable": "psi", "resolution": "8x8"}, OptionError, "resolution= for a VMEC file only"),
    ):
        with pytest.raises(error, match=message):
            formats.read(path, closed="auto", **dict[str, Any](options))


@pytest.mark.parametrize("kind", ["classic", "4"])
def test_times_and_depths_are_chosen_by_name(tmp_path: Path, kind: str) -> None:
    values = hills((3, 2, 1, 6, 9))
    path = save(
        tmp_path / "a.nc",
        {
            "t": (("time", "depth", "member", "y", "x"), values),
            "time": ("time", np.array([0.0, 31.0, 59.0]), {"units": "days since 2001-01-01"}),
        },
        kind,
    )
    ways = r"choose time \(3\) with time=0 to 2 and depth \(2\) with at=depth:0 to 1"
    options: dict[str, str] = {}
    with pytest.raises(ChoiceError, match=f"expected two dimensions of t, got 4: {ways}") as raised:
        formats.read(path)
    assert [choice.options for choice in raised.value.choices] == [{"time": place} for place in "012"]
    options |= raised.value.choices[2].options
    with pytest.raises(ChoiceError, match="got 3: choose depth") as raised:
        formats.read(path, closed="auto", **dict[str, Any](options))
    assert [choice.options for choice in raised.value.choices] == [{"at": f"depth:{place}"} for place in "01"]
    options |= raised.value.choices[1].options
    chosen = formats.read(path, closed="auto", **dict[str, Any](options))
    np.testing.assert_array_equal(chosen.points, values[2, 1, 0])
    for time, place in (("1", 1), ("-1", 2), ("2001-02", 1), ("2001-01-01T00", 0)):
        surface = formats.read(path, time=time, at=f"depth:{place % 2}")
        np.testing.assert_array_equal(surface.points, values[place, place % 2, 0])
    section = to_xyz(formats.read(path, at="x:4,depth:0"))
    np.testing.assert_array_equal(section.points[..., 2], values[:, 0, 0, :, 4])
    np.testing.assert_array_equal(section.points[:, 3, 1], [0, 31, 59])
    for wrong, message in (
        ({"time": "3"}, "time= with a number of 0 to 2 for time, got '3'"),
        ({"time": "2001"}, "one date of 2001-01-01.* to 2001-03-01.*, got '2001': 3 fit"),
        ({"time": "soon"}, "got 'soon': 0 fit"),
        ({"at": "depth:deep"}, "at= with a number of 0 to 1 for depth, got 'deep'"),
    ):
        with pytest.raises(OptionError, match=message):
            formats.read(path, closed="auto", **dict[str, Any](wrong))


@pytest.mark.parametrize("own", ["none", "index"])
def test_dates_of_another_variable_are_found(tmp_path: Path, own: str) -> None:
    """As in files of NEMO, whose dimension ``time_counter`` has its dates in ``time_centered``."""
    values = hills((3, 6, 9))
    dates = np.array([15.0, 45.0, 74.0])
    variables: Variables = {
        "t": (("time_counter", "y", "x"), values, {"coordinates": "time_centered"}),
        "time_instant": ("time_counter", dates + 10, {"units": "days since 2001-01-01"}),
        "time_centered": ("time_counter", dates, {"units": "days since 2001-01-01"}),
    }
    if own == "index":
        variables["time_counter"] = ("time_counter", np.arange(3))
    path = save(tmp_path / "a.nc", variables)
    np.testing.assert_array_equal(formats.read(path, time="2001-02").points, values[1])
    np.testing.assert_array_equal(formats.read(path, time="2").points, values[2])
    with pytest.raises(OptionError, match=r"one date of 2001-01-16.* to 2001-03-16.*, got '2002': 0 fit"):
        formats.read(path, time="2002")


def test_dates_along_x_are_no_times(tmp_path: Path) -> None:
    track: Variables = {
        "t": (("y", "x"), hills()),
        "x": ("x", np.arange(9.0), {"units": "m"}),
        "visited": ("x", np.arange(9.0), {"units": "days since 2001-01-01"}),
    }
    with pytest.raises(OptionError, match="expected no time=, got one: the dimensions are y, x"):
        formats.read(save(tmp_path / "a.nc", track), time="0")


@pytest.mark.parametrize(
    ("x", "y"),
    [
        *(("nav_lon", "nav_lat"), ("XLONG", "XLAT"), ("XLONG_M", "XLAT_M"), ("lon_rho", "lat_rho"), ("TLONG", "TLAT")),
        *(("glamt", "gphit"), ("x_rho", "y_rho"), ("lons", "lats"), ("geolon", "geolat"), ("xc", "yc"), ("xx", "yy")),
        *(("Easting", "Northing"), ("grid_x", "grid_y"), ("longitude_c", "latitude_c"), ("x1", "y1")),
    ],
)
def test_coordinates_are_found_by_their_names(tmp_path: Path, x: str, y: str) -> None:
    columns, rows = np.meshgrid(np.arange(9.0) ** 1.5, np.arange(6.0) ** 1.2)
    path = save(tmp_path / "a.nc", {"z": (("j", "i"), hills()), y: (("j", "i"), rows), x: (("j", "i"), columns)})
    surface = formats.read(path)
    np.testing.assert_array_equal(surface.points, np.stack((columns, rows, hills()), axis=-1))
    vectors: Variables = {"z": (("j", "i"), hills()), x: ("i", columns[0]), y: ("j", rows[:, 0])}
    np.testing.assert_array_equal(to_xyz(formats.read(save(tmp_path / "b.nc", vectors))).points, surface.points)


@pytest.mark.parametrize(
    ("x", "y", "attributes"),
    [
        *(("dx", "dy", {}), ("x_velocity", "y_velocity", {}), ("x_wind", "y_wind", {}), ("Rxy", "Zxy", {})),
        *(("x_rho", "y_psi", {}), ("lon_rho", "lat_rho", {"standard_name": "sea_ice_drift"}), ("max", "may", {})),
        ("xc", "yc", {"units": "m s-1"}),
    ],
)
@pytest.mark.long
def test_names_that_say_no_place_are_candidates(tmp_path: Path, x: str, y: str, attributes: dict[str, str]) -> None:
    grid = {name: (("j", "i"), hills(), attributes) for name in (x, y, *(f"flow{number}" for number in range(30)))}
    with pytest.raises(FormatError) as refused:
        formats.read(save(tmp_path / "a.nc", grid))
    told = str(refused.value).partition("over a surface, got ")[2].partition(": choose with variable=")[0]
    assert told.split(", ") == list(grid)


def world(columns: int, repeat: bool, low: float = -180.0) -> Variables:
    lon = low + 360 / columns * np.arange(columns + repeat)
    heights = hills((5, columns))
    heights = np.concatenate((heights, heights[:, :1]), axis=1) if repeat else heights
    lat = np.linspace(-80, 80, 5)
    return {"z": (("lat", "lon"), heights), "lon": ("lon", lon, EAST), "lat": ("lat", lat, NORTH)}


@pytest.mark.parametrize("repeat", [False, True])
def test_once_around_the_earth_is_closed(tmp_path: Path, repeat: bool) -> None:
    variables = world(24, repeat)
    surface = formats.read(save(tmp_path / "a.nc", variables))
    assert (surface.shape, surface.closed) == ((5, 24), (False, True))
    back = restore(surface)
    np.testing.assert_array_equal(back.points, variables["z"][1])
    np.testing.assert_array_equal(coordinates(back)[0][0], variables["lon"][1])
    assert formats.read(tmp_path / "a.nc", closed="none").closed == (False, False)
    part = {name: (parts[0], parts[1][..., :20], *parts[2:]) for name, parts in variables.items()}
    assert formats.read(save(tmp_path / "b.nc", part)).closed == (False, False)


def test_longitudes_that_jump_are_even_all_the_same(tmp_path: Path) -> None:
    variables = world(24, False)
    lon = (variables["lon"][1] + 200 + 180) % 360 - 180
    variables["lon"] = ("lon", lon, EAST)
    surface = formats.read(save(tmp_path / "a.nc", variables))
    assert surface.points.ndim == 2
    assert surface.closed == (False, True)
    np.testing.assert_array_equal(coordinates(surface)[0][0], lon)


@pytest.mark.parametrize("repeat", [False, True])
@pytest.mark.parametrize("axis", [0, 1])
def test_curvilinear_grids_around_the_earth_are_closed(tmp_path: Path, repeat: bool, axis: int) -> None:
    around, across = np.meshgrid(np.arange(36 + repeat), np.arange(10))
    lon = ((around % 36) * 10 + 90 + across + 180) % 360 - 180.0
    lat = 60 - across * 10 + 2 * np.sin(around % 36 / 36 * 2 * np.pi)
    heights = hills((10, 36))
    heights = np.concatenate((heights, heights[:, :1]), axis=1) if repeat else heights
    planes = [plane.astype(np.float32) for plane in (lon, lat, heights)]
    if repeat:
        planes[1][:, -1] = planes[1][:, 0]
    if axis == 0:
        planes = [np.ascontiguousarray(plane.T) for plane in planes]
    variables: Variables = {
        "z": (("j", "i"), planes[2], {"coordinates": "lon lat"}),
        "lon": (("j", "i"), planes[0], EAST),
        "lat": (("j", "i"), planes[1], NORTH),
    }
    surface = formats.read(save(tmp_path / "a.nc", variables))
    assert surface.closed == ((True, False) if axis == 0 else (False, True))
    assert surface.shape == ((36, 10) if axis == 0 else (10, 36))
    assert "angles" in surface.metadata
    back = restore(surface)
    assert back.dtype == np.float32
    for channel in range(3):
        assert back.points[..., channel].tobytes() == planes[channel].tobytes()
    half = {
        name: (parts[0], parts[1][:, :8] if axis else parts[1][:8], *parts[2:]) for name, parts in variables.items()
    }
    assert formats.read(save(tmp_path / "b.nc", half)).closed == (False, False)


@pytest.mark.parametrize(("inside", "closed"), [(6, (False, True)), (4, (False, False))])
def test_the_core_of_a_tokamak_is_closed(tmp_path: Path, inside: int, closed: tuple[bool, bool]) -> None:
    rows, columns = np.indices((6, 9)).astype(np.float64)
    angle = columns * 2 * np.pi / 9
    path = save(
        tmp_path / "a.nc",
        {
            "Rxy": (("x", "y"), (rows + 3) * np.cos(angle)),
            "Zxy": (("x", "y"), (rows + 3) * np.sin(angle)),
            **{name: ((), value) for name, value in (("nx", 6), ("ny", 9), ("ixseps1", inside), ("ixseps2", 6))},
            "jyseps1_1": ((), -1),
            "jyseps2_2": ((), 8),
        },
    )
    assert formats.read(path, x="Rxy", y="Zxy").closed == closed
    assert formats.read(path, x="Rxy", y="Zxy", closed="none").closed == (False, False)


@pytest.mark.filterwarnings("ignore:left out:lodestream.errors.FormatWarning")
def test_the_boundary_of_a_stellarator_is_a_torus(tmp_path: Path) -> None:
    modes: Variables = {
        "rmnc": (("radius", "mode"), np.array([[0.0, 0.0, 0.0], [3.0, 1.0, 0.1]])),
        "zmns": (("radius", "mode"), np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.1]])),
        "xm": ("mode", np.array([0.0, 1.0, 1.0])),
        "xn": ("mode", np.array([0.0, 0.0, 5.0])),
    }
    surface = formats.read(save(tmp_path / "a.nc", modes, "offset"), resolution="12x40")
    assert (surface.points.shape, surface.closed) == ((12, 40, 3), (True, True))
    radius = np.hypot(surface.points[..., 0], surface.points[..., 1])
    u, v = np.arange(12)[:, None] * np.pi / 6, np.arange(40)[None, :] * np.pi / 20
    np.testing.assert_allclose(radius, 3 + np.cos(u) + 0.1 * np.cos(u - 5 * v))
    np.testing.assert_allclose(surface.points[..., 2], np.sin(u) + 0.1 * np.sin(u - 5 * v), atol=1e-12)
    assert formats.read(tmp_path / "a.nc").shape == (64, 256)
    assert formats.read(tmp_path / "a.nc", variable="rmnc").shape == (2, 3)
    assert formats.read(tmp_path / "a.nc", allowed=["vmec"]).shape == (64, 256)
    assert formats.read(tmp_path / "a.nc", allowed=["netcdf"], variable="rmnc").shape == (2, 3)
    with pytest.raises(SwitchedOffError, match="got vmec, which is switched off"):
        formats.read(tmp_path / "a.nc", allowed=["netcdf"])
    with pytest.raises(SwitchedOffError, match="got netcdf, which is switched off"):
        formats.read(tmp_path / "a.nc", allowed=["vmec"], variable="rmnc")
    for wrong in ("8", "2x9", "0x0", "1e9x4"):
        with pytest.raises(OptionError, match=f"resolution= as two numbers from 3 such as 64x256, got '{wrong}'"):
            formats.read(tmp_path / "a.nc", resolution=wrong)


def test_only_what_is_wanted_is_read(tmp_path: Path) -> None:
    path = save(tmp_path / "a.nc", {"z": (("time", "y", "x"), hills((4, 6, 9))), "time": ("time", np.arange(4))})
    assert formats.read(path, time="3", max_vertices=54).shape == (6, 9)
    with pytest.raises(FormatError, match="choose time"):
        formats.read(path)


def test_a_netcdf_without_its_libraries_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save(tmp_path / "a.nc", {"z": (("y", "x"), hills())})
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(UnavailableError, match=r"pip install 'lodestream\[formats\]'"):
        formats.read(path)


@pytest.mark.parametrize("kind", ["classic", "4"])
@pytest.mark.parametrize(
    ("error", "words"),
    [
        (SystemError, "<built-in method read> returned NULL without setting an exception"),
        (RuntimeError, ""),
        (OSError, " "),
        (RuntimeError, "Unspecified error in H5Dread (return value <0)"),
    ],
)
def test_a_library_that_does_not_say_why_has_not_refused_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[Exception], words: str, kind: str
) -> None:
    path = save(tmp_path / "a.nc", {"z": (("y", "x"), hills())}, kind)
    said = [error(words), RuntimeError("expected a whole chunk")]

    def fail(*args: Any, **options: Any) -> None:
        raise said.pop(0)

    monkeypatch.setattr(xarray.Variable, "isel", fail)
    with pytest.raises(UnavailableError, match=f"got {error.__name__}: they may have had too little memory"):
        formats.read(path)
    with pytest.raises(FormatError, match="expected a whole chunk"):
        formats.read(path)


def test_a_raster_of_uneven_longitudes_that_jump_goes_on_over_the_jump(tmp_path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    lon, lat = (AROUND[:-9] + 200) % 360, np.arange(6.0) * 2
    surface = read_over(tmp_path / "a.nc", lon, lat)
    with pytest.warns(UserWarning, match=r"evenly spaced rows and columns: x changes by up to [12]"):
        formats.write(surface, tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as raster:
        step = raster.transform.a
    assert step == pytest.approx((AROUND[-10] - AROUND[0]) / (len(lon) - 1))
