"""``--crs`` of encode, convert and push: the CRS of files that have a position and say none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

import lodestream as ls
from lodestream.maps import HeightField, crs_wkt
from lodestream_client import Client

from ..conftest import Run

HEIGHTS = np.arange(60.0).reshape(6, 10)
UTM = crs_wkt("EPSG:32611")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "dem.asc"
    head = "ncols 10\nnrows 6\nxllcorner 400000\nyllcorner 3800000\ncellsize 30\n"
    path.write_text(head + "\n".join(" ".join(f"{value:g}" for value in row) for row in HEIGHTS))
    return path


def test_encode(run: Run, file: Path) -> None:
    out = file.with_suffix(".lode")
    assert run("encode", file, out)[0] == 0
    assert "crs" not in ls.decode(out.read_bytes()).metadata
    code, _, stderr = run("encode", file, out, "--crs", "EPSG:32611")
    assert code == 0, stderr
    assert ls.decode(out.read_bytes()).metadata["crs"] == UTM
    west, south, east, north = HeightField.open(out).bounds
    assert -118.1 < west < east < -118
    assert 34.3 < south < north < 34.4


def test_it_takes_the_place_of_what_the_file_says(run: Run, file: Path, tmp_path: Path) -> None:
    code, _, stderr = run("convert", file, tmp_path / "a.tif", "--crs", "EPSG:32612")
    assert code == 0, stderr
    code, _, stderr = run("encode", tmp_path / "a.tif", tmp_path / "a.lode", "--crs", "EPSG:32611")
    assert code == 0, stderr
    with rasterio.open(tmp_path / "a.tif") as dataset:
        assert dataset.crs.to_epsg() == 32612
    assert ls.decode((tmp_path / "a.lode").read_bytes()).metadata["crs"] == UTM


@pytest.mark.parametrize("each", [(), ("--each",)])
def test_push(run: Run, file: Path, server: str, each: tuple[str, ...]) -> None:
    code, stdout, stderr = run(
        "push", *each, file, server, "--crs", "EPSG:32611", "--precision", "0.5", "--name", "Hill"
    )
    assert code == 0, stderr
    url = stdout.split()[0]
    with Client(url).connect(url) as stream:
        *_, view = stream
    surface = view.surface()
    assert (surface.metadata["crs"], surface.metadata["name"]) == (UTM, "Hill")
    assert np.abs(surface.points - HEIGHTS).max() <= 0.5


def test_push_to_a_name_that_stays(run: Run, file: Path, server: str) -> None:
    code, stdout, stderr = run("push", file, server, "--crs", "EPSG:32611", "--name", "hill", "--replace")
    assert (code, stdout) == (0, f"{server}/v1/names/hill\n"), stderr
    with ls.open(f"{server}/v1/names/hill") as container:
        assert container.info["metadata"]["crs"] == UTM


@pytest.mark.parametrize("code", ["EPSG:1", "UTM 11", "EPSG:32611x", "+proj=longlat"])
def test_what_is_no_crs(run: Run, file: Path, code: str) -> None:
    ended, _, stderr = run("encode", file, file.with_suffix(".lode"), "--crs", code)
    assert (ended, "such as EPSG:32611" in stderr) == (1, True), stderr
    assert not file.with_suffix(".lode").exists()


def test_a_container_takes_none(run: Run, container_file: Path, server: str, tmp_path: Path) -> None:
    for words in (
        ("encode", container_file, tmp_path / "b.lode"),
        ("push", container_file, server),
        ("convert", container_file, tmp_path / "a.npy"),
        ("view", container_file, "--png", tmp_path / "a.png"),
    ):
        code, _, stderr = run(*words, "--crs", "EPSG:4326")
        assert (code in (1, 2), "container" in stderr) == (True, True), (words, stderr)
