"""A test that hangs is ended and named, and only long after what the longest tests take on a busy machine."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.patience import PATIENCE

ROOT = Path(__file__).parents[1]


def test_the_limit_is_half_an_hour() -> None:
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    assert options["faulthandler_timeout"] >= 1800
    assert options["faulthandler_exit_on_timeout"]
    assert options["faulthandler_timeout"] > 2 * PATIENCE


@pytest.mark.parametrize("processes", [[], ["-n", "1"]], ids=["alone", "by xdist"])
@pytest.mark.long
def test_a_test_that_hangs_is_named(tmp_path: Path, processes: list[str]) -> None:
    (tmp_path / "test_one.py").write_text("import time\n\ndef test_that_hangs():\n    time.sleep(36_000)\n")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", str(tmp_path / "pytest.ini")]
    (tmp_path / "pytest.ini").write_text("[pytest]\nfaulthandler_timeout = 1\nfaulthandler_exit_on_timeout = true\n")
    limits = ["-p", "xdist", "--max-worker-restart", "0"] if processes else []
    done = subprocess.run(
        [*command, *limits, *processes, str(tmp_path)],
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},  # others take seconds to be loaded, in each process
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode != 0
    assert "test_that_hangs" in done.stdout + done.stderr
    if processes:
        assert "crashed while running 'test_one.py::test_that_hangs'" in done.stdout
