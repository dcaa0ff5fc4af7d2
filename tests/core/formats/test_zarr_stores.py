"""Zarr stores as surfaces: what a NetCDF of the same Dataset gives, by chunks; hostile ones are refused."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream import formats
from lodestream.encoding.reading import read_into, reading_key
from lodestream.errors import UnavailableError
from tests.patience import PATIENCE

pytestmark = pytest.mark.filterwarnings("ignore:Consolidated metadata")

zarr = pytest.importorskip("zarr")
xarray = pytest.importorskip("xarray")

WGS84 = (
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]]'
)


def hills() -> NDArray[np.int16]:
    rows, columns = np.indices((90, 70))
    heights: NDArray[np.int16] = (100 + 40 * np.sin(rows / 4) + 30 * np.cos(columns / 3)).astype(np.int16)
    return heights


def sea() -> Any:
    depth = np.stack([hills(), hills() + np.int16(5)])
    depth[:, 10:15, 20:30] = -999
    said = {"_FillValue": np.int16(-999), "units": "m", "grid_mapping": "crs", "long_name": "depth of the sea"}
    variables = {
        "depth": (("time", "lat", "lon"), depth, said),
        "speed": (("time", "lat", "lon"), np.float32(depth), {}),
        "time": ("time", [0.0, 31.0], {"units": "days since 2001-01-01"}),
        "lat": ("lat", 50 - np.arange(90) / 100, {"units": "degrees_north"}),
        "lon": ("lon", 10 + np.arange(70) / 100, {"units": "degrees_east"}),
        "crs": ((), np.int32(0), {"crs_wkt": WGS84}),
    }
    return xarray.Dataset(variables, attrs={"history": "made"})


OPTIONS: dict[str, Any] = {"variable": "depth", "time": "2001-02", "attributes": "speed"}


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("consolidated", [True, False])
def test_a_store_is_what_a_netcdf_is(tmp_path: Path, version: Any, consolidated: bool) -> None:
    pytest.importorskip("h5netcdf")
    sea().to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    sea().to_zarr(tmp_path / "a.zarr", zarr_format=version, consolidated=consolidated)
    expected, found = (ls.read(tmp_path / name, **OPTIONS) for name in ("a.nc", "a.zarr"))
    assert found.metadata == {**expected.metadata, "format": "zarr"}
    assert found.metadata["crs"] == WGS84
    np.testing.assert_array_equal(found.points, expected.points)
    assert found.mask is not None
    np.testing.assert_array_equal(found.mask, expected.mask)
    np.testing.assert_array_equal(found.attributes["speed"], expected.attributes["speed"])


def test_shards_and_strange_chunks(tmp_path: Path) -> None:
    group = zarr.open_group(tmp_path / "a.zarr", mode="w")
    told: dict[str, Any] = {"dimension_names": ("y", "x"), "chunks": (16, 16), "shards": (48, 32)}
    group.create_array("z", data=hills(), **told)
    np.testing.assert_array_equal(read_into(tmp_path / "files", [tmp_path / "a.zarr"], 1 << 10).points, hills())


@pytest.mark.filterwarnings("ignore:left out. time:lodestream.errors.FormatWarning")
def test_chunks_that_are_not_there_have_the_fill_value(tmp_path: Path) -> None:
    sea().isel(time=0).drop_vars("speed").to_zarr(
        tmp_path / "a.zarr", zarr_format=2, encoding={"depth": {"chunks": (30, 70)}}
    )
    (tmp_path / "a.zarr" / "depth" / "1.0").unlink()
    surface = ls.read(tmp_path / "a.zarr", variable="depth")
    assert surface.mask is not None
    assert not surface.mask[30:60].any()
    assert surface.mask[60:].all()


def test_one_array_alone(tmp_path: Path) -> None:
    points = np.stack([hills()] * 3, axis=-1).astype(np.float32)
    zarr.create_array(str(tmp_path / "points.zarr"), data=points, chunks=(40, 40, 3), attributes={"units": "km"})
    surface = ls.read(tmp_path / "points.zarr")
    np.testing.assert_array_equal(surface.points, points)
    assert surface.metadata == {"name": "points", "format": "zarr", "unit": "km"}
    with pytest.raises(ls.FormatError, match="expected a group of variables for variable=, got a single array"):
        ls.read(tmp_path / "points.zarr", variable="z")


def test_a_member_of_a_group_without_names_of_dimensions(tmp_path: Path) -> None:
    zarr.open_group(str(tmp_path / "a.zarr"), mode="w").create_array("z", data=hills())
    with pytest.raises(ls.FormatError, match=r"got z \(dimensions without names\); the folder of an array"):
        ls.read(tmp_path / "a.zarr")
    np.testing.assert_array_equal(ls.read(tmp_path / "a.zarr" / "z").points, hills())


@pytest.mark.parametrize("version", [2, 3])
def test_an_array_with_names_of_dimensions_is_the_variable_of_its_group(tmp_path: Path, version: Any) -> None:
    sea().to_zarr(tmp_path / "a.zarr", zarr_format=version)
    with pytest.raises(ls.FormatError, match=r"expected two dimensions of depth, got 3: choose time \(2\)"):
        ls.read(tmp_path / "a.zarr" / "depth")  # not 2 x 90 points with 67 attributes
    with pytest.warns(ls.FormatWarning, match="speed"):
        surface = ls.read(tmp_path / "a.zarr" / "depth", time="2001-02")
    whole = ls.read(tmp_path / "a.zarr", **OPTIONS)
    assert surface.mask is not None
    assert not surface.mask[10:15, 20:30].any()
    assert surface.metadata["name"] == "depth"
    np.testing.assert_array_equal(surface.points, whole.points)
    assert surface.metadata["geotransform"] == whole.metadata["geotransform"]


@pytest.mark.filterwarnings("ignore:left out. time:lodestream.errors.FormatWarning")
def test_encode_takes_a_path(tmp_path: Path) -> None:
    store = tmp_path / "a.zarr"
    sea().isel(time=0).drop_vars("speed").to_zarr(store)
    whole = ls.encode(ls.read(store))
    assert ls.encode(store) == ls.encode(str(store)) == whole
    ls.encode(store, out=tmp_path / "a.lode", memory=1 << 20)
    assert (tmp_path / "a.lode").read_bytes() == whole
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.lode", "a.zarr"]


def test_a_store_is_another_one_when_a_chunk_is(tmp_path: Path) -> None:
    array = zarr.create_array(str(tmp_path / "a.zarr"), data=hills(), chunks=(30, 30))

    before = reading_key([tmp_path / "a.zarr"])
    assert reading_key([tmp_path / "a.zarr"]) == before
    array[:30, :30] = 3
    assert reading_key([tmp_path / "a.zarr"]) != before


def _coded(store: Path) -> None:
    path = store / "depth" / ".zarray"
    path.write_text(json.dumps({**json.loads(path.read_text()), "compressor": {"id": "base64"}}))


def _pickled(store: Path) -> None:
    path = store / "depth" / ".zarray"
    path.write_text(json.dumps({**json.loads(path.read_text()), "filters": [{"id": "pickle", "protocol": 5}]}))


def _leads_out(store: Path) -> None:
    (store / "depth" / "0.0").rename(store.parent / "secret")
    (store / "depth" / "0.0").symlink_to("../../secret")


def _pipe(store: Path) -> None:
    (store / "depth" / "0.0").unlink()
    os.mkfifo(store / "depth" / "0.0")


def _cut(store: Path) -> None:
    os.truncate(store / "depth" / "0.0", 40)


def _promises(store: Path) -> None:
    path = store / "depth" / ".zarray"
    path.write_text(json.dumps({**json.loads(path.read_text()), "chunks": [1 << 20, 1 << 20]}))


def _large(store: Path) -> None:
    for name, shape in (("depth", [1 << 15, 1 << 15]), ("lat", [1 << 15]), ("lon", [1 << 15])):
        path = store / name / ".zarray"
        path.write_text(json.dumps({**json.loads(path.read_text()), "shape": shape, "chunks": [256] * len(shape)}))


def _grains(store: Path) -> None:
    path = store / "depth" / ".zarray"
    path.write_text(json.dumps({**json.loads(path.read_text()), "shape": [9000, 7000], "chunks": [1, 1]}))
    for name, count in (("lat", 9000), ("lon", 7000)):
        path = store / name / ".zarray"
        path.write_text(json.dumps({**json.loads(path.read_text()), "shape": [count], "chunks": [count]}))


HOSTILE: dict[str, tuple[Callable[[Path], None], str]] = {
    "codec": (_coded, r"left out variables: depth \(codec 'base64', which is not known\)"),
    "pickle": (_pickled, "pickle"),
    "link": (_leads_out, "whose files lie in its folder, got 'depth/0.0', which leads out"),
    "pipe": (_pipe, "of regular files, got 'depth/0.0'"),
    "cut": (_cut, "expected a whole Zarr store"),
    "chunk": (_promises, "expands at most 2048 times"),
    "large": (_large, "at most 268,435,456 vertices"),
    "grains": (_grains, r"at most 65,536 chunks of a Zarr store of [\d,]+ bytes, got an array of 63,000,000"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_stores(tmp_path: Path, kind: str) -> None:
    change, message = HOSTILE[kind]
    store = tmp_path / "a.zarr"
    sea().isel(time=0).drop_vars(["speed", "time"]).to_zarr(store, zarr_format=2, consolidated=False)
    change(store)
    with pytest.raises(ls.InputError, match=message):
        ls.read(store)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
@pytest.mark.long
def test_nobody_waits_for_a_pipe_in_place_of_the_head_of_a_store(tmp_path: Path) -> None:
    store = tmp_path / "a.zarr"
    sea().isel(time=0).drop_vars(["speed", "time"]).to_zarr(store, zarr_format=2, consolidated=False)
    os.mkfifo(store / "zarr.json")
    program = f"import lodestream; lodestream.read({os.fspath(store)!r})"
    found = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert "expected a Zarr store of regular files, got 'zarr.json', which is none" in found.stderr


@pytest.mark.long
def test_few_chunks_of_many_values_may_all_be_missing(tmp_path: Path) -> None:
    zarr.create_array(str(tmp_path / "a.zarr"), shape=(300, 200), chunks=(2, 2), dtype="f4", fill_value=3.0)
    assert (ls.read(tmp_path / "a.zarr").points == 3.0).all()


def test_metadata_in_one_place_are_not_believed(tmp_path: Path) -> None:
    store = tmp_path / "a.zarr"
    sea().isel(time=0).drop_vars(["speed", "time"]).to_zarr(store, zarr_format=2, consolidated=True)
    path = store / ".zmetadata"
    path.write_text(path.read_text().replace("depth/", "../depth/"))
    assert ls.read(store).metadata["variable"] == "depth"


def test_a_folder_that_is_no_store(tmp_path: Path) -> None:
    with pytest.raises(ls.FormatError, match="a regular file or the folder of a Zarr store, got another folder"):
        ls.read(tmp_path)
    sea().to_zarr(tmp_path / "a.zarr")
    with pytest.raises(ls.FormatError, match="this is zarr, not a file of format netcdf"):
        ls.read(tmp_path / "a.zarr", format_name="nc")
    (tmp_path / "a.nc").write_bytes(b"CDF\x01")
    with pytest.raises(
        ls.FormatError, match=r"this is a file that begins with the bytes .*, not a file of format zarr"
    ):
        ls.read(tmp_path / "a.nc", format_name="zarr")


@pytest.mark.parametrize("library", ["zarr", "xarray"])
def test_without_the_libraries(tmp_path: Path, library: str, monkeypatch: pytest.MonkeyPatch) -> None:
    sea().to_zarr(tmp_path / "a.zarr")
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(UnavailableError, match=r"expected zarr and xarray .* pip install 'lodestream\[zarr\]'"):
        ls.read(tmp_path / "a.zarr")


def test_the_table_knows_that_it_is_a_folder() -> None:
    assert [format_.name for format_ in formats.formats() if format_.folder] == ["zarr"]
