"""``--nodata`` of encode, convert and push, ``nodata=`` of uploads and of their query: the same holes everywhere."""

from __future__ import annotations

from pathlib import Path

import httpx
import numpy as np
import pytest

import lodestream as ls
from lodestream.errors import FormatWarning, OptionError
from lodestream_client import Client
from tests.patience import PATIENCE

from ..conftest import Run

HEIGHTS = np.where(np.arange(60).reshape(6, 10) % 7 > 0, np.arange(60.0).reshape(6, 10), -3.4028235e38).astype("f4")
VALID = HEIGHTS > -1
NOTE = f"nodata=-3.4028235e+38 masks {(~VALID).sum()} of 60 points"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "dem.npy"
    np.save(path, HEIGHTS)
    return path


@pytest.mark.parametrize("words", ["--nodata -3.4028235e+38", "--nodata=-3.4028235e38", "-o nodata=-3.4028235e38"])
def test_encode(run: Run, file: Path, words: str) -> None:
    code, _, stderr = run("encode", file, file.with_suffix(".lode"), *words.split())
    assert (code, NOTE in stderr) == (0, True), stderr
    np.testing.assert_array_equal(ls.decode(file.with_suffix(".lode").read_bytes()).mask, VALID)


def test_convert(run: Run, file: Path) -> None:
    code, _, stderr = run("convert", file, file.with_suffix(".npz"), "--nodata", "-3.4028235e+38")
    assert (code, NOTE in stderr) == (0, True), stderr
    np.testing.assert_array_equal(np.load(file.with_suffix(".npz"))["mask"], VALID)


def test_a_memory_limit_changes_nothing(run: Run, tmp_path: Path) -> None:
    heights = np.arange(700.0 * 700).reshape(700, 700)
    heights[:, :60] = -9999
    np.save(tmp_path / "a.npy", heights)
    sizes = []
    for memory in ([], ["--memory", "4MiB"]):
        code, _, stderr = run("encode", tmp_path / "a.npy", tmp_path / "a.lode", "--nodata", -9999, *memory)
        assert (code, "nodata=-9999 masks 42,000 of 490,000 points" in stderr) == (0, True), stderr
        sizes.append((tmp_path / "a.lode").read_bytes())
    assert sizes[0] == sizes[1]


@pytest.mark.parametrize("value", ["high", "1,5"])
def test_what_is_no_number(run: Run, file: Path, server: str, value: str) -> None:
    for words in (("encode", file, file.with_suffix(".lode")), ("push", file, server)):
        code, _, stderr = run(*words, "--nodata", value)
        assert (code, f"nodata must be a number or nan, and is '{value}'" in stderr) == (1, True), stderr
    code, _, stderr = run("encode", file, file.with_suffix(".lode"), "--nodata", "1", "-o", "nodata=1")
    assert (code, "nodata given twice" in stderr) == (2, True)


def test_push(run: Run, file: Path, server: str) -> None:
    code, stdout, stderr = run("push", file, server, "--nodata", "-3.4028235e+38")
    assert (code, NOTE in stderr) == (0, True), stderr
    url = stdout.strip()
    with Client(url).connect(url) as stream:
        *_, view = stream
    np.testing.assert_array_equal(view.surface().mask, VALID)
    assert Client(server).upload(file, nodata=-3.4028235e38).url == stdout.strip()
    assert Client(server).upload(file).url != stdout.strip()


def test_the_query_of_an_upload(file: Path, server: str) -> None:
    answer = httpx.post(f"{server}/v1/surfaces", content=file.read_bytes(), params={"nodata": "much"}, timeout=PATIENCE)
    assert (answer.status_code, answer.json()["code"]) == (422, "bad-option")
    assert "nodata must be a number or nan, and is 'much'" in answer.json()["detail"]


def test_a_surface_in_memory(server: str) -> None:
    with pytest.warns(FormatWarning, match=r"masks 9 of 60 points"):
        surface = Client(server).upload(HEIGHTS, nodata="-3.4028235e38")
    with Client(surface.url).connect(surface.url) as stream:
        *_, view = stream
    np.testing.assert_array_equal(view.surface().mask, VALID)


def test_a_container_takes_none(server: str, container_file: Path, run: Run, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match="expected no nodata for a container"):
        Client(server).upload(container_file, nodata=0)
    code, _, stderr = run("convert", container_file, tmp_path / "a.npy", "--nodata", "0")
    assert (code, "expected no --closed, --nodata, --crs, --format and -o" in stderr) == (2, True), stderr
