"""The programs of docs/python.md run, one after another, with the libraries themselves, and the README has them too."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def programs(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)


@pytest.mark.long
def test_they_run(server: str, installed: dict[str, str], tmp_path: Path) -> None:
    found = programs("docs/python.md")
    assert len(found) == 11
    script = "\n".join(found).replace("http://127.0.0.1:8000", server)
    result = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env={**installed, "MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "terrain.vts").stat().st_size > 0


def test_the_readme_has_no_line_that_this_page_has_not() -> None:
    lines = {line for program in programs("docs/python.md") for line in program.splitlines()}
    shown = [line for line in programs("README.md")[-1].splitlines() if line]
    assert len(shown) == 8
    assert [line for line in shown if line not in lines] == []
