"""How much memory a surface may take of whoever receives, decodes or looks at it."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream_client import Client

from ..asked import asked
from ..conftest import Run
from ..files import ranged
from .test_resume import Terrain, follow

POINTS = 97 * 70


@pytest.fixture(params=[False, True], ids=["sync", "async"])
def asynchronous(request: pytest.FixtureRequest) -> bool:
    return bool(request.param)


@pytest.mark.parametrize("transport", ["ws", "http", "auto"])
def test_a_stream(surface: str, terrain: Terrain, asynchronous: bool, transport: str) -> None:
    with pytest.raises(ls.TooLargeError, match=f"at most {POINTS - 1:,} vertices"):
        follow(surface, asynchronous, transport=transport, max_vertices=POINTS - 1)
    views, stream = follow(surface, asynchronous, transport=transport, max_vertices=POINTS)
    assert stream.ended == "complete"
    assert np.array_equal(views[-1].points, terrain)


def test_a_coarse_level_needs_no_more_than_it_has(surface: str, asynchronous: bool) -> None:
    for transport in ("ws", "http"):
        _, stream = follow(surface, asynchronous, transport=transport, target=ls.Target(level=2), max_vertices=1000)
        assert stream.ended == "level"


def test_the_commands(
    surface: str, container_file: Path, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LODESTREAM_CACHE", str(tmp_path / "cache"))  # in which no other test has left a part of it
    out = tmp_path / "o.npy"
    for source, where in ((("pull", surface), ""), (("decode", container_file), f"{container_file}: ")):
        code, stdout, stderr = run(*source, out, "--max-vertices", POINTS - 1)
        assert (code, stdout) == (1, "")
        assert stderr.splitlines() == [
            f"lodestream: {where}expected at most {POINTS - 1:,} vertices (max_vertices), got {POINTS:,}"
        ]
        assert not out.exists()
        assert run(*source, out, "--max-vertices", POINTS)[0] == 0
        out.unlink()
        for wrong in ("0", "-1", "1e6", "", "9" * 20, "\u0663"):
            assert run(*source, out, f"--max-vertices={wrong}")[0] == 2


def test_info_needs_no_memory_for_a_surface(tmp_path: Path, run: Run) -> None:
    path = tmp_path / "large.lode"
    path.write_bytes(ls.encode(np.zeros((2000, 2000), np.float32)))
    with ranged(tmp_path) as web:
        for what in (path, f"{web.url}/{path.name}"):
            code, stdout, stderr = run("info", what, "--max-vertices", 1_000_000)
            assert (code, stderr) == (0, "")
            assert "2000 x 2000" in stdout
        assert Client(f"{web.url}/{path.name}").describe_file(f"{web.url}/{path.name}", max_vertices=10)["shape"] == [
            2000,
            2000,
        ]
        found = asyncio.run(
            asked(f"{web.url}/{path.name}", lambda it: it.describe_file(f"{web.url}/{path.name}", max_vertices=10))
        )
        assert found["shape"] == [2000, 2000]
        assert run("pull", f"{web.url}/{path.name}", tmp_path / "o.npy", "--max-vertices", 1_000_000)[0] == 1
