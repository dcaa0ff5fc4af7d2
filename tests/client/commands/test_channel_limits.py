"""Stopping by errors of channels: from files, over both transports, in both clients, and what is told of it."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lodestream as ls
from lodestream_client import AsyncClient, Client
from tests.core.surfaces import terrain

from ..conftest import Run

SHAPE = 60, 50
SPEED = terrain(SHAPE, 3) / 100


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("channels") / "a.lode"
    wind = np.stack([terrain(SHAPE, 4), terrain(SHAPE, 5)], axis=2)
    path.write_bytes(ls.encode(ls.Surface(terrain(SHAPE), attributes={"speed": SPEED, "wind": wind})))
    return path


@pytest.fixture(scope="module")
def served(server: str, file: Path) -> str:
    return Client(server).upload(file).url


def described(run: Run, what: object) -> dict[str, Any]:
    code, stdout, _ = run("info", what, "--json")
    assert code == 0
    details: dict[str, Any] = json.loads(stdout)
    return details


def test_info_of_a_served_surface_has_them_as_that_of_its_file(run: Run, file: Path, served: str) -> None:
    ours, theirs = described(run, file), described(run, served)
    assert theirs["channel_names"] == ours["channel_names"] == ["z", "speed", "wind_0", "wind_1"]
    assert theirs["layers"] == ours["layers"]
    assert theirs["levels"] == ours["levels"]


@pytest.mark.parametrize("way", ["decode", "ws", "http"])
def test_it_stops_at_the_first_layer_that_meets_all(
    run: Run, file: Path, served: str, tmp_path: Path, way: str
) -> None:
    layers = described(run, file)["layers"]
    number = len(layers) // 2
    (z, _), (_, speed) = layers[number]["channels"][:2]
    layer = next(it for it in layers if it["channels"][0][0] <= z and it["channels"][1][1] <= speed)
    source = ("decode", file) if way == "decode" else ("pull", "--transport", way, served)
    options = ("--until-rms", f"z={z}", "--until-max", f"speed={speed}")
    code, stdout, stderr = run(*source, tmp_path / "o.npz", "--json", *options)
    figures = json.loads(stdout)
    assert (code, figures["ended"], figures["bytes"]) == (0, "channels", layer["bytes"]), stderr
    assert list(figures["channels"].values()) == layer["channels"]
    with np.load(tmp_path / "o.npz") as arrays:
        found = next(arrays[name] for name in arrays.files if name.endswith("speed"))
    assert np.abs(found - SPEED).max() <= speed


def test_what_cannot_be_reached_is_said(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "a.lode"
    path.write_bytes(
        ls.encode(ls.Surface(terrain(SHAPE), attributes={"speed": SPEED}), attribute_precision={"speed": 1})
    )
    code, _, stderr = run("decode", path, tmp_path / "o.npz", "--until-rms", "speed=1e-9", "--until-rms", "z=1")
    assert code == 0
    assert "the requested RMS error of speed cannot be reached: the complete surface has 0." in stderr


@pytest.mark.parametrize("way", ["decode", "ws", "http"])
def test_a_name_that_is_not_there_is_refused_with_those_that_are(
    run: Run, file: Path, served: str, tmp_path: Path, way: str
) -> None:
    source = ("decode", file) if way == "decode" else ("pull", "--transport", way, served)
    code, _, stderr = run(*source, tmp_path / "o.npz", "--until-rms", "pressure=1")
    assert code == 1
    assert "expected an error of one of z, speed, wind_0, wind_1, wind, got one of 'pressure'" in stderr
    assert not (tmp_path / "o.npz").exists()


@pytest.mark.parametrize("way", ["decode", "ws", "http"])
@pytest.mark.parametrize(("attributes", "limit"), [("none", "speed"), ("speed", "wind"), ("speed", "wind_1")])
def test_an_error_of_what_is_left_out_is_refused_with_the_reason(
    run: Run, file: Path, served: str, tmp_path: Path, way: str, attributes: str, limit: str
) -> None:
    source = ("decode", file) if way == "decode" else ("pull", "--transport", way, served)
    out = tmp_path / "o.npz"
    code, _, stderr = run(*source, out, "--attributes", attributes, "--until-rms", f"{limit}=0.1")
    assert code == 1
    assert f"got one of '{limit}', which is left out: it is not among the attributes asked for" in stderr
    assert not out.exists()


@pytest.mark.parametrize("way", ["decode", "ws", "http"])
@pytest.mark.parametrize(
    ("attributes", "names"), [("none", ["z"]), ("speed", ["z", "speed"]), ("wind", ["z", "wind_0", "wind_1"])]
)
@pytest.mark.parametrize(("limit", "ended"), [(("--max-bytes", "4000"), "bytes"), (("--level", "3"), "level")])
def test_errors_are_told_of_what_is_written_whatever_ended_it(
    run: Run,
    file: Path,
    served: str,
    tmp_path: Path,
    way: str,
    attributes: str,
    names: list[str],
    limit: tuple[str, str],
    ended: str,
) -> None:
    source = ("decode", file) if way == "decode" else ("pull", "--transport", way, served)
    code, stdout, stderr = run(*source, tmp_path / "o.npz", "--json", "--attributes", attributes, *limit)
    told = json.loads(stdout)
    assert (code, told["ended"], list(told["channels"])) == (0, ended, names), stderr
    states = described(run, file)["levels" if ended == "level" else "layers"]
    known = [dict(zip(("z", "speed", "wind_0", "wind_1"), it["channels"], strict=True)) for it in states]
    assert told["channels"] in [{name: errors[name] for name in names} for errors in known]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (("--until-rms", "=1"), "expected E or NAME=E"),
        (("--until-rms", "speed=fast"), "'fast' is not an error bound: write 0 or more"),
        (("--until-rms", "speed=0.1%"), "expected an error of 'speed' in its own unit"),
        (("--until-rms", "speed=1", "--until-rms", "speed=2"), "given twice"),
        (("--until-rms", "1", "--until-max", "speed=2"), "either an error of the whole surface or errors of channels"),
        (("--until-rms", "1", "--until-rms", "speed=2"), "either an error of the whole surface or errors of channels"),
        (("--until-rms", "speed=1", "--roi", "0:3,0:3"), "either errors of channels or a region"),
    ],
)
def test_a_wrong_command_line_is_told_apart(
    run: Run, file: Path, tmp_path: Path, options: tuple[str, ...], expected: str
) -> None:
    code, _, stderr = run("decode", file, tmp_path / "o.npz", *options)
    assert code == 2
    assert expected in " ".join(stderr.split())


def test_both_clients_take_numbers(served: str) -> None:
    target = ls.Target(until_rms={"speed": 0.05, "wind": 3})

    async def received() -> Any:
        async with AsyncClient(served) as client, client.connect(served, target=target) as stream:
            return [view async for view in stream], stream.ended

    with Client(served).connect(served, target=target) as stream:
        views = list(stream)
    others, ended = asyncio.run(received())
    assert (stream.ended, ended) == ("channels", "channels")
    assert [view.bytes for view in views] == [view.bytes for view in others]
    speed = views[-1].surface().attributes["speed"]
    assert np.sqrt(np.mean((speed - SPEED) ** 2)) <= 0.05
