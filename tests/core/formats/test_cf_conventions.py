"""Files of models by the CF conventions: values, positions, CRS and attributes are those of xarray and pyproj."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyproj
import pytest
import rasterio
import xarray as xr
from numpy.typing import NDArray

import lodestream as ls
from lodestream.coordinates.height_fields import coordinates
from lodestream.errors import FormatError, FormatWarning, OptionError

from .openers import Opener, by_netcdf, by_xarray, by_zarr, noted

Array = NDArray[Any]
EAST = {"units": "degrees_east", "standard_name": "longitude"}
NORTH = {"units": "degrees_north", "standard_name": "latitude"}


def _classic(data: xr.Dataset, folder: Path, **options: Any) -> ls.Surface:
    data.to_netcdf(folder / "c.nc", engine="scipy", format="NETCDF3_64BIT")
    return ls.read(folder / "c.nc", **options)


OPENERS = {"netcdf4": by_netcdf, "classic": _classic, "zarr": by_zarr, "from_xarray": by_xarray}
every_opener = pytest.mark.parametrize("opener", OPENERS.values(), ids=OPENERS)


def positions(surface: ls.Surface) -> tuple[Array, Array]:
    if surface.points.ndim == 2:
        return coordinates(surface)
    return surface.points[..., 0], surface.points[..., 1]


def assert_at(surface: ls.Surface, x: Array, y: Array, turn: float | None = None) -> None:
    """x and y are within 1e-9 of these, longitudes up to whole turns."""
    east, north = positions(surface)
    away = east - x
    if turn is not None:
        away -= turn * np.rint(away / turn)
    assert np.abs(away).max() < 1e-9
    assert np.abs(north - y).max() < 1e-9


def heights_of(surface: ls.Surface) -> Array:
    return surface.points if surface.points.ndim == 2 else surface.points[..., 2]


def curvilinear(shape: tuple[int, int] = (24, 32)) -> tuple[Array, Array]:
    rows, columns = np.indices(shape).astype(np.float64)
    return -70 + 0.05 * columns + 0.01 * rows, 35 + 0.04 * rows + 0.005 * columns


def sea(fill: Any, dtype: str = "f4") -> tuple[xr.Dataset, Array]:
    """A masked field on a curvilinear grid, as of ROMS; where there is land."""
    lon, lat = curvilinear()
    rows, columns = np.indices(lon.shape)
    land = np.hypot(columns - 10, rows - 12) < 5
    values = np.where(land, np.nan, np.round(50 * np.sin(columns / 9) * np.cos(rows / 7)))
    grid = ("eta_rho", "xi_rho")
    data = xr.Dataset(
        {"zeta": (grid, values.astype("f4"), {"units": "m", "long_name": "free surface"})},
        {"lon_rho": (grid, lon, EAST), "lat_rho": (grid, lat, NORTH)},
    )
    data.zeta.encoding = {"_FillValue": fill, "dtype": dtype}
    return data, land


# Masks


@every_opener
@pytest.mark.parametrize(
    ("fill", "dtype"), [(np.float32(1e37), "f4"), (np.float32(np.nan), "f4"), (np.int16(-999), "i2")]
)
def test_a_fill_value_masks_a_value_and_no_place(tmp_path: Path, opener: Opener, fill: Any, dtype: str) -> None:
    data, land = sea(fill, dtype)
    surface, notes = noted(lambda: opener(data, tmp_path))
    assert notes == []
    assert_at(surface, data.lon_rho.values, data.lat_rho.values)
    np.testing.assert_array_equal(np.isnan(heights_of(surface)), land)
    np.testing.assert_array_equal(heights_of(surface)[~land], data.zeta.values[~land])
    back = ls.decode(ls.encode(surface))
    assert_at(back, data.lon_rho.values, data.lat_rho.values)
    assert back.mask is not None
    np.testing.assert_array_equal(back.mask, ~land)


def test_what_is_filled_is_the_same_whatever_stands_for_it(tmp_path: Path) -> None:
    found = []
    for fill in (np.float32(1e37), np.float32(np.nan)):
        for name, opener in OPENERS.items():
            (folder := tmp_path / f"{fill}{name}").mkdir()
            found.append(opener(sea(fill)[0], folder))
    first = found[0]
    for surface in found[1:]:
        np.testing.assert_array_equal(surface.points, first.points)
        np.testing.assert_array_equal(surface.mask, first.mask)


@every_opener
def test_a_height_without_a_place_is_kept_and_told(tmp_path: Path, opener: Opener) -> None:
    data, land = sea(np.float32(1e37))
    lon = data.lon_rho.values.copy()
    lon[3, 4] = np.nan
    data = data.assign_coords(lon_rho=(data.zeta.dims, lon, EAST))
    surface, notes = noted(lambda: opener(data, tmp_path))
    assert notes == ["1 value without x or y: holes until a stream is complete"]
    back = ls.decode(ls.encode(surface))
    for found in (surface, back):
        assert heights_of(found)[3, 4] == data.zeta.values[3, 4]
        assert np.isnan(positions(found)[0][3, 4])
        assert positions(found)[1][3, 4] == data.lat_rho.values[3, 4]
        np.testing.assert_array_equal(np.isnan(heights_of(found)), land)


@pytest.mark.parametrize("fill", [1e37, np.nan])
def test_a_map_can_be_drawn_where_the_source_could(tmp_path: Path, fill: float) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    from matplotlib import pyplot

    data, _ = sea(np.float32(fill))
    (tmp_path / "a.lode").write_bytes(ls.encode(by_netcdf(data, tmp_path)))
    with xr.open_dataset(tmp_path / "a.lode", engine="lode") as back:
        back.zeta.plot(x="x", y="y")
    pyplot.close("all")


# CRS

CONVENTIONS: dict[str, dict[str, Any]] = {
    "lambert": {
        "grid_mapping_name": "lambert_conformal_conic",
        "standard_parallel": [63.3, 63.3],
        "longitude_of_central_meridian": 15.0,
        "latitude_of_projection_origin": 63.3,
        "earth_radius": 6371000.0,
    },
    "mercator": {
        "grid_mapping_name": "mercator",
        "standard_parallel": 20.0,
        "longitude_of_projection_origin": 10.0,
        "semi_major_axis": 6378137.0,
        "inverse_flattening": 298.257223563,
    },
    "rotated": {
        "grid_mapping_name": "rotated_latitude_longitude",
        "grid_north_pole_latitude": 39.25,
        "grid_north_pole_longitude": -162.0,
    },
    "geographic": {
        "grid_mapping_name": "latitude_longitude",
        "semi_major_axis": 6378137.0,
        "inverse_flattening": 298.25,
    },
    "geostationary": {
        "grid_mapping_name": "geostationary",
        "perspective_point_height": 35786023.0,
        "semi_major_axis": 6378137.0,
        "semi_minor_axis": 6356752.31414,
        "longitude_of_projection_origin": -75.0,
        "latitude_of_projection_origin": 0.0,
        "sweep_angle_axis": "x",
    },
}
AXES = {
    "rotated": (
        {"standard_name": "grid_longitude", "units": "degrees"},
        {"standard_name": "grid_latitude", "units": "degrees"},
        0.11,
    ),
    "geographic": (EAST, NORTH, 0.11),
    "geostationary": (
        {"standard_name": "projection_x_coordinate", "units": "rad"},
        {"standard_name": "projection_y_coordinate", "units": "rad"},
        0.000056,
    ),
}
METRES = (
    {"standard_name": "projection_x_coordinate", "units": "m"},
    {"standard_name": "projection_y_coordinate", "units": "m"},
    3000.0,
)


def mapped(kind: str, said: str = "crs") -> xr.Dataset:
    east, north, step = AXES.get(kind, METRES)
    x, y = np.arange(-16, 16) * step, np.arange(11, -13, -1) * step
    values = np.add.outer(np.sin(y / step / 9), np.cos(x / step / 7)).astype("f4")
    data = xr.Dataset({"t": (("y", "x"), values, {"grid_mapping": said}), "crs": ((), np.int32(0), CONVENTIONS[kind])})
    return data.assign_coords(x=("x", x, east), y=("y", y, north))


@pytest.mark.sweep(14)
@every_opener
@pytest.mark.parametrize(
    ("kind", "said"),
    [*((kind, "crs") for kind in CONVENTIONS), ("lambert", "crs: x y"), ("geographic", "other: a b crs: x y")],
)
@pytest.mark.long
def test_a_crs_comes_from_the_attributes_of_the_conventions(
    tmp_path: Path, opener: Opener, kind: str, said: str
) -> None:
    data = mapped(kind, said)
    if "other" in said:
        data["other"] = ((), np.int32(0), CONVENTIONS["mercator"])
    surface, notes = noted(lambda: opener(data, tmp_path))
    assert_is_crs(pyproj.CRS.from_wkt(surface.metadata["crs"]).to_cf(), kind)
    factor = 35786023.0 if kind == "geostationary" else 1.0  # of angles to metres, as PROJ has it
    assert_at(surface, *np.meshgrid(data.x.values * factor, data.y.values * factor))
    assert len(notes) == (kind == "geostationary")
    assert all("by 35786023" in note for note in notes)


@pytest.mark.parametrize("kind", ["lambert", "mercator"])
def test_a_crs_is_the_one_that_gdal_finds(tmp_path: Path, kind: str) -> None:
    surface = by_netcdf(mapped(kind), tmp_path)
    with rasterio.open(tmp_path / "a.nc") as source:
        theirs, transform = pyproj.CRS.from_wkt(source.crs.to_wkt()), source.transform
    np.testing.assert_allclose(surface.metadata["geotransform"], transform.to_gdal())
    for crs in (theirs, pyproj.CRS.from_wkt(surface.metadata["crs"])):
        there = pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True).transform(30000.0, 12000.0)
        np.testing.assert_allclose(there, np.array(there))
    ours = pyproj.CRS.from_wkt(surface.metadata["crs"])
    places = [
        pyproj.Transformer.from_crs(crs, crs.geodetic_crs, always_xy=True).transform(3e4, 1.2e4)
        for crs in (ours, theirs)
    ]
    np.testing.assert_allclose(places[0], places[1], atol=1e-9)


@pytest.mark.parametrize("kind", CONVENTIONS)
@pytest.mark.parametrize("suffix", [".nc", ".zarr"])
def test_a_crs_is_written_in_attributes_of_the_conventions(tmp_path: Path, kind: str, suffix: str) -> None:
    surface, _ = noted(lambda: by_netcdf(mapped(kind), tmp_path))
    ls.write(surface, tmp_path / f"out{suffix}")
    opened = (
        xr.open_dataset(tmp_path / "out.nc")
        if suffix == ".nc"
        else xr.open_zarr(tmp_path / "out.zarr", consolidated=True)
    )
    with opened as data:
        assert_is_crs(data.spatial_ref.attrs, kind)
        assert_at(surface, *np.meshgrid(data[data.t.dims[1]].values, data[data.t.dims[0]].values))
    again, _ = noted(lambda: ls.read(tmp_path / f"out{suffix}"))
    assert again.metadata["crs"] == surface.metadata["crs"]


@cache
def _by_pyproj(kind: str) -> pyproj.CRS:
    return pyproj.CRS.from_cf(CONVENTIONS[kind])


def assert_is_crs(found: Any, kind: str) -> None:
    """The numbers of a CRS are those of a convention.

    pyproj's own comparison takes a rotated pole for another one if it went through WKT.
    """
    for key, value in _by_pyproj(kind).to_cf().items():
        if isinstance(value, str):
            assert key.endswith("_name") or key == "crs_wkt" or found[key] == value
        else:
            np.testing.assert_allclose(found[key], value, rtol=1e-12)
    assert found["grid_mapping_name"] == CONVENTIONS[kind]["grid_mapping_name"]


@pytest.mark.parametrize(
    ("kind", "more"),
    [
        *((kind, {}) for kind in CONVENTIONS),
        ("lambert", {"horizontal_datum_name": "of a survey"}),
        ("geographic", {"horizontal_datum_name": "of a survey"}),
        ("rotated", {"reference_ellipsoid_name": "GRS 1980"}),
        ("mercator", {"reference_ellipsoid_name": "GRS 1980"}),
        ("geographic", {"prime_meridian_name": "Paris"}),
        ("geostationary", {"prime_meridian_name": "Paris"}),
        ("lambert", {"longitude_of_prime_meridian": 2.5}),
        ("rotated", {"longitude_of_prime_meridian": 2.5}),
    ],
    ids=str,
)
def test_a_prime_meridian_that_is_not_named_is_the_one_of_pyproj(
    tmp_path: Path, kind: str, more: dict[str, Any]
) -> None:
    data = mapped(kind)
    data.crs.attrs |= more
    surface, _ = noted(lambda: _classic(data, tmp_path))
    assert surface.metadata["crs"] == (pyproj.CRS.from_cf(data.crs.attrs) if more else _by_pyproj(kind)).to_wkt()


@pytest.mark.parametrize("left", [{"semi_major_axis": 6378137.0}, {"inverse_flattening": 298.25}], ids=str)
def test_half_of_an_ellipsoid_is_what_pyproj_makes_of_it(tmp_path: Path, left: dict[str, Any]) -> None:
    data = mapped("geographic")
    data.crs.attrs = {"grid_mapping_name": "latitude_longitude", **left}
    surface, _ = noted(lambda: _classic(data, tmp_path))
    assert surface.metadata["crs"] == pyproj.CRS.from_cf(data.crs.attrs).to_wkt()


def test_a_grid_mapping_that_nobody_understands_is_told(tmp_path: Path) -> None:
    data = mapped("lambert")
    data.crs.attrs = {"grid_mapping_name": "of_another_planet"}
    surface, notes = noted(lambda: by_netcdf(data, tmp_path))
    assert "crs" not in surface.metadata
    assert len(notes) == 1
    assert notes[0].startswith("left out the grid mapping crs, which pyproj does not understand:")


# Places


def tripolar(bend: float) -> xr.Dataset:
    """Nominal axes and longitudes and latitudes of both, as of MOM6; these are bent in the north."""
    xh, yh = np.arange(-279.5, 80, 10.0), np.concatenate([np.arange(-60.0, 65, 5), 65 + np.arange(0, 25, 5)])
    lon, lat = np.meshgrid(xh, yh)
    cap = np.clip((lat - 65) / 25, 0, 1)
    lon, lat = lon + bend * cap * np.sin(np.deg2rad(2 * lon)), lat - bend / 3 * cap * np.cos(np.deg2rad(lon)) ** 2
    return xr.Dataset(
        {"sst": (("yh", "xh"), (15 + 12 * np.cos(np.deg2rad(lat))).astype("f4"), {"units": "degC"})},
        {
            "xh": ("xh", xh, {"units": "degrees_east", "long_name": "h point nominal longitude", "axis": "X"}),
            "yh": ("yh", yh, {"units": "degrees_north", "long_name": "h point nominal latitude", "axis": "Y"}),
            "geolon": (("yh", "xh"), lon, {"units": "degrees_east"}),
            "geolat": (("yh", "xh"), lat, {"units": "degrees_north"}),
        },
    )


@every_opener
def test_axes_that_lie_elsewhere_are_left_out(tmp_path: Path, opener: Opener) -> None:
    data = tripolar(40)
    surface, notes = noted(lambda: opener(data, tmp_path))
    assert_at(surface, data.geolon.values, data.geolat.values, 360)
    assert notes == [
        "x and y are geolon and geolat; left out are xh and yh, which lie elsewhere by more than half a cell"
    ]


@every_opener
def test_axes_that_lie_there_are_taken_and_the_others_kept(tmp_path: Path, opener: Opener) -> None:
    data = tripolar(1)
    surface, notes = noted(lambda: opener(data, tmp_path))
    east, north = np.meshgrid(data.xh.values, data.yh.values)
    assert_at(surface, east, north, 360)
    assert notes == ["x and y are xh and yh; geolon and geolat are kept as attributes"]
    for name in ("geolon", "geolat"):
        np.testing.assert_array_equal(surface.attributes[name], data[name].values)


@every_opener
@pytest.mark.parametrize("kind", ["rotated", "lambert"])
def test_longitudes_beside_axes_of_a_projection_are_kept(tmp_path: Path, opener: Opener, kind: str) -> None:
    data = mapped(kind)
    lon, lat = curvilinear((24, 32))
    data = data.assign_coords(lon=(("y", "x"), lon, EAST), lat=(("y", "x"), lat, NORTH))
    surface, notes = noted(lambda: opener(data, tmp_path))
    assert_at(surface, *np.meshgrid(data.x.values, data.y.values))
    assert notes == ["x and y are x and y; lon and lat are kept as attributes"]
    np.testing.assert_array_equal(surface.attributes["lon"], lon)


@every_opener
def test_coordinates_are_aligned_by_the_names_of_their_dimensions(tmp_path: Path, opener: Opener) -> None:
    lon, lat = curvilinear()
    values = (lon * lat).astype("f4")
    data = xr.Dataset(
        {"z": (("y", "x"), values), "speed": (("x", "y"), values.T + 1)},
        {"lon": (("x", "y"), lon.T, EAST), "lat": (("x", "y"), lat.T, NORTH)},
    )
    surface = opener(data, tmp_path, variable="z", attributes=["speed"])
    assert_at(surface, lon, lat)
    np.testing.assert_array_equal(surface.attributes["speed"], values + 1)
    given = opener(data, tmp_path, variable="z", x="lon", y="lat", attributes="speed")
    np.testing.assert_array_equal(given.points, surface.points)


@every_opener
@pytest.mark.parametrize("mark", ["_M", ""])
def test_the_coordinates_of_wrf_are_found(tmp_path: Path, opener: Opener, mark: str) -> None:
    lon, lat = curvilinear()
    dims = ("Time", "south_north", "west_east")
    data = xr.Dataset(
        {
            f"HGT{mark}": (dims, (lon * lat)[None].astype("f4"), {"units": "meters MSL", "stagger": "M"}),
            f"XLAT{mark}": (dims, lat[None], {"units": "degrees latitude", "stagger": "M"}),
            f"XLONG{mark}": (dims, lon[None], {"units": "degrees longitude", "stagger": "M"}),
        }
    )
    surface, notes = noted(lambda: opener(data, tmp_path))
    assert notes == []
    assert surface.metadata["variable"] == f"HGT{mark}"
    assert_at(surface, lon, lat)


def test_the_pair_of_the_grid_of_a_variable_is_taken(tmp_path: Path) -> None:
    """POP has coordinates of two grids over the same dimensions, and ``coordinates`` says which."""
    lon, lat = curvilinear()
    said = {"TLONG": lon, "TLAT": lat, "ULONG": lon + 0.02, "ULAT": lat + 0.02}
    dims = ("nlat", "nlon")
    data = xr.Dataset({n: (dims, v, EAST if n.endswith("LONG") else NORTH) for n, v in reversed(said.items())})
    data["SST"] = (dims, (lon * lat).astype("f4"), {"coordinates": "ULONG ULAT"})
    surface, notes = noted(lambda: by_netcdf(data, tmp_path, variable="SST"))
    assert_at(surface, lon + 0.02, lat + 0.02)
    assert notes == ["left out variables of the same grid: TLAT, TLONG; take them with attributes="]


# Files that are open


@pytest.mark.parametrize("engine", ["h5netcdf", "h5py", "h5py to write"])
def test_a_file_that_is_open_is_read(tmp_path: Path, engine: str) -> None:
    data = mapped("lambert")
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    opened: Any
    if engine == "h5netcdf":
        opened = xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf")
    else:
        opened = h5py.File(tmp_path / "a.nc", "r" if engine == "h5py" else "r+")
    with opened:
        np.testing.assert_array_equal(ls.read(tmp_path / "a.nc").points, data.t.values)


# Numbers


def numbered() -> xr.Dataset:
    x, y = np.arange(-10, 0.01, 0.25), np.arange(40, 45.01, 0.25)
    z = np.add.outer(100 * np.sin(y), 200 * np.cos(x)).astype("f4")
    said = {
        "actual_range": np.array([z.min(), z.max()], "f4"),
        "valid_range": np.array([-400, 400], "f4"),
        "level": np.int16(3),
        "weights": np.array([1, 2, 3], "i4"),
        "comment": "12",
    }
    return xr.Dataset(
        {"z": (("y", "x"), z, said), "speed": (("y", "x"), z + 1, {"height": np.float64(10.5)})},
        {"x": ("x", x, {"actual_range": [-10.125, 0.125]}), "y": ("y", y, {"actual_range": [39.875, 45.125]})},
        {"node_offset": np.int32(1), "title": "T"},
    )


PLACES = (
    "z level",
    "z weights",
    "z actual_range",
    "z valid_range",
    "z comment",
    "speed height",
    "x actual_range",
    " node_offset",
)


def attribute(data: xr.Dataset, place: str) -> Any:
    owner, _, key = place.partition(" ")
    return (data[owner] if owner else data).attrs[key]


@pytest.mark.parametrize("opener", [by_netcdf, _classic, by_xarray])
@pytest.mark.parametrize("out", ["a.nc", "a.zarr", "xarray", "lode"])
def test_numbers_of_attributes_stay_numbers(tmp_path: Path, opener: Opener, out: str) -> None:
    data = numbered()
    surface, notes = noted(lambda: opener(data, tmp_path, variable="z", attributes="speed"))
    assert notes == []
    surface = ls.decode(ls.encode(surface))
    found: Any
    if out == "xarray":
        found = surface.to_xarray()
    elif out == "lode":
        (tmp_path / "a.lode").write_bytes(ls.encode(surface))
        found = xr.open_dataset(tmp_path / "a.lode", engine="lode")
    else:
        (folder := tmp_path / "out").mkdir()
        ls.write(surface, folder / out)
        found = xr.open_zarr(folder / out) if out.endswith("zarr") else xr.open_dataset(folder / out, engine="h5netcdf")
    with found:
        for place in PLACES:
            before, after = attribute(data, place), attribute(found, place)
            np.testing.assert_array_equal(before, after)
            if not out.endswith("zarr"):  # JSON has one type of integers and one of floats
                assert np.asarray(before).dtype == np.asarray(after).dtype, place
            assert isinstance(after, str) == isinstance(before, str)


@pytest.mark.parametrize(
    ("said", "missing"),
    [
        ({"valid_range": np.array([0, 50], "i2")}, lambda v: (v < 0) | (v > 50)),
        ({"valid_min": np.int16(7)}, lambda v: v < 7),
        ({"valid_max": np.int16(90)}, lambda v: v > 90),
        ({"valid_min": np.int16(7), "valid_max": np.int16(90)}, lambda v: (v < 7) | (v > 90)),
        ({"valid_range": "0 50"}, lambda v: v < -999),
        (
            {"valid_range": np.array([0, 50], "i2"), "scale_factor": 0.5, "add_offset": 3.0},
            lambda v: (v < 0) | (v > 50),
        ),
        ({"valid_range": [3.0, 28.0], "scale_factor": 0.5, "add_offset": 3.0}, lambda v: (v < 0) | (v > 50)),
    ],
)
@pytest.mark.parametrize("opener", [by_netcdf, by_zarr, by_xarray])
def test_values_outside_the_valid_range_are_missing(
    tmp_path: Path, opener: Opener, said: dict[str, Any], missing: Callable[[Array], Array]
) -> None:
    stored = (np.arange(24 * 32) * 7 % 101).reshape(24, 32).astype("i2")
    data = xr.Dataset({"z": (("y", "x"), stored, said)})
    surface, notes = noted(lambda: opener(data, tmp_path))
    hidden = missing(stored)
    count = int(hidden.sum())
    if isinstance(said.get("valid_range"), str):
        assert notes == ["valid_range of z masks nothing, since it is no number or pair of numbers: '0 50'"]
    else:
        assert notes == ([f"{count} value{'s' * (count > 1)} of z outside its valid range: missing"] if count else [])
    mask = np.ones(stored.shape, np.bool_) if surface.mask is None else surface.mask
    np.testing.assert_array_equal(mask, ~hidden)
    expected = stored * said.get("scale_factor", 1) + said.get("add_offset", 0)
    np.testing.assert_array_equal(surface.points[mask], expected[mask])
    (folder := tmp_path / "out").mkdir()
    ls.write(surface, folder / "a.nc")
    again, notes = noted(lambda: ls.read(folder / "a.nc"))
    # Limits are those of the values that are written.
    assert [note for note in notes if "masks nothing" not in note] == []
    np.testing.assert_array_equal(mask, np.ones(stored.shape, np.bool_) if again.mask is None else again.mask)


@pytest.mark.sweep(20)
@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "i4", "f4", "f8"])
@pytest.mark.parametrize("fill", [False, True])
@pytest.mark.parametrize(
    "scale",
    [
        {"scale_factor": 0.01},
        {"scale_factor": np.float32(0.01)},
        {"scale_factor": np.float32(0.5), "add_offset": np.float32(3)},
        {"add_offset": 200.0},
        {"scale_factor": 2, "add_offset": 1},
    ],
)
@pytest.mark.long
def test_packed_values_are_those_of_xarray(tmp_path: Path, dtype: str, fill: bool, scale: dict[str, Any]) -> None:
    stored = (np.arange(24 * 32) * 7 % 101).reshape(24, 32).astype(dtype)
    said = scale | ({"_FillValue": stored.dtype.type(5)} if fill else {})
    xr.Dataset({"z": (("y", "x"), stored, said)}).to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    surface = ls.read(tmp_path / "a.nc")
    with xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf") as opened:
        values = opened.z.values
        there = ls.Surface.from_xarray(opened)
    for found in (surface, there):
        assert found.dtype == values.dtype
        np.testing.assert_array_equal(found.points, values)


@pytest.mark.parametrize("dtype", ["i2", "i4", "f4", "f8"])
@every_opener
def test_a_scale_of_1_widens_nothing(tmp_path: Path, opener: Opener, dtype: str) -> None:
    stored = (np.arange(24 * 32) * 7 % 101).reshape(24, 32).astype(dtype)
    data = xr.Dataset({"z": (("y", "x"), stored, {"scale_factor": 1.0, "add_offset": 0.0})})
    for surface in (opener(data, tmp_path), ls.Surface.from_xarray(data)):
        assert surface.dtype == stored.dtype
        np.testing.assert_array_equal(surface.points, stored)


# What is no grid


def ugrid() -> xr.Dataset:
    rng = np.random.default_rng(0)
    topology = {
        "cf_role": "mesh_topology",
        "topology_dimension": 2,
        "node_coordinates": "node_lon node_lat",
        "face_node_connectivity": "face_nodes",
    }
    return xr.Dataset(
        {
            "mesh": ((), 0, topology),
            "face_nodes": (("face", "three"), rng.integers(0, 200, (300, 3)).astype("i4"), {"start_index": 0}),
            "edge_nodes": (
                ("edge", "two"),
                rng.integers(0, 200, (400, 2)).astype("i4"),
                {"cf_role": "edge_node_connectivity"},
            ),
            "node_lon": ("node", rng.uniform(10, 11, 200), EAST),
            "node_lat": ("node", rng.uniform(50, 51, 200), NORTH),
            "depth": ("node", rng.uniform(0, 99, 200), {"mesh": "mesh", "location": "node"}),
            "salt": (("layer", "node"), rng.uniform(0, 9, (7, 200)), {"mesh": "mesh", "location": "node"}),
        }
    )


def mpas() -> xr.Dataset:
    return xr.Dataset(
        {
            "verticesOnCell": (("nCells", "maxEdges"), np.ones((90, 6), "i4")),
            "cellsOnVertex": (("nVertices", "vertexDegree"), np.ones((180, 3), "i4")),
            "lonCell": ("nCells", np.linspace(0, 6, 90)),
            "temperature": (("nCells", "nVertLevels"), np.ones((90, 20))),
        }
    )


def boozmn() -> xr.Dataset:
    modes = {name: (("pack_rad", "mn_modes"), np.ones((9, 40))) for name in ("rmnc_b", "zmns_b", "bmnc_b")}
    return xr.Dataset({"ixm_b": ("mn_modes", np.arange(40)), "ixn_b": ("mn_modes", np.arange(40)), **modes})


def old_gmt() -> xr.Dataset:
    ranges = {f"{letter}_range": ("side", np.array([0.0, 9.0])) for letter in "xyz"}
    size = {"spacing": ("side", np.ones(2)), "dimension": ("side", np.array([10, 10], "i4"))}
    return xr.Dataset({**ranges, **size, "z": ("xysize", np.arange(100, dtype="f4"))})


@every_opener
@pytest.mark.parametrize(
    ("made", "variables", "words"),
    [
        (ugrid, ("face_nodes", "edge_nodes", "salt"), r"an unstructured mesh \(UGRID\)"),
        (mpas, ("verticesOnCell", "temperature"), "an unstructured mesh"),
        (boozmn, ("rmnc_b",), "Fourier coefficients in Boozer coordinates"),
        (old_gmt, ("z",), "a grid of GMT before version 4"),
    ],
)
def test_what_holds_no_grid_is_refused_as_what_it_is(
    tmp_path: Path, opener: Opener, made: Callable[[], xr.Dataset], variables: tuple[str, ...], words: str
) -> None:
    for name in (None, *variables):
        with pytest.raises(FormatError, match=f"got {words}") as refused:
            opener(made(), tmp_path, **({} if name is None else {"variable": name}))
        assert "choose with variable=" not in str(refused.value)


@every_opener
def test_a_grid_beside_a_mesh_is_read(tmp_path: Path, opener: Opener) -> None:
    lon, lat = curvilinear()
    data = ugrid().assign(z=(("y", "x"), (lon * lat).astype("f4")))
    surface, notes = noted(lambda: opener(data, tmp_path))
    np.testing.assert_array_equal(surface.points, data.z.values)
    if opener is not by_xarray:  # which chooses attributes
        (note,) = notes
        mesh = {"face_nodes", "edge_nodes", "node_lon", "node_lat", "depth", "salt"}
        assert set(note.removeprefix("left out: ").split(", ")) == mesh


# Groups


def grouped(folder: Path, kind: str) -> Path:
    path = folder / f"a.{kind}"
    lon, lat = np.arange(32) * 0.1, np.arange(24) * 0.1
    values = np.add.outer(lat, lon).astype("f4")
    tree = xr.DataTree.from_dict(
        {
            "/": xr.Dataset(coords={"lon": ("lon", lon, EAST), "lat": ("lat", lat, NORTH)}),
            "/forecast/surface": xr.Dataset({"t": (("lat", "lon"), values)}),
            "/analysis": xr.Dataset({"t": (("lat", "lon"), values + 1), "u": (("lat", "lon"), values + 2)}),
        }
    )
    if kind == "nc":
        tree.to_netcdf(path, engine="h5netcdf")
    else:
        tree.to_zarr(path, consolidated=False)
    return path


@pytest.mark.parametrize("kind", ["nc", "zarr"])
def test_groups_are_named_and_chosen(tmp_path: Path, kind: str) -> None:
    path = grouped(tmp_path, kind)
    with pytest.raises(
        ls.ChoiceError, match="there are groups: analysis, forecast/surface, choose with group="
    ) as raised:
        ls.read(path)
    assert [choice.options["group"] for choice in raised.value.choices] == ["analysis", "forecast/surface"]
    for group in ("forecast/surface", "/forecast/surface"):
        with pytest.warns(FormatWarning, match="left out groups: analysis"):
            surface = ls.read(path, group=group)
        how: dict[str, Any] = {"engine": "h5netcdf"} if kind == "nc" else {"engine": "zarr", "consolidated": False}
        with xr.open_datatree(path, **how) as tree:
            node = tree["forecast/surface"]
            np.testing.assert_array_equal(surface.points, node.t.values)
            assert_at(surface, *np.meshgrid(node.lon.values, node.lat.values))
    with pytest.raises(FormatError, match="one variable over a surface, got t, u: choose with variable="):
        ls.read(path, group="analysis")
    with pytest.raises(OptionError, match="group= as one of analysis, forecast/surface, got 'observed'"):
        ls.read(path, group="observed")


# Attributes by name


@every_opener
@pytest.mark.parametrize("given", ["speed,kind", ["speed", "kind"], ("speed", "kind"), "speed, kind"])
def test_attributes_are_a_list_or_a_text_with_commas(tmp_path: Path, opener: Opener, given: Any) -> None:
    z = np.arange(24 * 32).reshape(24, 32).astype("f4")
    data = xr.Dataset({name: (("y", "x"), z + number) for number, name in enumerate(("z", "speed", "kind"))})
    surface = opener(data, tmp_path, variable="z", attributes=given)
    assert list(surface.attributes) == ["speed", "kind"]
    np.testing.assert_array_equal(surface.attributes["kind"], z + 2)


@every_opener
def test_attributes_are_unpacked_and_lack_what_is_missing(tmp_path: Path, opener: Opener) -> None:
    stored = (np.arange(24 * 32) % 90).reshape(24, 32).astype("i2")
    said = {"scale_factor": 0.5, "_FillValue": np.int16(7)}
    data = xr.Dataset({"z": (("y", "x"), stored), "packed": (("y", "x"), stored, said), "whole": (("y", "x"), stored)})
    surface = opener(data, tmp_path, variable="z", attributes="packed,whole")
    np.testing.assert_array_equal(surface.attributes["packed"], np.where(stored == 7, np.nan, stored * 0.5))
    assert surface.attributes["whole"].dtype == np.int16


# Longitudes


@pytest.mark.parametrize("dtype", ["f4", "f8"])
def test_longitudes_come_back_as_the_source_had_them(tmp_path: Path, dtype: str) -> None:
    around, across = np.meshgrid(np.arange(36), np.arange(10))
    lon = ((around * 10 + 90 + across + 180) % 360 - 180.0).astype(dtype)
    lat = (60 - across * 5 + 2 * np.sin(around / 36 * 2 * np.pi)).astype(dtype)
    z = (around * across).astype("f4")
    data = xr.Dataset({"z": (("j", "i"), z)}, {"lon": (("j", "i"), lon, EAST), "lat": (("j", "i"), lat, NORTH)})
    surface = by_netcdf(data, tmp_path)
    assert "angles" in surface.metadata
    (tmp_path / "a.lode").write_bytes(ls.encode(surface))
    with xr.open_dataset(tmp_path / "a.lode", engine="lode") as back:
        for found in (back, surface.to_xarray()):
            np.testing.assert_array_equal(found.x.values, lon)
            assert found.x.dtype == dtype
            np.testing.assert_array_equal(found.z.values, z)
            again = ls.Surface.from_xarray(found)
            np.testing.assert_array_equal(again.points, surface.points)
            assert again.closed == surface.closed
            assert again.metadata == surface.metadata
