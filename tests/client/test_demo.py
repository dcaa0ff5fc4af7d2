"""The demo: what it shows is true, and what it sets beside it is no straw man."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lodestream_client.demo.plain import beginning, overview
from lodestream_client.demo.terrain import bilinear, terrain
from tests.patience import PATIENCE

from .commands.test_program import environment

SHAPE = (128, 160)


@pytest.mark.parametrize("plot", [True, pytest.param(False, marks=pytest.mark.long)])
def test_the_demo(tmp_path: Path, plot: bool) -> None:
    if plot:
        pytest.importorskip("matplotlib", reason="the demo draws with matplotlib")
    # As the command does it, with fewer points.
    code = (
        "import sys; from pathlib import Path; from lodestream_client.demo import show;"
        f"{'' if plot else 'sys.modules.update(matplotlib=None);'}"
        f"sys.exit(show(Path(sys.argv[1]), as_json=True, shape={SHAPE}))"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "demo")]
    done = subprocess.run(command, capture_output=True, env=environment(), timeout=PATIENCE, check=False)
    assert done.returncode == 0, done.stderr.decode()
    shown = json.loads(done.stdout)
    assert shown["shape"] == list(SHAPE)
    heights = np.load(tmp_path / "demo" / "terrain.npy")
    assert np.array_equal(heights, terrain(SHAPE))
    assert shown["plain_bytes"] == (tmp_path / "demo" / "terrain.npy").stat().st_size
    for moment in shown["moments"]:
        for told, found in ((moment["rms"], moment["rms_found"]), (moment["max"], moment["max_found"])):
            assert (1 - 1e-9) * found <= told <= (1 + 1e-6) * found
    last = shown["moments"][-1]
    assert last["rms"] <= 10.0 < shown["moments"][-2]["rms"]
    assert last["bytes"] < shown["whole_bytes"] / 4
    assert last["rms"] < last["overview_rms"]
    assert last["npy_rows"] == (last["bytes"] - 128) // (2 * SHAPE[1])
    assert b"Stopped after" in done.stderr
    picture = tmp_path / "demo" / "demo.png"
    assert picture.exists() == plot
    if plot:
        assert picture.read_bytes().startswith(b"\x89PNG")
    else:
        assert b"no picture without matplotlib" in done.stderr


def test_the_terrain_has_rivers_and_is_the_same_every_time() -> None:
    done: list[float] = []
    heights = terrain((64, 80), done.append)
    assert heights.shape == (64, 80)
    assert heights.dtype == np.int16
    assert np.array_equal(heights, terrain((64, 80)))
    assert done == sorted(done)
    assert done[-1] == 1.0
    padded = np.pad(heights.astype(int), 1, constant_values=30_000)
    lowest = np.min(
        [padded[1 + r : 65 + r, 1 + c : 81 + c] for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0)], axis=0
    )
    pits = (heights < lowest)[1:-1]
    assert pits.mean() < 0.02


def test_the_beginning_of_a_plain_file_is_its_first_bytes() -> None:
    heights = np.arange(48, dtype=np.int16).reshape(6, 8)
    assert np.isnan(beginning(heights, 127)).all()
    part = beginning(heights, 128 + 2 * 19)
    assert np.array_equal(part.ravel()[:19], np.arange(19.0))
    assert np.isnan(part.ravel()[19:]).all()
    assert np.array_equal(beginning(heights, 10_000), heights)


def test_an_overview_is_the_finest_that_fits() -> None:
    heights = terrain((70, 93))
    factors = []
    for size in (40, 200, 1_000, 5_000, 20_000):
        shown, factor = overview(heights, size)
        assert shown.shape == heights.shape
        factors.append(factor)
    assert factors == sorted(factors, reverse=True)
    assert len(set(factors)) == len(factors)
    assert factors[-1] == 1
    assert np.array_equal(shown, heights)


def test_an_overview_of_a_plane_is_that_plane_between_its_means() -> None:
    rows, columns = np.mgrid[0:48, 0:60]
    plane = (4 * rows - 2 * columns).astype(np.int16)
    shown, factor = overview(plane, 60)
    assert factor > 1
    inner = (slice(factor, -factor), slice(factor, -factor))
    assert np.abs(shown[inner] - plane[inner]).max() <= 0.5


def test_bilinear_meets_the_nodes_and_their_means() -> None:
    grid = np.array([[0.0, 2.0, 4.0], [10.0, 12.0, 14.0]])
    rows, columns = np.array([0.0, 0.5, 1.0])[:, None], np.array([0.0, 1.5, 2.0])
    assert bilinear(grid, rows, columns).tolist() == [[0.0, 3.0, 4.0], [5.0, 8.0, 9.0], [10.0, 13.0, 14.0]]


@pytest.mark.parametrize(
    ("path", "known"), [("env/bin/lodestream", False), ("env/bin/lodestream", True), ("-c", False)]
)
def test_the_program_is_named_as_a_shell_finds_it(monkeypatch: pytest.MonkeyPatch, path: str, known: bool) -> None:
    module = importlib.import_module("lodestream_client.demo.show")  # the package has a function of this name
    monkeypatch.setattr(sys, "argv", [path, "demo"])
    monkeypatch.setattr(module.shutil, "which", lambda name: f"/bin/{name}" if known else None)
    assert module._program() == ("lodestream" if known or path == "-c" else path)
