"""Files read into files: the surfaces that reading into memory gives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream import scratch
from lodestream.encoding.references import root_of
from lodestream.formats.raster import gdal
from lodestream.scratch import FolderScratch, Room


def _write(path: Path, kind: str) -> None:
    values = np.random.default_rng(3).integers(-300, 300, (1300, 70)).astype(np.int16)
    metadata: dict[str, Any] = {"geotransform": [10.0, 1.0, 0.0, 50.0, 0.0, -1.0], "nodata": -9999}
    mask = np.ones(values.shape, bool)
    mask[40:50, 3:9] = False
    if kind == "npy":
        np.save(path, values)
    elif kind == "swapped":
        np.save(path, values.astype(">f4"))
    elif kind == "fortran":
        np.save(path, np.asfortranarray(values))
    elif kind == "xyz":
        np.save(path, np.stack([values] * 3, axis=-1).astype(np.float64))
    elif kind == "tif":
        ls.write(ls.Surface(values, mask=mask, metadata=metadata), path)
    elif kind == "float tif":
        floats = values.astype(np.float32)
        floats[2, 2] = np.inf
        ls.write(ls.Surface(floats, metadata={**metadata, "nodata": "inf"}), path)
    elif kind == "bands":
        heights = ls.Surface(values, attributes={"speed": values + np.int16(1), "kind": values}, metadata=metadata)
        ls.write(heights, path)
    elif kind == "round":
        round_ = {"geotransform": [-180.0, 360 / 70, 0.0, 50.0, 0.0, -0.01], "crs": "EPSG:4326"}
        ls.write(ls.Surface(values, metadata=round_), path)
    elif kind in ("p3d", "round p3d"):
        points = np.stack([*np.indices(values.shape), values], axis=-1).astype(np.float32)
        ls.write(ls.Surface(points, (False, "round" in kind), mask=mask), path)
    elif kind == "volume":
        _write_volume(path)
    else:
        _write_dataset(path, values, mask, kind)


def _write_volume(path: Path) -> None:
    """Big-endian, with markers of records and IBLANK that says more than which points are holes."""
    i, j, k = 9, 70, 130
    values = np.arange(3 * i * j * k, dtype=">f8").tobytes()
    blank = np.arange(i * j * k, dtype=">i4") % 5
    parts = [np.array([i, j, k], ">i4").tobytes(), values + blank.astype(">i4").tobytes()]
    marks = [np.array([len(part)], ">i4").tobytes() for part in parts]
    path.write_bytes(b"".join(mark + part + mark for mark, part in zip(marks, parts, strict=True)))


def _write_dataset(path: Path, values: NDArray[np.int16], mask: NDArray[np.bool_], kind: str) -> None:
    """Packed heights with holes in the middle only, and what becomes an attribute."""
    xarray = pytest.importorskip("xarray")
    pytest.importorskip("zarr" if "zarr" in kind else "h5netcdf")
    packed = {"_FillValue": np.int16(-9999), "scale_factor": np.float32(0.5), "units": "m"}
    variables = {
        "z": (("lat", "lon"), np.where(mask, values, np.int16(-9999)), packed),
        "kind": (("lat", "lon"), values, {"_Unsigned": "true"}),
        "lat": ("lat", 50 - np.arange(1300) / 100, {"units": "degrees_north"}),
        "lon": ("lon", 10 + np.arange(70) / 100, {"units": "degrees_east"}),
    }
    dataset = xarray.Dataset(variables)
    if "zarr" in kind:
        dataset.to_zarr(path, zarr_format=int(kind[-1]), consolidated=False, encoding={"z": {"chunks": (300, 30)}})
    else:
        dataset.to_netcdf(path, engine="h5netcdf" if kind == "nc" else "scipy")


KINDS = {
    **dict.fromkeys(("npy", "swapped", "fortran", "xyz"), ".npy"),
    **dict.fromkeys(("tif", "float tif", "bands", "round"), ".tif"),
    **dict.fromkeys(("nc", "classic nc"), ".nc"),
    **dict.fromkeys(("zarr 2", "zarr 3"), ".zarr"),
    **dict.fromkeys(("p3d", "round p3d", "volume"), ".p3d"),
}


@pytest.mark.filterwarnings("ignore::lodestream.FormatWarning")
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_read_is_the_same(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if KINDS[kind] == ".tif":
        pytest.importorskip("rasterio")
    path = tmp_path / f"surface{KINDS[kind]}"
    _write(path, kind)
    options: dict[str, Any] = {"variable": "z", "attributes": "kind"} if KINDS[kind] in (".nc", ".zarr") else {}
    options |= {"plane": "j3,i-1"} if kind == "volume" else {}
    expected = ls.read(path, **options)
    monkeypatch.setattr(gdal, "_TILE_ROWS", 100)
    monkeypatch.setattr(gdal, "_AT_ONCE", 1)
    monkeypatch.setattr(scratch, "_AT_ONCE", 700)
    surface = ls.read(path, room=Room(lambda: FolderScratch(tmp_path / "room"), 1), **options)
    assert surface.metadata == expected.metadata
    for found, own in zip(surface.blocks, expected.blocks, strict=True):
        assert found.closed == own.closed
        assert found.points.dtype == own.points.dtype
        np.testing.assert_array_equal(found.points, own.points)
        assert (found.mask is None) == (own.mask is None)
        if found.mask is not None:
            np.testing.assert_array_equal(found.mask, own.mask)
        assert list(found.attributes) == list(own.attributes)
        for name, values in found.attributes.items():
            np.testing.assert_array_equal(values, own.attributes[name])
        arrays = [found.points, *found.attributes.values(), *([] if found.mask is None else [found.mask])]
        if KINDS[kind] == ".p3d":
            assert all(root_of(array) is not None for array in arrays)


def test_small_arrays_make_no_folder(tmp_path: Path) -> None:
    path = tmp_path / "surface.npy"
    _write(path, "npy")
    ls.read(path, room=Room(lambda: FolderScratch(tmp_path / "room"), 1 << 30))
    assert not (tmp_path / "room").exists()


def test_an_empty_array_is_in_no_file(tmp_path: Path) -> None:
    made = Room(lambda: FolderScratch(tmp_path / "room"), 0).empty((0, 3), np.float64)
    assert made.shape == (0, 3)
    assert made.dtype == np.dtype(np.float64)
    assert not scratch.is_made(made)


def test_there_is_no_limit_of_vertices_where_there_is_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "surface.npy"
    _write(path, "npy")
    monkeypatch.setattr("lodestream.formats.reading.DEFAULT_MAX_VERTICES", 1000)
    with pytest.raises(ls.TooLargeError):
        ls.read(path)
    assert ls.read(path, room=Room(lambda: FolderScratch(tmp_path / "room"), 1)).shape == (1300, 70)
    with pytest.raises(ls.TooLargeError):
        ls.read(path, room=Room(lambda: FolderScratch(tmp_path / "room"), 1), max_vertices=1000)
