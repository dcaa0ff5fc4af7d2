"""Zarr stores: what a NetCDF of the same surface says, complete or absent, and nothing is replaced."""

from __future__ import annotations

import io
import json
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream import formats
from lodestream.errors import FormatError, FormatWarning, InputError, OptionError, UnavailableError
from lodestream.surface import Block, Surface

xarray = pytest.importorskip("xarray")
pytest.importorskip("h5netcdf")
zarr = pytest.importorskip("zarr")

PLACE = [500000.0, 30.0, 0.0, 4100000.0, 0.0, -30.0]
WGS84 = 'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],UNIT["degree",0.0174532925199433]]'


def hills(dtype: Any = np.float32, shape: tuple[int, int] = (600, 700)) -> NDArray[Any]:
    return (np.arange(shape[0] * shape[1]).reshape(shape) * 7 % 101 + 1).astype(dtype)


def hole() -> NDArray[np.bool_]:
    mask = np.ones((600, 700), np.bool_)
    mask[500:520, 3:600] = False
    return mask


def points(channels: int) -> NDArray[np.float64]:
    x, y = np.meshgrid(np.arange(700.0) ** 1.5, np.arange(600.0) ** 1.2)
    return np.stack((x + y, y - x, hills(np.float64), x * y)[:channels], axis=-1)


SURFACES: dict[str, Surface] = {
    **{dtype: Surface(hills(dtype), metadata={"geotransform": PLACE}) for dtype in ("uint8", "int16", "float64")},
    **{
        f"{dtype} with holes": Surface(hills(dtype), mask=hole(), metadata={"geotransform": PLACE, "nodata": -9999})
        for dtype in ("uint8", "int16", "int64", "uint64", "float32", "float64")
    },
    "bare": Surface(hills(np.float32, (6, 9))),
    "curve": Surface(np.arange(300.0).reshape(100, 1, 3)),
    "rotated": Surface(hills(), mask=hole(), metadata={"geotransform": [10, 30.5, 1, 0.3, 1, -30.0]}),
    "rotated integers": Surface(hills("int32"), mask=hole(), metadata={"grid": [[0, 3, 0.01, 0], [0, 0.01, 2, 0]]}),
    "along rows": Surface(hills(), metadata={"axes": {"x": [1, 2], "y": [0, 0.1], "rows": "x", "dtype": "float32"}}),
    "linspace": Surface(hills(), metadata={"grid": [[0, 7, True], [1, 9, True]]}),
    "degrees": Surface(
        hills(),
        attributes={"quality": hills("int8"), "wind": np.stack([hills()] * 3, axis=-1)},
        metadata={
            "geotransform": [10, 0.01, 0, 45, 0, -0.01],
            "crs": WGS84,
            "variable": "depth",
            "name": "sea",
            "unit": "m",
            "tags": {"": {"NC_GLOBAL#history": "made", "depth#long_name": "Tiefe der Förde"}},
        },
    ),
    "planar": Surface(points(2), metadata={"crs": WGS84}),
    "xyz": Surface(points(3), mask=hole(), attributes={"kind": hills("int16")}),
    "channels": Surface(points(4)),
}


@pytest.mark.sweep(19)
@pytest.mark.parametrize("decoded", [{}, {"decode_cf": False}, {"decode_coords": "all"}])
@pytest.mark.parametrize("name", SURFACES)
@pytest.mark.long
def test_xarray_shows_what_it_shows_of_a_netcdf(tmp_path: Path, name: str, decoded: dict[str, Any]) -> None:
    for suffix in ("nc", "zarr"):
        formats.write(SURFACES[name], tmp_path / f"a.{suffix}")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        store = xarray.open_zarr(tmp_path / "a.zarr", chunks=None, **decoded)
    with xarray.open_dataset(tmp_path / "a.nc", engine="h5netcdf", **decoded) as dataset:
        xarray.testing.assert_identical(store, dataset)
        assert {key: it.dtype for key, it in store.variables.items()} == {
            key: it.dtype for key, it in dataset.variables.items()
        }
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.nc", "a.zarr"]


def test_values_are_those_of_the_surface(tmp_path: Path) -> None:
    surface = SURFACES["int16 with holes"]
    formats.write(surface, tmp_path / "a.zarr")
    group = zarr.open_group(tmp_path / "a.zarr", mode="r")
    assert group.metadata.zarr_format == 3
    assert group["z"].chunks == (512, 512)
    assert group["z"].fill_value == -9999
    np.testing.assert_array_equal(group["z"][:], np.where(hole(), surface.points, -9999))
    np.testing.assert_array_equal(group["x"][:], 500015 + 30.0 * np.arange(700))
    np.testing.assert_array_equal(group["y"][:], 4100000 - 15 - 30.0 * np.arange(600))


def test_a_rule_of_two_directions_has_coordinates_over_both(tmp_path: Path) -> None:
    # Even if a step is so small that it is lost in the rounding.
    surface = Surface(hills("int32"), metadata={"grid": [[0, 3, 1e-9, 0], [0, 1e-9, 2, 0]]})
    formats.write(surface, tmp_path / "a.zarr")
    store = xarray.open_zarr(tmp_path / "a.zarr", chunks=None)
    assert store["xc"].dims == store["yc"].dims == ("y", "x")
    np.testing.assert_array_equal(store["yc"], np.broadcast_to(2 * np.arange(600)[:, None], (600, 700)))


def test_a_store_is_no_stream() -> None:
    with pytest.raises(OptionError, match=r"expected format to be one of npy, .*, got 'zarr'"):
        formats.write_stream(SURFACES["bare"], "zarr", io.BytesIO())


