"""The main paths of library and client on imitations of macOS and Windows."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from lodestream_server import running_server
from tests.patience import PATIENCE

from .imitation import SYSTEMS

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.long
def test_the_main_paths_run_on_an_imitated_system(system: str, tmp_path: Path) -> None:
    for library in ("h5netcdf", "matplotlib", "rasterio", "rich", "xarray"):
        pytest.importorskip(library)
    work = tmp_path / "work"
    work.mkdir()
    environment = {**os.environ, "LODESTREAM_CACHE": "", "HOME": str(tmp_path), "LOCALAPPDATA": str(tmp_path / "Local")}
    if system == "win32":  # its usual code page
        environment |= {"PYTHONIOENCODING": "cp1252"}
    with running_server(tmp_path / "data") as url:
        command = [sys.executable, "-m", "tests.other_systems.main_paths", system, str(work), url]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, timeout=PATIENCE, check=False)
    words = done.stdout.decode("cp1252", "replace") + done.stderr.decode("cp1252", "replace")
    assert done.returncode == 0, words
    parts = ["modules", "memory", "bands", "continuing", "commands", "streams", "cache", "serving", "limits"]
    parts.append("reader_of_vtk")
    assert [line for line in words.splitlines() if line in parts] == parts
    folder = {"win32": tmp_path / "Local", "darwin": tmp_path / "Library" / "Caches"}[system] / "lodestream"
    assert folder.is_dir()


@pytest.mark.long
def test_the_tests_without_a_server_are_collected_where_there_is_none_and_the_others_skipped() -> None:
    command = [sys.executable, "-m", "pytest", "-p", "tests.other_systems.plugin", "-p", "no:cacheprovider", "-n", "0"]
    command += ["-q", "-rs", "-k", "test_memory.py or test_text.py", "tests/core", "tests/golden", "tests/client"]
    environment = {**os.environ, "LODESTREAM_IMITATED": "win32", "PYTHONIOENCODING": "utf-8"}
    environment.pop("HYPOTHESIS_PROFILE", None)  # it may be the one that leaves out what is run here
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "the server needs Linux" in done.stdout
    assert re.search(r"\d+ passed, \d+ skipped", done.stdout)
