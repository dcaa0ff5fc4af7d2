"""Lodestream as it is where its compiled kernels cannot be loaded: a copy of the package without them."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream.library import library_name
from lodestream_client import Client
from lodestream_server import running_server
from tests.patience import PATIENCE

ROOT = Path(__file__).parents[2]


class Bare:
    """Runs programs with that copy."""

    def __init__(self, folder: Path) -> None:
        package = folder / "lodestream"
        shutil.copytree(ROOT / "core" / "lodestream", package, ignore=shutil.ignore_patterns("native", "__pycache__"))
        paths = [str(folder), *(str(ROOT / name) for name in ("server", "client"))]
        self._environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "COLUMNS": "100"}

    def run(self, *arguments: object) -> subprocess.CompletedProcess[str]:
        """Python, with these arguments."""
        command = [sys.executable, *map(str, arguments)]
        return subprocess.run(
            command, env=self._environment, capture_output=True, text=True, timeout=PATIENCE, check=False
        )

    def done(self, *arguments: object) -> str:
        """What a command that ends well says to standard error."""
        done = self.run("-m", "lodestream_client", *arguments)
        assert done.returncode == 0, done.stderr
        return done.stderr

    def refused(self, *arguments: object) -> str:
        """What a command that does not says, which names what is missing and a way out."""
        done = self.run("-m", "lodestream_client", *arguments)
        assert (done.returncode, done.stdout) == (1, "")
        assert library_name() in done.stderr
        assert "install the package again" in done.stderr
        assert done.stderr.count("\n") == 1
        return done.stderr


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Bare:
    return Bare(tmp_path_factory.mktemp("bare"))


@pytest.mark.long
def test_decoding_is_refused(bare: Bare, container_file: Path, surface: str, tmp_path: Path) -> None:
    out = tmp_path / "out.npy"
    for command in (
        ("decode", container_file, out),
        ("pull", surface, out),
        ("pull", surface, out, "--transport", "http"),
    ):
        assert "decoding is not possible here" in bare.refused(*command)
        assert not out.exists()
    code = f"import pathlib, lodestream; lodestream.decode(pathlib.Path({str(container_file)!r}).read_bytes())"
    assert "UnavailableError: decoding is not possible here" in bare.run("-c", code).stderr


def test_what_decodes_nothing_says_nothing(bare: Bare, container_file: Path) -> None:
    assert bare.done("info", container_file) == ""
    code = "import numpy, lodestream.transform.paper; lodestream.coarsen(numpy.ones((9, 9)))"
    assert bare.run("-W", "error", "-c", code).stderr == ""


def test_encode_is_refused_before_the_file_is_opened(bare: Bare, tmp_path: Path) -> None:
    assert "encoding is not possible here" in bare.refused("encode", tmp_path / "nowhere.npy", tmp_path / "out.lode")


def test_a_file_is_uploaded_and_what_is_in_memory_is_refused(bare: Bare, server: str, terrain_file: Path) -> None:
    assert bare.done("push", "--quiet", terrain_file, server, "--name", "uploaded without kernels") == ""
    code = f"import numpy; from lodestream_client import Client; Client({server!r}).upload(numpy.ones((9, 9)))"
    told = bare.run("-c", code).stderr
    assert "UnavailableError: encoding is not possible here" in told
    assert [each.details["name"] for each in Client(server).list()].count("uploaded without kernels") == 1


@pytest.mark.long
def test_a_server_does_not_start(bare: Bare, tmp_path: Path) -> None:
    data = tmp_path / "data"
    assert "serving surfaces is not possible here" in bare.refused("serve", "--data", data, "--port", "0")
    assert not data.exists()
    assert "serving surfaces is not possible here" in bare.refused("demo", "--out", tmp_path / "demo")


def test_the_data_of_a_server_are_checked_and_nothing_of_them_is_damage(
    bare: Bare, tmp_path: Path, terrain_file: Path
) -> None:
    data = tmp_path / "data"
    with running_server(data, workers=1) as url:
        Client(url).upload(terrain_file)
    before = {path: path.read_bytes() for path in data.glob("*/*") if path.is_file()}
    assert any(path.suffix == ".lode" for path in before)
    done = bare.run("-m", "lodestream_client", "fsck", data, "--repair", "--collect", "--retry")
    assert (done.returncode, "nothing is damaged" in done.stdout) == (0, True), done.stdout + done.stderr
    assert {path: path.read_bytes() for path in data.glob("*/*") if path in before} == before


def test_the_copy_has_no_kernels_and_this_package_has(bare: Bare) -> None:
    code = "from lodestream.library import why_missing; print(why_missing())"
    assert library_name() in bare.run("-c", code).stdout
    assert ls.encode(np.ones((9, 9)))
