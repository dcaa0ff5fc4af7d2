"""Real gridded files over a real server: what comes back is what other libraries read in the file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from lodestream.coordinates.seams import restore
from tests.core.test_real_surfaces import DATA, ROWS, Row, needed, of, read, valid_of

from .conftest import Run

#: Small ones; the others go the same way, and through `encode` in tests of the core.
NAMES = ("SainteHelens.dem", "lidar_dsm_2m.tif", "topobathy.npz", "fuji.png", "ccsm_popgrid.nc", "NCSX_surface_X.dat")


def push(run: Run, server: str, row: Row) -> str:
    needed(row)
    options = [word for key, value in row.options.items() if key != "closed" for word in ("-o", f"{key}={value}")]
    closed = ["--closed", row.options["closed"]] if "closed" in row.options else []
    code, out, err = run("push", *(DATA / name for name in row.files), server, *closed, *options)
    assert code == 0, err
    return out.strip()


@pytest.mark.parametrize("name", NAMES)
def test_a_real_file_comes_back_from_a_server(run: Run, server: str, tmp_path: Path, name: str) -> None:
    row = of(name)
    surface = read(row)
    url = push(run, server, row)
    code, out, _ = run("info", url, "--json")
    assert code == 0
    described = json.loads(out)
    assert (described["shape"], described["closed"]) == (list(row.shape), list(row.closed))
    assert {key: described["metadata"][key] for key in surface.metadata} == surface.metadata
    assert run("pull", url, tmp_path / "a.npy")[0] == 0
    back, given = np.load(tmp_path / "a.npy"), restore(surface)
    assert (back.shape, back.dtype) == (given.points.shape, given.dtype)
    valid = valid_of(given)
    assert back[valid].tobytes() == given.points[valid].tobytes()
    if back.dtype.kind == "f":
        assert np.array_equal(np.isnan(back[~valid]), np.isnan(given.points[~valid]))
    assert run("pull", url, tmp_path / "b.npy", "--level", "3")[0] == 0
    assert list(np.load(tmp_path / "b.npy").shape[:2]) == described["levels"][3]["shape"]


@pytest.mark.parametrize("name", ["SainteHelens.dem", "lidar_dsm_2m.tif"])
def test_rasterio_reads_what_was_pulled(run: Run, server: str, tmp_path: Path, name: str) -> None:
    rasterio = pytest.importorskip("rasterio")
    url = push(run, server, of(name))
    for stop in ([], ["--max-bytes", "20000"]):
        assert run("pull", url, tmp_path / "a.tif", *stop)[0] == 0
        with rasterio.open(tmp_path / "a.tif") as dataset, rasterio.open(DATA / name) as original:
            assert dataset.crs == original.crs
            assert dataset.transform == original.transform
            assert dataset.nodata == original.nodata
            np.testing.assert_array_equal(dataset.read_masks(1), original.read_masks(1))
            if not stop:
                np.testing.assert_array_equal(dataset.read(1), original.read(1))


def test_the_seam_of_a_real_file_comes_back_from_a_server(run: Run, server: str, tmp_path: Path) -> None:
    row = of("etopo20.cdf")
    heights = restore(read(row)).points
    url = push(run, server, row)
    assert json.loads(run("info", url, "--json")[1])["shape"] == [540, 1080]
    assert run("pull", url, tmp_path / "a.npy", "--until-rms", "200")[0] == 0
    back = np.load(tmp_path / "a.npy")
    assert back.shape == heights.shape == (540, 1081)
    np.testing.assert_array_equal(back[:, -1], back[:, 0])
    assert np.sqrt(np.mean((back - heights) ** 2)) <= 201
    for level, shape in (("9", (271, 540)), ("10", (540, 1081))):
        assert run("pull", url, tmp_path / "b.npy", "--level", level)[0] == 0
        assert np.load(tmp_path / "b.npy").shape == shape


def test_the_names_that_are_streamed_are_rows() -> None:
    assert set(NAMES) <= {row.files[0] for row in ROWS}
