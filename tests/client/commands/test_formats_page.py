"""The table of formats, its page and the command that prints it say the same; the page's commands do what they say."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream import formats
from lodestream_client.__main__ import main

from ..conftest import Run
from ..samples import make

PAGE = (Path(__file__).parents[3] / "docs" / "formats.md").read_text()
ROWS = [
    [cell.strip() for cell in line.strip("|").split("|")]
    for line in PAGE.splitlines()
    if line.startswith("|") and "`lodestream " in line
]


def test_the_page_has_a_row_for_each_format() -> None:
    table = [
        [
            row.name,
            " ".join(row.suffixes),
            ", ".join(way for way, there in (("in", row.read), ("out", row.suffixes_out)) if there),
        ]
        for row in formats.formats()
    ]
    assert [row[:3] for row in ROWS] == table


def test_the_command_has_a_row_for_each_format(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["formats", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["formats"]
    assert [row["name"] for row in rows] == [row.name for row in formats.formats()]
    assert [row["write"] for row in rows] == [bool(row.suffixes_out) for row in formats.formats()]
    assert main(["formats"]) == 0
    shown = capsys.readouterr().out
    for row in formats.formats():
        assert f"\n{row.name} " in shown
        for option in row.options:
            assert f"-o {option}=" in shown


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
@pytest.mark.long
def test_the_commands_of_the_page(
    row: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    program, command, *words = shlex.split(row[3].strip("`"))
    assert program == "lodestream"
    options = next((place for place, word in enumerate(words) if word.startswith("-")), len(words))
    *given, out = words[:options]
    for name in given:
        make(tmp_path / name)
    assert main([command, *words]) == 0, capsys.readouterr().err
    assert (tmp_path / out).stat().st_size > 0
    if command == "encode":
        surface = ls.decode((tmp_path / out).read_bytes())
        assert surface.metadata["format"] == row[0]
    else:
        assert out.endswith(tuple(row[1].split()))


def test_what_a_file_leaves_out_is_a_note(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("PIL")
    (tmp_path / "a.lode").write_bytes(ls.encode(ls.Surface([[1, 2], [3, 4]], metadata={"crs": "here"})))
    assert main(["decode", str(tmp_path / "a.lode"), str(tmp_path / "a.png")]) == 0
    captured = capsys.readouterr()
    assert "lodestream: PNG holds heights only: crs left out\n" in captured.err
    assert captured.out == ""


def test_the_commands_that_choose_a_group(
    run: Run, server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    xarray = pytest.importorskip("xarray")
    monkeypatch.chdir(tmp_path)
    commands = [" ".join(it.split()) for it in re.findall(r"`lodestream ([^`]*-o\s+group=[^`]*)`", PAGE)]
    assert [command.split()[0] for command in commands] == ["encode", "push"]
    heights = {group: np.arange(48.0).reshape(6, 8) ** k for k, group in ((1, "analysis"), (2, "forecast/surface"))}
    for mode, (group, values) in zip("wa", heights.items(), strict=True):
        xarray.Dataset({"z": (("y", "x"), values)}).to_netcdf("sea.nc", group=group, mode=mode)
    for command in commands:
        code, stdout, stderr = run(*(server if word == "URL" else word for word in shlex.split(command)))
        assert code == 0, stderr
        source = stdout.split()[0] if command.startswith("push") else "sea.lode"
        code, _, stderr = run("pull" if command.startswith("push") else "decode", source, "sea.npy")
        assert code == 0, stderr
        assert np.array_equal(np.load("sea.npy"), heights["forecast/surface"])
        Path("sea.npy").unlink()