@pytest.mark.parametrize("key", [{"grid": 1.5}, {"grid": [["a", "b"], [1, 2]]}, {"geotransform": [1, 2]}])
def test_metadata_that_are_no_rules_are_refused(tmp_path: Path, key: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"expected .* in the metadata, got"):
        formats.write(Surface(hills(), metadata=key), tmp_path / "a.zarr")
    assert list(tmp_path.iterdir()) == []


def test_several_blocks_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match=r"a\.zarr: expected one block for zarr, got 2"):
        formats.write(Surface(blocks=[Block(hills()), Block(hills())]), tmp_path / "a.zarr")
    assert list(tmp_path.iterdir()) == []


def test_holes_where_every_integer_is_a_height_are_nan(tmp_path: Path) -> None:
    full, mask = np.arange(512).reshape(2, 256).astype("u1"), np.arange(512).reshape(2, 256) < 300
    surface = Surface(full, (False, True), mask=mask)
    formats.write(surface, tmp_path / "a.zarr")
    back = formats.read(tmp_path / "a.zarr")
    assert (back.dtype.name, back.closed) == ("uint8", (False, True))  # by the mark
    np.testing.assert_array_equal(back.mask, mask)
    np.testing.assert_array_equal(back.points[mask], full[mask])
    zarr.open_group(tmp_path / "a.zarr").attrs["lodestream"] = "none"
    assert formats.read(tmp_path / "a.zarr").dtype.name == "float32"


def test_what_it_cannot_hold_is_said(tmp_path: Path) -> None:
    surface = Surface(hills(), attributes={"a b": hills()}, metadata={"foreign": {"me": b"no JSON"}})
    with pytest.warns(FormatWarning) as notes:
        formats.write(surface, tmp_path / "a.zarr")
    assert [str(note.message) for note in notes] == [
        "Zarr is written without foreign, which JSON cannot hold",
        "Zarr is written with a b as a_b",
    ]
    assert list(formats.read(tmp_path / "a.zarr").attributes) == ["a b"]


def test_without_the_library_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zarr", None)
    with pytest.raises(UnavailableError, match=r"expected zarr for Zarr stores, .* pip install 'lodestream\[zarr\]'"):
        formats.write(SURFACES["bare"], tmp_path / "a.zarr")
    assert list(tmp_path.iterdir()) == []


def test_an_empty_folder_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "a.zarr").mkdir()
    formats.write(SURFACES["bare"], tmp_path / "a.zarr")
    assert sorted(path.name for path in (tmp_path / "a.zarr").iterdir()) == ["z", "zarr.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "real.zarr").mkdir()
    (tmp_path / "a.zarr").symlink_to("real.zarr")
    formats.write(SURFACES["bare"], tmp_path / "a.zarr")
    assert (tmp_path / "a.zarr").is_symlink()
    assert (tmp_path / "real.zarr" / "zarr.json").is_file()


@pytest.mark.parametrize("kind", ["file", "notes", "another store", "our store"])
def test_nothing_that_is_there_is_replaced(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a.zarr"
    if kind == "file":
        path.write_text("a file")
    elif kind == "notes":
        path.mkdir()
        (path / "notes.txt").write_text("keep")
    elif kind == "another store":
        zarr.create_group(path, zarr_format=3).create_array("z", data=hills())
    else:
        formats.write(SURFACES["bare"], path)
    before = {it: it.read_bytes() for it in tmp_path.rglob("*") if it.is_file()}
    expected = (
        "a place for the folder of a Zarr store, got a file" if kind == "file" else "no folder of that name, or an"
    )
    with pytest.raises(FormatError, match=rf"a\.zarr: expected {expected}"):
        formats.write(SURFACES["degrees"], path)
    assert {it: it.read_bytes() for it in tmp_path.rglob("*") if it.is_file()} == before


def test_files_that_came_meanwhile_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, create = tmp_path / "a.zarr", zarr.Group.create_array

    def slow(group: Any, name: str, **said: Any) -> Any:
        path.mkdir(exist_ok=True)
        (path / "notes.txt").write_text("keep")
        return create(group, name, **said)

    monkeypatch.setattr(zarr.Group, "create_array", slow)
    with pytest.raises(OSError, match="not empty") as caught:
        formats.write(SURFACES["bare"], path)
    assert caught.value.filename == str(path)
    assert [it.name for it in tmp_path.rglob("*")] == ["a.zarr", "notes.txt"]


@pytest.mark.parametrize("step", ["array", "rename"])
def test_a_store_that_is_interrupted_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    create, replace = zarr.Group.create_array, Path.replace

    def interrupted(path: Path, target: Path) -> Any:
        if target == tmp_path / "a.zarr":
            raise KeyboardInterrupt
        return replace(path, target)  # of the store itself

    def cut(group: Any, name: str, **said: Any) -> Any:
        if name == "wind":
            raise KeyboardInterrupt
        return create(group, name, **said)

    if step == "array":
        monkeypatch.setattr(zarr.Group, "create_array", cut)
    else:
        monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        formats.write(SURFACES["degrees"], tmp_path / "a.zarr")
    assert not list(tmp_path.iterdir())


def test_a_store_as_a_source_is_refused_with_the_way_there_is(tmp_path: Path) -> None:
    formats.write(SURFACES["bare"], tmp_path / "a.zarr")
    assert json.loads((tmp_path / "a.zarr" / "zarr.json").read_text())["node_type"] == "group"
    np.testing.assert_array_equal(formats.read(tmp_path / "a.zarr").points, SURFACES["bare"].points)
