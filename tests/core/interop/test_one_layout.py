"""A file says of a surface what its Dataset says: variables, dimensions, attributes, holes and the mark."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream.errors import FormatWarning

from ..formats.openers import noted
from ..surfaces import terrain, torus
from .test_xarray_files import CASES, EAST, NORTH

xr = pytest.importorskip("xarray")
pytest.importorskip("h5netcdf")

SHAPE = (24, 32)
PLACE = [500000.0, 30.0, 0.0, 4100000.0, 0.0, -30.0]
UTM = 'PROJCS["here",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
UTM += 'UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],UNIT["metre",1]]'
WGS84 = 'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],UNIT["degree",0.0174532925199433]]'

both = pytest.mark.parametrize("suffix", [".nc", ".zarr"])


def hills(dtype: str = "f4") -> NDArray[Any]:
    return np.rint(100 * terrain(SHAPE)).astype(dtype)


def hole() -> NDArray[np.bool_]:
    mask = np.ones(SHAPE, np.bool_)
    mask[3:9, 5:12] = False
    return mask


def infinite() -> NDArray[Any]:
    values = terrain(SHAPE).astype("f8")
    values[3, 4], values[5, 6] = np.inf, np.nan
    return values


TEXTS = {
    "NC_GLOBAL#title": "another",
    "NC_GLOBAL#Conventions": "CF-1.4",
    "NC_GLOBAL#a b": "blank",
    "NC_GLOBAL#a/b": "slash",
    "NC_GLOBAL#CLASS": "of HDF5",
    "depth#standard_name": "sea_floor_depth",
    "depth#coordinates": "gone",
    "depth#ancillary_variables": "gone too",
    "depth#flag_values": "{1,2}",
    "depth#kinds": '["a", "b"]',
    "depth#nested": '{"a": [1, null]}',
    "speed#comment": "",
    "x#long_name": "to the east",
    "a b/c#units": "K",
    "a b/c#levels": "{1.5,2.0}",
    "nobody#units": "m",
    "plain": "1",
}
TYPES = {"depth#flag_values": "int8", "a b/c#levels": "float32", "depth#kinds": "json", "depth#nested": "json"}
BESIDE: dict[str, Any] = {"speed": hills("u1"), "a b/c": hills("f8"), "x": np.stack([hills()] * 3, axis=-1)}

SURFACES = {
    "bare": ls.Surface(hills()),
    "named as a coordinate": ls.Surface(hills(), metadata={"variable": "x", "geotransform": PLACE}),
    "closed": ls.Surface(torus(*SHAPE), (True, True), metadata={"faces": {"diagonal": "main"}}),
    "integers with holes": ls.Surface(hills("i2"), mask=hole(), metadata={"nodata": -9999, "geotransform": PLACE}),
    "large integers with holes": ls.Surface(hills("i8"), mask=hole()),
    "every integer": ls.Surface(np.arange(768).reshape(SHAPE).astype("u1"), mask=hole()),
    "floats with nodata": ls.Surface(hills(), mask=hole(), metadata={"nodata": -1e20}),
    "infinite": ls.Surface(infinite()),
    "points with holes": ls.Surface(torus(*SHAPE), mask=hole(), metadata={"nodata": -5, "crs": UTM}),
    "integer points with holes": ls.Surface((1000 * torus(*SHAPE)).astype("i4"), mask=hole()),
    "planar": ls.Surface(torus(*SHAPE)[..., :2], attributes={"z": hills()}, metadata={"scalars": {"time": 2.5}}),
    "four channels": ls.Surface(np.concatenate([torus(*SHAPE), torus(*SHAPE)[..., :1]], axis=2)),
    "curve": ls.Surface(np.arange(300.0).reshape(100, 1, 3)),
    "rotated": ls.Surface(
        hills("i2"), mask=hole(), metadata={"geotransform": [1.0, 3.0, 0.5, 2.0, 0.5, -3.0], "crs": UTM}
    ),
    "along rows": ls.Surface(hills(), metadata={"axes": {"x": [1, 2], "y": [0, 0.1], "rows": "x", "dtype": "float32"}}),
    "linspace": ls.Surface(hills(), metadata={"grid": [[0, 7, True], [1, 9, True]]}),
    "a level": ls.Surface(hills(), metadata={"geotransform": PLACE, "nodes": [[*range(0, 46, 2), 45], [*range(32)]]}),
    "texts": ls.Surface(
        hills("i4"),
        mask=hole(),
        attributes=BESIDE,
        metadata={
            **{"variable": "depth", "unit": "m", "crs": WGS84, "geotransform": PLACE, "name": "sea", "types": TYPES},
            **{"tags": {"": TEXTS, "OTHER": {"k": "v"}}, "foreign": {"me": [1]}},
            "scalars": {"time": 3, "x": 1, "a b": 2, "word": "no", "row": 5, "depth": 7, "nan": float("nan")},
        },
    ),
}


def opened(path: Path, **how: Any) -> Any:
    if path.suffix == ".zarr":
        return xr.open_zarr(path, chunks=None, decode_coords="all", **how)
    return xr.open_dataset(path, engine="h5netcdf", decode_coords="all", **how)


def stored(data: Any) -> dict[str, tuple[Any, ...]]:
    """How variables are stored: type and what stands for holes, as far as a Dataset says so."""
    fills = {name: it.encoding.get("_FillValue") for name, it in data.variables.items()}
    return {
        name: (
            np.dtype(it.encoding.get("dtype") or it.dtype).name,
            str(None if fills[name] is None else it.dtype.type(fills[name])),
        )
        for name, it in data.variables.items()
    }


def assert_says_the_same(surface: ls.Surface, path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)
        ls.write(surface, path)
        wanted = surface.to_xarray()
    with opened(path, decode_times=False) as data:
        if path.suffix == ".nc":
            assert {key: type(it) for key, it in data.attrs.items()} == {
                key: type(it) for key, it in wanted.attrs.items()
            }
        xr.testing.assert_identical(data.load(), wanted)
        assert {name: it.dtype for name, it in data.variables.items()} == {
            name: it.dtype for name, it in wanted.variables.items()
        }
        found, expected = stored(data), stored(wanted)
        assert found == expected


@pytest.mark.sweep(18)
@both
@pytest.mark.parametrize("name", SURFACES)
def test_a_file_says_what_the_dataset_says(name: str, suffix: str, tmp_path: Path) -> None:
    assert_says_the_same(SURFACES[name], tmp_path / f"a{suffix}")


@pytest.mark.sweep(13)
@both
@pytest.mark.parametrize("name", CASES)
@pytest.mark.long
def test_a_file_says_what_the_dataset_says_of_every_convention(name: str, suffix: str, tmp_path: Path) -> None:
    make, options, attributes = CASES[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        make().to_netcdf(tmp_path / "in.nc", engine="h5netcdf")
    surface, _ = noted(lambda: ls.read(tmp_path / "in.nc", **options, attributes=attributes))
    surface, _ = noted(lambda: ls.decode(ls.encode(surface)))
    assert_says_the_same(surface, tmp_path / f"out{suffix}")
    back, notes = noted(lambda: ls.read(tmp_path / f"out{suffix}"))
    assert notes == []
    assert_whole(back, surface)


def assert_whole(back: ls.Surface, surface: ls.Surface) -> None:
    """Everything is as it was, but for the name of the file and its format."""
    assert (back.shape, back.closed) == (surface.shape, surface.closed)
    assert back.dtype == surface.dtype
    masks = [np.ones(it.shape, np.bool_) if it.mask is None else it.mask for it in (back, surface)]
    np.testing.assert_array_equal(masks[0], masks[1])
    np.testing.assert_array_equal(back.points[masks[0]], surface.points[masks[0]])
    assert list(back.attributes) == list(surface.attributes)
    for key, values in surface.attributes.items():
        assert back.attributes[key].dtype == values.dtype
        np.testing.assert_array_equal(back.attributes[key], values)
    found, wanted = (
        {key: it for key, it in surface.metadata.items() if key not in ("name", "format")}
        for surface in (back, surface)
    )
    found.pop("variable", None) if "variable" not in wanted else None
    assert found == wanted


@pytest.mark.sweep(16)
@both
@pytest.mark.parametrize("name", [name for name in SURFACES if name not in ("four channels", "curve")])
def test_a_file_of_lodestream_is_the_surface_again(name: str, suffix: str, tmp_path: Path) -> None:
    surface = SURFACES[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)
        ls.write(surface, tmp_path / f"a{suffix}")
        back = ls.read(tmp_path / f"a{suffix}")
    if name in ("linspace", "a level", "along rows"):  # rules become what the coordinates show
        np.testing.assert_array_equal(back.points, surface.points)
    elif name == "texts":
        assert back.metadata["tags"] == surface.metadata["tags"]
        assert back.metadata["types"] == surface.metadata["types"]
        assert list(back.attributes) == list(surface.attributes)
        assert str(back.metadata["scalars"]) == str(surface.metadata["scalars"]) or set(
            map(str, back.metadata["scalars"].items())
        ) == set(map(str, surface.metadata["scalars"].items()))
    else:
        assert_whole(back, surface)


@pytest.mark.sweep(12)
@both
@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8"])
@pytest.mark.parametrize("channels", [0, 2, 3])
@pytest.mark.long
def test_integers_with_holes_keep_their_type(dtype: str, channels: int, suffix: str, tmp_path: Path) -> None:
    limits = np.iinfo(dtype)
    values = np.random.default_rng(3).integers(max(limits.min, -(2**53)), min(limits.max, 2**53), (*SHAPE, 3))
    points = values.astype(dtype)[..., : channels or 1]
    surface = ls.Surface(points if channels else points[..., 0], mask=hole())
    with warnings.catch_warnings():
        warnings.simplefilter("error", FormatWarning)
        if np.unique(points).size == 256:
            warnings.simplefilter("ignore", FormatWarning)  # every number occurs
        ls.write(surface, tmp_path / f"a{suffix}")
        back = ls.read(tmp_path / f"a{suffix}")
        there = ls.Surface.from_xarray(surface.to_xarray())
    for found in (back, there):
        assert found.dtype == surface.dtype
        np.testing.assert_array_equal(found.mask, hole())
        np.testing.assert_array_equal(found.points[hole()], surface.points[hole()])


@both
def test_the_mark_is_of_its_own_variable_only(suffix: str, tmp_path: Path) -> None:
    surface = ls.Surface(
        hills("i2"), attributes={"speed": hills("f8")}, metadata={"unit": "m", "nodata": -5, "variable": "depth"}
    )
    ls.write(surface, tmp_path / f"a{suffix}")
    other, _ = noted(lambda: ls.read(tmp_path / f"a{suffix}", variable="speed"))
    np.testing.assert_array_equal(other.points, hills("f8"))
    assert other.metadata["variable"] == "speed"
    assert not {"unit", "nodata"} & set(other.metadata)
    with opened(tmp_path / f"a{suffix}") as data:
        assert ls.Surface.from_xarray(data, variable="speed").metadata["variable"] == "speed"


@both
@pytest.mark.parametrize(
    "mark", ["no JSON", "[]", "{}", '{"shape": [1], "closed": [0, 0], "dims": ["y", "x"]}', "[" * 9999]
)
def test_a_mark_that_somebody_has_changed_is_none(mark: str, suffix: str, tmp_path: Path) -> None:
    data = ls.Surface(hills(), (False, True), metadata={"geotransform": PLACE}).to_xarray()
    data.attrs["lodestream"] = mark
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf") if suffix == ".nc" else data.to_zarr(
        tmp_path / "a.zarr", consolidated=False
    )
    back = ls.read(tmp_path / f"a{suffix}")
    assert (back.closed, back.metadata["geotransform"]) == ((False, False), PLACE)


def test_the_mark_of_a_part_is_true_of_the_part(tmp_path: Path) -> None:
    surface = ls.Surface(torus(24, 32), (True, True), metadata={"unit": "m", "faces": {"diagonal": "main"}})
    ls.write(surface, tmp_path / "a.nc")
    with opened(tmp_path / "a.nc") as data:
        data.isel(row=slice(4, 9)).to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    part = ls.read(tmp_path / "b.nc")
    assert part.closed == (False, True)
    assert {key: part.metadata[key] for key in ("name", "unit")} == {"name": "b", "unit": "m"}
    assert "faces" not in part.metadata


def test_files_with_the_names_of_before_are_read(tmp_path: Path) -> None:
    lat, lon = np.linspace(40, 42.3, 24), np.linspace(10, 13.1, 32)
    said = {"units": "m", "grid_mapping": "crs", "_FillValue": np.float32(-9999), "ancillary_variables": "speed"}
    values = np.where(hole(), hills(), np.float32(-9999))
    data = xr.Dataset(
        {
            "height": (("lat", "lon"), values, said),
            "speed": (("lat", "lon"), hills("i2"), {"grid_mapping": "crs"}),
            "crs": ((), np.int32(0), {"crs_wkt": WGS84, "spatial_ref": WGS84}),
            "lat": ("lat", lat, {**NORTH, "axis": "Y"}),
            "lon": ("lon", lon, {**EAST, "axis": "X"}),
        },
        attrs={"Conventions": "CF-1.11", "title": "old"},
    )
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    surface = ls.read(tmp_path / "a.nc", variable="height", attributes="speed")
    assert (surface.metadata["crs"], surface.metadata["unit"]) == (WGS84, "m")
    np.testing.assert_array_equal(surface.mask, hole())
    np.testing.assert_array_equal(surface.attributes["speed"], hills("i2"))
    np.testing.assert_array_equal(surface.to_xarray().x.values, lon)


def test_a_geotransform_of_a_file_that_says_every_coordinate_is_kept(tmp_path: Path) -> None:
    transform = [100.1, 0.1, 0.0, 20.3, 0.0, -0.3]
    surface = ls.Surface(hills(), metadata={"geotransform": transform})
    data = surface.to_xarray()
    del data.attrs["lodestream"]
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    assert ls.read(tmp_path / "a.nc").metadata["geotransform"] == transform
    moved = data.assign_coords(x=data.x + 0.425)
    moved.to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    surface, notes = noted(lambda: ls.read(tmp_path / "b.nc"))
    assert surface.to_xarray().x.values.tobytes() == moved.x.values.tobytes()
    assert notes == ["left out a GeoTransform that lies elsewhere than x and y, by 4.25 cells"]


@both
@pytest.mark.parametrize("kind", ["lines", "points"])
def test_a_file_has_the_column_again_that_its_source_repeats(kind: str, suffix: str, tmp_path: Path) -> None:
    east, north = np.arange(33.0) * 11.25 - 100, np.linspace(-80, 80, 24)
    values = np.concatenate([hills(), hills()[:, :1]], axis=1)
    around, across = np.meshgrid(east, north)
    places: dict[str, Any] = {"lon": ("j", east), "lat": ("i", north)}
    if kind == "points":
        places = {
            "lon": (("i", "j"), (around + across / 9 + 180) % 360 - 180),
            "lat": (("i", "j"), across + 0 * around),
        }
        for _, plane in places.values():
            plane[:, -1] = plane[:, 0]
    data = xr.Dataset({"z": (("i", "j"), values)}, {"lon": (*places["lon"], EAST), "lat": (*places["lat"], NORTH)})
    surface, _ = noted(lambda: ls.Surface.from_xarray(data))
    assert (surface.shape, surface.closed, surface.metadata["seam"]) == ((24, 32), (False, True), "cols")
    _, notes = noted(lambda: ls.write(surface, tmp_path / f"a{suffix}"))
    assert notes == []
    with opened(tmp_path / f"a{suffix}") as found:
        np.testing.assert_array_equal(found.z.values, values)
        np.testing.assert_array_equal(found.x.values, data.lon.values)
        assert found.z.attrs == surface.to_xarray().z.attrs
        assert found.x.attrs == surface.to_xarray().x.attrs
        again, _ = noted(lambda: ls.Surface.from_xarray(found))
    back, _ = noted(lambda: ls.read(tmp_path / f"a{suffix}"))
    assert_whole(back, surface)
    assert_whole(again, surface)


SCALED = ls.Surface(
    hills("i2"),
    mask=hole(),
    attributes={"slope": hills("u1"), "aspect": hills("f4")},
    metadata={
        **{"unit": "K", "scale": 0.01, "offset": 273.15, "nodata": -9999, "geotransform": PLACE},
        "bands": {"slope": {"scale": 0.5, "unit": "degree"}},
    },
)


@both
def test_stored_numbers_of_a_raster_have_their_scale(suffix: str, tmp_path: Path) -> None:
    physical = {"z": hills("i2") * 0.01 + 273.15, "slope": hills("u1") * 0.5, "aspect": hills("f4")}
    ls.write(SCALED, tmp_path / f"a{suffix}")
    with opened(tmp_path / f"a{suffix}") as data:
        for name, values in physical.items():
            valid = hole() if name == "z" else ...
            np.testing.assert_allclose(data[name].values[valid], values[valid], rtol=1e-6)
        assert np.isnan(data.z.values[~hole()]).all()
        there = ls.Surface.from_xarray(data)
    np.testing.assert_allclose(there.points[hole()], physical["z"][hole()], rtol=1e-6)
    np.testing.assert_allclose(there.attributes["slope"], physical["slope"])
    assert not {"scale", "offset"} & set(there.metadata)
    assert "scale" not in there.metadata["bands"]["slope"]
    for back in (ls.read(tmp_path / f"a{suffix}"), ls.Surface.from_xarray(SCALED.to_xarray())):
        assert_whole(back, SCALED)
