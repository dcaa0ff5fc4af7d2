"""A server on a real socket with one surface, shared by all tests of the client."""

from __future__ import annotations

import os
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream import page
from lodestream_client import Client
from lodestream_client.__main__ import main
from lodestream_client.stream import effect_io, session
from lodestream_client.stream.effect_io import EffectIO
from lodestream_client.stream.effects import Effect, Get, Hear, Wait
from lodestream_client.stream.known_windows import KnownWindows
from lodestream_client.stream.session import Session
from lodestream_client.stream.websocket_options import socket_options
from lodestream_server import running_server
from tests.patience import PATIENCE

ROOT = Path(__file__).parents[2]


def make_terrain(rows: int = 97, columns: int = 70) -> NDArray[np.float32]:
    random = np.random.default_rng(7)
    y, x = np.mgrid[0:rows, 0:columns]
    hills = 90 * np.sin(x / 9) * np.cos(y / 13) + 25 * np.sin((x + 2 * y) / 5)
    points: NDArray[np.float32] = (hills + random.normal(0, 1.5, hills.shape)).astype(np.float32)
    return points


@pytest.fixture(scope="session", autouse=True)
def _one_fork_server(one_fork_server: None) -> None:
    """For all of these tests."""


@pytest.fixture(autouse=True)
def windows(monkeypatch: pytest.MonkeyPatch) -> KnownWindows:
    """Those of this process, of which nothing is known: no stream begins as one of another test has ended."""
    made = KnownWindows()
    monkeypatch.setattr(session, "_windows", made)
    return made


@pytest.fixture
def built(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Make a page of two files, in place of the one that Node builds."""
    folder = tmp_path / "built"
    (folder / "assets").mkdir(parents=True)
    (folder / page.INDEX).write_text("<!doctype html><title>page</title>")
    (folder / "assets" / "main-1.js").write_text("export {}")
    made = page.assets(folder)
    for module in ("lodestream.page", "lodestream_client.commands.open", "lodestream_client.demo.site"):
        monkeypatch.setattr(f"{module}.assets", lambda: made)
    return folder


@pytest.fixture
def pages(built: Path) -> dict[str, page.Asset]:
    """Return the files of that page."""
    assert (built / page.INDEX).is_file()
    return page.assets()  # which is replaced


@pytest.fixture(scope="session")
def terrain() -> NDArray[np.float32]:
    return make_terrain()


@pytest.fixture(scope="session")
def terrain_file(terrain: NDArray[np.float32], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("terrain") / "terrain.npy"
    np.save(path, terrain)
    return path


@pytest.fixture(scope="session")
def container_file(terrain_file: Path) -> Path:
    path = terrain_file.with_suffix(".lode")
    assert main(["encode", str(terrain_file), str(path)]) == 0
    return path


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with running_server(tmp_path_factory.mktemp("server") / "data", workers=1, formats="all") as url:
        yield url


@pytest.fixture(scope="session")
def surface(server: str, terrain_file: Path) -> str:
    return Client(server).upload(terrain_file).url


@pytest.fixture
def paced(monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of streams goes on only while a limited rate holds them back, and then at once.

    So as much comes within the seconds of a target on a busy machine as on any other.
    """
    now = time.monotonic()
    begin, perform = Session.__init__, EffectIO.perform

    def begun(session: Session, *arguments: Any, **options: Any) -> None:
        begin(session, *arguments, **options)
        session.clock = lambda: now

    async def performed(io: EffectIO, effect: Effect) -> Any:
        nonlocal now
        match effect:
            case Wait(until):
                now = max(now, until)
                return None
            case Hear():
                effect = Hear(now + PATIENCE)
            case Get():
                effect = replace(effect, seconds=PATIENCE)
        return await perform(io, effect)

    monkeypatch.setattr(Session, "__init__", begun)
    monkeypatch.setattr(EffectIO, "perform", performed)


@pytest.fixture
def slow_handshakes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A handshake may take as long as it does on a busy machine, where silence is to be short."""

    def options(*given: Any) -> dict[str, Any]:
        return {**socket_options(*given), "open_timeout": PATIENCE}

    monkeypatch.setattr(effect_io, "socket_options", options)


Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(capsysbinary: pytest.CaptureFixture[bytes]) -> Run:
    """Runs the command line in this process: exit code, standard output, standard error."""

    def call(*arguments: object) -> tuple[int, str, str]:
        capsysbinary.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as error:
            code = int(error.code or 0)
        captured = capsysbinary.readouterr()
        return code, captured.out.decode(), captured.err.decode()

    return call


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """An environment in which a distribution with the entry points of pyproject.toml is installed."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    folder = tmp_path_factory.mktemp("installed")
    record = folder / "lodestream-9.9.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: lodestream\nVersion: 9.9\n")
    lines = [
        line
        for group, points in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{name} = {value}" for name, value in points.items()))
    ]
    (record / "entry_points.txt").write_text("\n".join(lines) + "\n")
    sources = [str(ROOT / part) for part in ("core", "server", "client")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sources])}
