"""``encode --remesh``: meshes that are no grids become blocks, and what is refused names the option."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import lodestream as ls
from lodestream_client import Client
from lodestream_client.viewer.pictures import Picture
from tests.core.remesh import scenes
from tests.patience import PATIENCE

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


def test_whatever_tells_of_it_says_complete_never_exact_or_lossless(run: Run, file: Path, server: str) -> None:
    httpx = pytest.importorskip("httpx")
    out = file.with_suffix(".lode")
    assert run("encode", file, out, "--remesh", "--blocks", 12, "--remesh-error", "1e-2")[0] == 0
    code, stdout, stderr = run("push", out, server)
    assert code == 0, stderr
    url = stdout.strip()
    with Client(url).connect(url) as stream:
        *_, view = stream
    words = {
        "info": run("info", out)[1],
        "info of a server": run("info", stdout.strip())[1],
        "info --json": run("info", out, "--json")[1],
        "the API": httpx.get(stdout.strip(), timeout=PATIENCE).text,
        "a notebook": view._repr_html_(),
        "a picture": Picture.of(view, None, "ball").title,
    }
    for place, text in words.items():
        assert "complete" in text.lower(), place
        assert not any(word in text.lower() for word in ("exact", "lossless")), (place, text)
    for place in ("info --json", "the API"):
        facts = json.loads(words[place])
        assert facts["complete"] is True, place
        assert {"method", "rms_to_input", "rms_from_input", "largest_to_input", "folds"} <= set(
            facts["metadata"]["remesh"]
        )


def test_with_an_error_it_is_not_complete(run: Run, file: Path) -> None:
    out = file.with_suffix(".lode")
    assert run("encode", file, out, "--remesh", "--blocks", 12, "--remesh-error", "1e-2", "--precision", "1e-2")[0] == 0
    assert json.loads(run("info", out, "--json")[1])["complete"] is False
    assert "complete no, within the error that was asked for" in " ".join(run("info", out)[1].split())


def test_the_refusal_names_the_option(run: Run, file: Path) -> None:
    code, _, stderr = run("encode", file, file.with_suffix(".lode"))
    assert (code, "; --remesh resamples any mesh of triangles into blocks" in " ".join(stderr.split())) == (1, True)


@pytest.mark.parametrize("words", ["--blocks 12", "--remesh-error 1e-2"])
def test_what_goes_with_remesh_is_not_given_without_it(run: Run, file: Path, words: str) -> None:
    code, _, stderr = run("encode", file, file.with_suffix(".lode"), *words.split())
    assert (code, "expected --remesh with it" in stderr) == (2, True)
