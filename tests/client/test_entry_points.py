"""xarray and pyvista find what this distribution offers, by the entry points in pyproject.toml."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls


def run(script: str, installed: dict[str, str], *arguments: object) -> str:
    command = [sys.executable, "-c", script, *map(str, arguments)]
    result = subprocess.run(command, env=installed, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    values = np.add.outer(np.arange(40.0) ** 2, np.arange(50.0)).astype("f4")
    found = tmp_path_factory.mktemp("files") / "x.lode"
    found.write_bytes(ls.encode(ls.Surface(values, metadata={"geotransform": [0.0, 1.0, 0.0, 0.0, 0.0, -1.0]})))
    return found


def test_xarray_has_the_engine_and_guesses_it(installed: dict[str, str], path: Path) -> None:
    script = (
        "import sys, xarray as xr; path = sys.argv[1];"
        "one = xr.open_dataset(path, engine='lode'); two = xr.open_dataset(path);"
        "print(float(one.z[39, 49]), float(two.sel(x=0.5, y=-2.5).z))"
    )
    assert run(script, installed, path) == "1570.0 4.0\n"


def test_pyvista_reads_containers(installed: dict[str, str], path: Path) -> None:
    script = (
        "import sys, pyvista as pv; grid = pv.read(sys.argv[1]);"
        "print(type(grid).__name__, grid.dimensions, float(grid.points[:, 2].max()),"
        "pv.read(sys.argv[1], level=1).n_points)"
    )
    assert run(script, installed, path).startswith("StructuredGrid (50, 40, 1) 1570.0 ")
