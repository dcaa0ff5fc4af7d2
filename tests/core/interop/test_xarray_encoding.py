"""`encode` of what is of xarray: as `Surface.from_xarray` takes it, read by windows."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream import scratch, sources

from ..surfaces import terrain

xr = pytest.importorskip("xarray")

SHAPE = (400, 330)
HEIGHTS = np.rint(300 * terrain(SHAPE)).astype(np.int16)
WKT = 'LOCAL_CS["site",UNIT["metre",1]]'


def _even() -> Any:
    places = {"y": 4e6 - 30.0 * np.arange(SHAPE[0]), "x": 5e5 + 30.0 * np.arange(SHAPE[1])}
    attrs = {"units": "m", "grid_mapping": "spatial_ref"}
    told = {"crs_wkt": WKT, "GeoTransform": "499985.0 30.0 0.0 4000015.0 0.0 -30.0"}
    return xr.DataArray(HEIGHTS, places, ("y", "x"), "depth", attrs).assign_coords(spatial_ref=((), 0, told))


def _uneven() -> Any:
    uneven = _even().assign_coords(x=5e5 + np.arange(SHAPE[1]) ** 1.5).drop_vars("spatial_ref")
    del uneven.attrs["grid_mapping"]
    return uneven


def _curvilinear() -> Any:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    places: dict[str, Any] = {
        "lon": (("j", "i"), 10 + 0.01 * x + 0.002 * y),
        "lat": (("j", "i"), 50 + 0.01 * y - 1e-5 * x**2),
    }
    for name, units in (("lon", "degrees_east"), ("lat", "degrees_north")):
        places[name] = (*places[name], {"units": units})
    return xr.DataArray(HEIGHTS.astype(np.float32), places, ("j", "i"), "t")


def _rotated() -> Any:
    surface = ls.Surface(HEIGHTS, metadata={"geotransform": [5e5, 30.0, 5.0, 4e6, 5.0, -30.0]})
    return surface.to_xarray()["z"]


def _flags() -> Any:
    return _even().to_dataset(name="z").assign(slope=_even().astype(np.float32) / 7, land=_even() > 100)


def _with_holes() -> Any:
    mask = terrain(SHAPE) > 0.1
    return ls.Surface(HEIGHTS, mask=mask, metadata={"nodata": -32768, "unit": "m"}).to_xarray()


@cache
def _whole(make: Callable[[], Any]) -> bytes:
    """The container of a surface in memory."""
    return ls.encode(ls.Surface.from_xarray(make()))


@pytest.fixture
def by_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read a few thousand values at a time."""
    monkeypatch.setattr(sources, "_AT_ONCE", 4_000)
    monkeypatch.setattr(scratch, "_AT_ONCE", 4_000)


@pytest.mark.sweep(6)
@pytest.mark.parametrize("make", [_even, _uneven, _curvilinear, _rotated, _flags, _with_holes])
@pytest.mark.parametrize("lazy", ["memory", "file", "dask"])
@pytest.mark.long
def test_the_bytes_are_those_of_from_xarray(
    make: Callable[[], Any], lazy: str, tmp_path: Path, by_windows: None
) -> None:
    data = make()
    if lazy == "dask":
        pytest.importorskip("dask")
        data = data.chunk({data.dims[0] if isinstance(data, xr.DataArray) else "y": 64})
    if lazy != "file":
        expected = _whole(make)
    else:
        whole = data if isinstance(data, xr.Dataset) else data.to_dataset()
        whole.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
        opened = xr.open_dataset(tmp_path / "a.nc", engine="h5netcdf", decode_coords="all")
        data = opened if isinstance(data, xr.Dataset) else opened[data.name]
        expected = ls.encode(ls.Surface.from_xarray(data.copy(deep=True)))
    ls.encode(data, out=tmp_path / "a.lode", memory=1 << 20)
    assert (tmp_path / "a.lode").read_bytes() == expected
    assert {path.name for path in tmp_path.iterdir()} <= {"a.lode", "a.nc"}


def test_metadata_and_places_are_kept() -> None:
    back = ls.decode(ls.encode(_even()))
    assert np.array_equal(back.points, HEIGHTS)
    assert back.metadata["geotransform"] == [499985.0, 30.0, 0.0, 4000015.0, 0.0, -30.0]
    assert (back.metadata["unit"], back.metadata["crs"], back.metadata["variable"]) == ("m", WKT, "depth")


