"""What is said of files on the command line: options as it has them, and what else to do with a file."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream.errors import FormatWarning
from lodestream_client.commands.inputs import option_hints, option_words

from ..conftest import Run


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("take them with attributes=", "take them with -o attributes="),
        ("choose others with plane=, like j3,k-1", "choose others with -o plane=, like j3,k-1"),
        ("an option such as tile=N37W122", "an option such as -o tile=N37W122"),
        ("with -o attributes=", "with -o attributes="),
        ("sea plane=1.nc: took plane 1", "sea plane=1.nc: took plane 1"),
    ],
)
def test_options_are_named_as_the_command_line_has_them(text: str, words: str) -> None:
    assert option_words(text, ["sea plane=1.nc"]) == words


@pytest.mark.parametrize("address", ["s3://bucket/a.lode", "https://host/a.lode"])
def test_an_address_is_no_file(address: str, tmp_path: Path, run: Run) -> None:
    out, container = tmp_path / "out.npy", tmp_path / "out.lode"
    for words in (["decode", address, out], ["encode", address, container], ["convert", address, out]):
        code, stdout, stderr = run(*words)
        assert (code, stdout) == (1, "")
        assert stderr.startswith(f"lodestream: {address} is an address, and this command reads files: download it, or ")
    assert list(tmp_path.iterdir()) == []


def test_notes_of_a_reader_are_worded_too(recwarn: pytest.WarningsRecorder) -> None:
    with option_hints(["a.nc"]):
        warnings.warn("take them with attributes=", FormatWarning, stacklevel=1)
        warnings.warn("attributes= of somebody else", UserWarning, stacklevel=1)
    warnings.warn("after it: take them with attributes=", FormatWarning, stacklevel=1)
    ours = [found for found in recwarn if found.filename == __file__]
    assert [str(found.message) for found in ours] == [
        "take them with -o attributes=",
        "attributes= of somebody else",
        "after it: take them with attributes=",
    ]


def test_encode_says_how_the_other_variables_are_taken(run: Run, tmp_path: Path) -> None:
    xarray = pytest.importorskip("xarray")
    heights = (("y", "x"), np.arange(12.0).reshape(3, 4))
    other = (("y", "x"), np.ones((3, 4)))
    data = xarray.Dataset({"z": (*heights, {"ancillary_variables": "heat"}), "heat": other})
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    code, _, stderr = run("encode", tmp_path / "a.nc", tmp_path / "a.lode")
    assert code == 0, stderr
    assert "left out variables of the same grid: heat; take them with -o attributes=\n" in stderr


def test_names_of_attributes_add_up(run: Run, tmp_path: Path) -> None:
    values = np.arange(12.0).reshape(3, 4)
    xarray = pytest.importorskip("xarray")
    data = xarray.Dataset(dict.fromkeys(("z", "heat", "speed", "kind"), (("y", "x"), values)))
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    words = ("variable=z", "attributes=heat,kind", "attributes=speed")
    code, _, stderr = run(
        "encode", tmp_path / "a.nc", tmp_path / "a.lode", *(it for word in words for it in ("-o", word))
    )
    assert code == 0, stderr
    assert list(ls.decode((tmp_path / "a.lode").read_bytes()).attributes) == ["heat", "kind", "speed"]
    code, _, stderr = run("encode", tmp_path / "a.nc", tmp_path / "b.lode", "-o", "variable=z", "-o", "variable=heat")
    assert (code, "variable given twice" in stderr) == (2, True)


@pytest.mark.parametrize("command", ["info", "decode"])
def test_a_file_of_another_format_is_to_be_encoded_first(run: Run, tmp_path: Path, command: str) -> None:
    np.save(tmp_path / "a.npy", np.arange(12.0).reshape(3, 4))
    out = [tmp_path / "b.npy"] * (command == "decode")
    code, _, stderr = run(command, tmp_path / "a.npy", *out)
    assert code == 1
    assert stderr.startswith(f"lodestream: {tmp_path / 'a.npy'}: expected a Lodestream container, got ")
    assert stderr.count("lodestream encode makes a container of a file of another format") == 1
    container = ls.encode(np.arange(12.0).reshape(3, 4))
    (tmp_path / "a.lode").write_bytes(container[:60])
    code, _, stderr = run(command, tmp_path / "a.lode", *out)
    assert code == 1
    assert "lodestream encode" not in stderr
