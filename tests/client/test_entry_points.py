"""xarray, pyvista and zarr find what this distribution offers, by the entry points in pyproject.toml."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment in which a distribution with the entry points of pyproject.toml is installed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    folder = tmp_path_factory.mktemp("installed")
    record = folder / "lodestream-9.9.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: lodestream\nVersion: 9.9\n")
    lines = [
        line
        for group, points in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{name} = {value}" for name, value in points.items()))
    ]
    (record / "entry_points.txt").write_text("\n".join(lines) + "\n")
    sources = [str(ROOT / part) for part in ("core", "server", "client")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sources])}


def run(script: str, environment: dict[str, str], *arguments: object) -> str:
    command = [sys.executable, "-c", script, *map(str, arguments)]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    values = np.add.outer(np.arange(40.0) ** 2, np.arange(50.0)).astype("f4")
    found = tmp_path_factory.mktemp("files") / "x.lode"
    found.write_bytes(ls.encode(ls.Surface(values, metadata={"geotransform": [0.0, 1.0, 0.0, 0.0, 0.0, -1.0]})))
    return found


def test_xarray_has_the_engine_and_guesses_it(environment: dict[str, str], path: Path) -> None:
    script = (
        "import sys, xarray as xr; path = sys.argv[1];"
        "one = xr.open_dataset(path, engine='lode'); two = xr.open_dataset(path);"
        "print(float(one.z[39, 49]), float(two.sel(x=0.5, y=-2.5).z))"
    )
    assert run(script, environment, path) == "1570.0 4.0\n"


def test_pyvista_reads_containers(environment: dict[str, str], path: Path) -> None:
    script = (
        "import sys, pyvista as pv; grid = pv.read(sys.argv[1]);"
        "print(type(grid).__name__, grid.dimensions, float(grid.points[:, 2].max()),"
        "pv.read(sys.argv[1], level=1).n_points)"
    )
    assert run(script, environment, path).startswith("StructuredGrid (50, 40, 1) 1570.0 ")


def test_zarr_has_the_codec(environment: dict[str, str], tmp_path: Path) -> None:
    script = (
        "import sys, numpy, zarr; values = numpy.arange(10000, dtype='i4').reshape(100, 100) ** 2 % 1000;"
        "codec = {'name': 'lodestream', 'configuration': {}};"
        "array = zarr.create_array(sys.argv[1], data=values, chunks=(64, 64), serializer=codec, compressors=None);"
        "print((zarr.open_array(sys.argv[1])[:] == values).all(), array.metadata.to_dict()['codecs'][0]['name'])"
    )
    assert run(script, environment, tmp_path / "a.zarr") == "True lodestream\n"
