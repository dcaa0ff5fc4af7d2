"""Samples of sweeps: which cases they have."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from tests.patience import PATIENCE

ROOT = Path(__file__).parents[1]

#: Of `tests.examples`, as `tests/conftest.py` uses it.
CONFTEST = """
import pytest
from tests.examples import chosen

def pytest_collection_modifyitems(config, items):
    items[:] = [item for item in items if item in chosen(items, "default")]
"""

SWEEP = """
import pytest

@pytest.mark.sweep(6)
@pytest.mark.parametrize("letter", ["a", "b"])
@pytest.mark.parametrize(("number", "list_"), [(k, [k]) for k in range(6)])
def test_one(letter, number, list_):
    pass
"""


def test_a_sample_has_every_value_as_often_as_the_others(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_one.py").write_text(SWEEP)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = sweep(count)\n")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", str(tmp_path)],
        env={**os.environ, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTHONPATH": str(ROOT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
    )
    cases = re.findall(r"test_one\[(\d)-list_\d-(\w)\]", done.stdout)
    assert sorted(value for case in cases for value in case) == [*"012345aaabbb"]
