"""The program of docs/maps.md runs, and what the page says of its tiles is so."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream.maps import HeightField

from .fields import at, decoded, degrees
from .mesh_reader import read_mesh

PAGE = (Path(__file__).parents[3] / "docs" / "maps.md").read_text()


def test_it_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    rows, columns = np.mgrid[0:500, 0:500]
    surface = ls.Surface((400 + rows / 8 + columns / 4).astype(np.float32), metadata=degrees(11.4, 48.3, 0.0003))
    (tmp_path / "hill.lode").write_bytes(ls.encode(surface))
    monkeypatch.chdir(tmp_path)
    (program,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    exec(compile(program, "maps.md", "exec"), {})
    field = HeightField.open("hill.lode")
    printed = capsys.readouterr().out.splitlines()
    assert printed[0] == str(field.bounds)
    assert int(printed[1]) == field.placement.web_zoom()
    assert float(printed[3].strip("[]")) == pytest.approx(at(field, 11.462, 48.2), abs=0.1)
    tile = decoded((tmp_path / "tile.png").read_bytes(), "terrarium")
    assert 400 < tile.min() < tile.max() < 700
    assert read_mesh((tmp_path / "tile.terrain").read_bytes()).heights.max() > 500
