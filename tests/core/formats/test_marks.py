"""The mark that Lodestream leaves in a file, where somebody else has written or changed it."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from numpy.typing import NDArray

import lodestream as ls
from lodestream.coordinates.height_fields import coordinates
from lodestream.errors import FormatWarning, InputError

from .openers import by_netcdf, by_zarr

pytest.importorskip("h5netcdf")

EAST = {"units": "degrees_east", "standard_name": "longitude"}
NORTH = {"units": "degrees_north", "standard_name": "latitude"}
WGS84 = 'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],UNIT["degree",0.0174532925199433]]'


def _memory(data: xr.Dataset, folder: Path, **options: Any) -> ls.Surface:
    return ls.Surface.from_xarray(data, **options)


every_opener = pytest.mark.parametrize("opener", [by_netcdf, by_zarr, _memory])


def sea(curved: bool = False) -> xr.Dataset:
    lat, lon = np.arange(24) * 0.5 + 40, np.arange(32) * 0.5 + 10
    values = np.add.outer(np.sin(lat), np.cos(lon)).astype("f4")
    dims = ("lat", "lon") if not curved else ("j", "i")
    east, north = np.meshgrid(lon, lat)
    places = {"lat": ("lat", lat, NORTH), "lon": ("lon", lon, EAST)}
    if curved:
        places = {"lat": (dims, north + east / 9, NORTH), "lon": (dims, east + north / 7, EAST)}  # type: ignore[dict-item]
    crs = xr.Variable((), 0, {"crs_wkt": WGS84})
    said = {"units": "m", "grid_mapping": "crs", "standard_name": "sea_floor_depth"}
    data = xr.Dataset({"depth": (dims, values, said), "crs": crs})
    return data.assign_coords(places)


def positions(surface: ls.Surface) -> tuple[NDArray[Any], NDArray[Any]]:
    return coordinates(surface) if surface.points.ndim == 2 else (surface.points[..., 0], surface.points[..., 1])


def mark_of(surface: ls.Surface) -> Any:
    data = surface.to_xarray()
    assert isinstance(data, xr.Dataset)
    return json.loads(data.attrs["lodestream"])


@pytest.mark.sweep(30)
@every_opener
@pytest.mark.parametrize("curved", [False, True])
@pytest.mark.parametrize(
    "forged",
    [
        {"geotransform": [0.0, 9.0, 0.0, 7.0, 0.0, -9.0]},
        {"axes": {"x": [1, 2], "y": [3, 4]}},
        {"grid": [[1, 2], [3, 4]]},
        {"crs": 'LOCAL_CS["elsewhere"]'},
        {"unit": "furlong"},
        {"nodes": [[0, 5], [0, 9]]},
        {"angles": [{"channel": 0, "period": 7.0, "low": 0.0}]},
        {"angles": 5},
        {"dtype": "int8"},
        {"tags": 5},
        {"tags": {"": 5}},
        {"tags": {"": {"x#units": 5}}},
        {"types": 5},
        {"scalars": 5},
        {"large": 2**70},
    ],
    ids=str,
)
@pytest.mark.long
def test_a_forged_mark_changes_no_place_and_no_unit(
    tmp_path: Path, opener: Callable[..., ls.Surface], curved: bool, forged: dict[str, Any]
) -> None:
    data = sea(curved)
    mark = mark_of(ls.Surface(data.depth.values, metadata={"variable": "depth"}))
    mark |= {"variable": "depth", "dims": [*data.depth.dims], "metadata": forged}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        expected = opener(data, tmp_path, variable="depth", attributes=[])
        surface = opener(data.assign_attrs(lodestream=json.dumps(mark)), tmp_path, attributes=[])
        there = ls.decode(ls.encode(surface))
    for found in (surface, there):
        np.testing.assert_array_equal(found.points, expected.points)
        for ours, theirs in zip(positions(found), positions(expected), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        assert {key: found.metadata.get(key) for key in ("crs", "unit", "geotransform", "axes", "grid")} == {
            key: expected.metadata.get(key) for key in ("crs", "unit", "geotransform", "axes", "grid")
        }
        assert (found.closed, found.dtype) == (expected.closed, expected.dtype)


def _paths(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield path
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, it in inner:
        yield from _paths(it, (*path, key))


def _replaced(value: Any, path: tuple[Any, ...], new: Any) -> Any:
    if not path:
        return new
    copy = value.copy()
    copy[path[0]] = _replaced(value[path[0]], path[1:], new)
    return copy


@pytest.mark.sweep(6)
@pytest.mark.parametrize(
    "new", [None, 2.5, "x", [1, 2], {"a": 1}, 2**70, True, -1, "row", "", [], ["a", "b"], {}, [[]]], ids=repr
)
@pytest.mark.long
def test_any_part_of_a_mark_may_be_anything(new: Any) -> None:
    surface = ls.Surface(
        np.arange(60.0).reshape(6, 10),
        (False, True),
        attributes={"a b": np.arange(60, dtype="u1").reshape(6, 10), "x": np.ones((6, 10))},
        metadata={
            "variable": "depth",
            "nodata": -9,
            "scalars": {"time": 5, "b c": 2},
            "seam": "cols",
            "turn": [0, 360.0, 1],
            "faces": {"diagonal": "main"},
            "tags": {"": {"a b#units": "m", "NC_GLOBAL#title": "t"}, "Z": {"k": "v"}},
            "types": {"a b#units": "float32"},
            "geotransform": [0.0, 36.0, 0.0, 7.0, 0.0, -9.0],
        },
    )
    data = surface.to_xarray()
    assert isinstance(data, xr.Dataset)
    mark = mark_of(surface)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for path in _paths(mark):
            data.attrs["lodestream"] = json.dumps(_replaced(mark, path, new))
            try:
                back = ls.Surface.from_xarray(data)
                ls.encode(back)
                again = back.to_xarray()
            except InputError:
                continue
            np.testing.assert_array_equal(back.points, surface.points)
            np.testing.assert_array_equal(positions(back)[0], positions(surface)[0])
            assert isinstance(again, xr.Dataset)
            assert len(back.attributes) == 2


@every_opener
def test_another_attribute_of_that_name_is_one_like_others(tmp_path: Path, opener: Callable[..., ls.Surface]) -> None:
    words = "interpolated by lodestream 0.9"
    surface = opener(sea().assign_attrs(lodestream=words), tmp_path, variable="depth", attributes=[])
    assert surface.metadata["tags"][""]["NC_GLOBAL#lodestream"] == words
    for name in ("b.nc", "b.zarr"):
        ls.write(surface, tmp_path / name)
        assert ls.read(tmp_path / name).metadata["tags"] == surface.metadata["tags"]


def test_attributes_that_have_become_something_else_are_no_attributes(tmp_path: Path) -> None:
    surface = ls.Surface(np.arange(60.0).reshape(6, 10), attributes={"red": np.ones((6, 10)), "blue": np.ones((6, 10))})
    data = surface.to_xarray()
    assert isinstance(data, xr.Dataset)
    for changed in (data.assign(red=data.red.mean("x")), data.assign(red="text"), data.drop_vars("red")):
        for opener in (by_netcdf, by_zarr, _memory):
            with warnings.catch_warnings(record=True) as notes:
                warnings.simplefilter("always")
                back = opener(changed, tmp_path)
            assert list(back.attributes) == ["blue"]
            said = [str(note.message) for note in notes if note.category is FormatWarning]
            assert any("red" in text for text in said) == ("red" in changed)


@every_opener
def test_a_variable_that_has_become_something_else_is_not_chosen(
    tmp_path: Path, opener: Callable[..., ls.Surface]
) -> None:
    data = ls.Surface(np.arange(60.0).reshape(6, 10)).to_xarray()
    assert isinstance(data, xr.Dataset)
    data = data.assign(z=data.z.mean("x"), depth=data.z * 2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        back = opener(data, tmp_path)
    np.testing.assert_array_equal(back.points, data.depth.values)
