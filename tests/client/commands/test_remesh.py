"""``encode --remesh``: meshes that are no grids become blocks, and what is refused names the option."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import lodestream as ls
from tests.core.remesh import scenes

from ..conftest import Run

pytest.importorskip("igl")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    points, faces = scenes.sphere()
    lines = [f"v {x} {y} {z}" for x, y, z in points.tolist()] + [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    path = tmp_path / "ball.obj"
    path.write_text("\n".join(lines))
    return path


def test_a_mesh_becomes_blocks(run: Run, file: Path) -> None:
    out = file.with_suffix(".lode")
    code, _, stderr = run("encode", file, out, "--remesh", "--blocks", 12, "--remesh-error", "1e-2")
    assert code == 0, stderr
    surface = ls.decode(out.read_bytes())
    assert 8 <= len(surface.blocks) <= 18
    code, stdout, _ = run("info", out, "--json")
    assert (code, json.loads(stdout)["metadata"]["remesh"]) == (0, surface.metadata["remesh"])
    code, stdout, _ = run("info", out)
    words = " ".join(stdout.split())
    assert (code, f"remeshed {len(surface.blocks)} blocks; RMS distance" in words) == (0, True), words
    assert "complete the remeshed surface bit for bit, which is not the mesh" in words
    assert not any(word in words.lower() for word in ("exact", "lossless"))


def test_the_refusal_names_the_option(run: Run, file: Path) -> None:
    code, _, stderr = run("encode", file, file.with_suffix(".lode"))
    assert (code, "; --remesh resamples any mesh of triangles into blocks" in " ".join(stderr.split())) == (1, True)


@pytest.mark.parametrize("words", ["--blocks 12", "--remesh-error 1e-2"])
def test_what_goes_with_remesh_is_not_given_without_it(run: Run, file: Path, words: str) -> None:
    code, _, stderr = run("encode", file, file.with_suffix(".lode"), *words.split())
    assert (code, "expected --remesh with it" in stderr) == (2, True)
