"""``lodestream info`` shows the error of each coordinate and attribute."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream_client.__main__ import main
from tests.core.surfaces import terrain, torus


def shown(path: Path, capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert main(["info", str(path), *options]) == 0
    return capsys.readouterr().out


def test_each_has_a_column_of_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, shape = tmp_path / "a.lode", (40, 50)
    attributes = {"speed": terrain(shape, 3), "wind": np.stack([terrain(shape, 4), terrain(shape, 5)], axis=2)}
    path.write_bytes(ls.encode(ls.Surface(terrain(shape), attributes=attributes)))
    details = json.loads(shown(path, capsys, "--json"))
    assert details["channel_names"] == ["z", "speed", "wind_0", "wind_1"]
    lines = shown(path, capsys).splitlines()
    heads = [line.split() for line in lines if "RMS error" in line]
    assert [head[-4:] for head in heads] == [details["channel_names"]] * 2
    for kind in ("levels", "layers"):
        for number, state in enumerate(details[kind]):
            figures = [f"{rms:.6g}" for rms, _ in state["channels"]]
            row = [str(number), f"{state['bytes']:,}", *figures]
            assert any(line.split()[0] == row[0] and line.split()[-4:] == figures for line in lines if line.split()), (
                row
            )


def test_of_points_in_space_they_are_x_y_z_and_others(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.lode"
    points = np.concatenate([torus(20, 30), torus(20, 30)[..., :2]], axis=2)
    path.write_bytes(ls.encode(ls.Surface(points, (True, True))))
    assert json.loads(shown(path, capsys, "--json"))["channel_names"] == ["x", "y", "z", "attribute_0", "attribute_1"]


def test_heights_alone_have_none_and_of_many_the_first_are_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.lode"
    path.write_bytes(ls.encode(terrain((40, 50))))
    assert [line.split()[-1] for line in shown(path, capsys).splitlines() if "RMS error" in line] == ["maximum"] * 2
    path.write_bytes(ls.encode(ls.Surface(terrain((9, 8)), attributes={f"a{k}": terrain((9, 8), k) for k in range(9)})))
    lines = [line.split() for line in shown(path, capsys).splitlines() if "RMS error" in line]
    assert [line[-6:] for line in lines] == [["z", "a0", "a1", "a2", "a3", "a4"]] * 2
    assert shown(path, capsys).splitlines()[-1] == "and 4 more channels; --json lists their errors"