def test_what_is_larger_than_memory_is_computed_chunk_by_chunk(tmp_path: Path, by_windows: None) -> None:
    array = pytest.importorskip("dask.array")
    asked: list[tuple[int, ...]] = []

    def chunk(block_info: Any = None) -> NDArray[Any]:
        places = block_info[None]["array-location"]
        asked.append(tuple(start for start, _ in places))
        return HEIGHTS[tuple(slice(*place) for place in places)]

    values = array.map_blocks(chunk, chunks=((50,) * 8, (100, 100, 100, 30)), dtype=HEIGHTS.dtype)
    asked.clear()
    ls.encode(xr.DataArray(values, dims=("y", "x"), name="z"), out=tmp_path / "a.lode", memory=1 << 20)
    assert len(asked) == len(set(asked)) == 32
    assert np.array_equal(ls.decode((tmp_path / "a.lode").read_bytes()).points, HEIGHTS)


def test_a_tree_is_several_blocks() -> None:
    tree = ls.Surface(blocks=[ls.Block(HEIGHTS), ls.Block(HEIGHTS[:40])]).to_xarray()
    assert [block.shape for block in ls.decode(ls.encode(tree)).blocks] == [SHAPE, (40, SHAPE[1])]


def test_what_needs_a_choice_says_where_it_is_made() -> None:
    three = xr.DataArray(np.zeros((4, 20, 30)), dims=("time", "y", "x"), name="t")
    with pytest.raises(
        ls.FormatError, match=r"choose time .4. with time=0 to 3; lodestream\.Surface\.from_xarray takes"
    ):
        ls.encode(three)
    assert ls.decode(ls.encode(three[1])).shape == (20, 30)
    with pytest.raises(ls.FormatError, match="expected a variable over two dimensions"):
        ls.encode(xr.Dataset())


def test_attributes_that_are_left_out_are_not_read() -> None:
    array = pytest.importorskip("dask.array")
    asked: list[str] = []

    def variable(name: str) -> Any:
        def values() -> NDArray[Any]:
            asked.append(name)
            return np.where(HEIGHTS > 0, HEIGHTS, np.nan).round()

        lazy = array.from_delayed(dask.delayed(values)(), SHAPE, np.float64)
        return xr.Variable(("y", "x"), lazy, encoding={"dtype": "int32", "_FillValue": -9999})

    dask = pytest.importorskip("dask")
    data = xr.Dataset({name: variable(name) for name in ("depth", "speed", "kind")})
    surface = ls.Surface.from_xarray(data, variable="depth", attributes=["speed"])
    assert set(asked) == {"depth", "speed"}
    whole = ls.Surface.from_xarray(data, variable="depth")
    assert set(asked) == {"depth", "speed", "kind"}
    assert np.array_equal(surface.points, whole.points)
    assert surface.points.dtype == whole.points.dtype == np.int32
    assert list(surface.attributes) == ["speed"]
    assert np.array_equal(surface.attributes["speed"], whole.attributes["speed"], equal_nan=True)


class _Counted(xr.backends.BackendArray):  # type: ignore[misc, name-defined]
    """Values of a file that count how many of them are read."""

    def __init__(self, values: NDArray[Any]) -> None:
        self._values, self.shape, self.dtype = values, values.shape, values.dtype
        self.count = 0

    def __getitem__(self, key: Any) -> Any:
        support = xr.core.indexing.IndexingSupport.BASIC
        return xr.core.indexing.explicit_indexing_adapter(key, self.shape, support, self._read)

    def _read(self, key: Any) -> NDArray[Any]:
        values: NDArray[Any] = self._values[key]
        self.count += values.size
        return values


@pytest.mark.parametrize("dtype", ["i2", "f4"])
def test_only_what_is_taken_is_read(dtype: str) -> None:
    values = np.arange(9 * 24 * 32, dtype="f4").reshape(9, 24, 32) % 4000
    values[:, 3, 4] = np.nan
    arrays = {name: _Counted(values) for name in ("z", "other", "far")}

    def lazy(name: str, dims: tuple[str, ...]) -> Any:
        encoding = {"dtype": np.dtype(dtype), "_FillValue": np.dtype(dtype).type(-1)}
        return xr.Variable(dims, xr.core.indexing.LazilyIndexedArray(arrays[name]), {}, encoding)

    data = xr.Dataset({"z": lazy("z", ("time", "y", "x")), "far": lazy("far", ("time", "q", "r"))})
    data["other"] = lazy("other", ("time", "y", "x"))
    surface = ls.Surface.from_xarray(data, variable="z", time="4", attributes=[])
    assert surface.dtype == np.dtype(dtype)
    valid = ~np.isnan(values[4])
    np.testing.assert_array_equal(surface.points[valid], values[4][valid])
    assert arrays["z"].count <= 2 * values[4].size
    assert arrays["other"].count == arrays["far"].count == 0
    surface = ls.Surface.from_xarray(data, variable="z", time="4")
    np.testing.assert_array_equal(surface.attributes["other"][valid], values[4][valid])
    assert arrays["other"].count <= 2 * values[4].size
    assert arrays["far"].count == 0
