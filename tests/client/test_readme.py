"""The README's commands, programs and links work."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import httpx
import numpy as np
import pytest

import lodestream as ls
from lodestream_client.demo.terrain import terrain
from lodestream_client.program import build_parser
from tests.patience import PATIENCE

from .conftest import Run

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def commands() -> list[list[str]]:
    lines = re.findall(r"^\$ (lodestream .*)$", "".join(blocks("console")), re.MULTILINE)
    return [shlex.split(line.removesuffix("&"), comments=True)[1:] for line in lines]


def test_its_links_lead_somewhere() -> None:
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]
    assert len(links) > 10
    for link in links:
        path, _, heading = link.partition("#")
        assert (ROOT / path).exists(), link
        headings = re.findall(r"^#+ (.*)$", (ROOT / path).read_text(), re.MULTILINE) if heading else []
        assert not heading or heading in [it.lower().replace(" ", "-") for it in headings], link


def test_its_commands_are_understood() -> None:
    found = commands()
    names = {"encode", "info", "decode", "serve", "push", "pull", "token", "open", "view"}
    assert {command[0] for command in found} == names
    for command in found:
        build_parser().parse_args([it.replace("URL", "http://127.0.0.1:8000/v1/surfaces/ID") for it in command])


def test_its_commands_run(server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    """All but `serve`, for which there is the fixture, the browser, and the line for a map, which is run below."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lodestream-demo").mkdir()
    np.save(tmp_path / "lodestream-demo" / "terrain.npy", terrain((256, 480)))
    url = ""
    for command in commands():
        if command[0] in ("serve", "open") or "dem.tif" in command:
            continue
        arguments = [it.replace("http://127.0.0.1:8000", server).replace("URL", url) for it in command]
        code, printed, said = run(*arguments)
        assert code == 0, f"{command}: {said}"
        if command[0] == "push":
            url = printed.strip()
    assert len(list(tmp_path.glob("rough-*.png"))) == 3
    assert np.load("rough.npy").shape == (256, 480)
    assert np.array_equal(np.load("window.npy"), np.load("lodestream-demo/terrain.npy")[100:220, 300:460])
    assert (tmp_path / "surfaces" / "tokens.json").is_file()


def test_its_lines_for_a_map_find_tiles(server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    """What MapLibre asks for after them; tests/web draws a map of such a source."""
    pytest.importorskip("rasterio")
    (push,) = [command for command in commands() if "dem.tif" in command]
    maps = pytest.importorskip("lodestream.maps")
    placed = {"crs": maps.crs_wkt("EPSG:32611"), "geotransform": [376300, 30, 0, 3807900, 0, -30]}
    ls.write(ls.Surface(terrain((256, 480)), metadata=placed), tmp_path / "dem.tif")
    monkeypatch.chdir(tmp_path)
    code, printed, said = run(*(it.replace("http://127.0.0.1:8000", server) for it in push))
    assert code == 0, said
    (lines,) = blocks("js")
    source, layer = re.findall(r"^map\.(\w+)\((.*)\);$", lines, re.MULTILINE)
    assert (source[0], layer[0]) == ("addSource", "addLayer")
    assert 'type: "raster-dem"' in source[1]
    assert 'source: "dem"' in layer[1]
    (address,) = re.findall(r'url: "(.*?)"', source[1])
    address = address.replace("http://127.0.0.1:8000", server)
    assert address == f"{printed.strip()}/map.json"
    told = httpx.get(address, trust_env=False, timeout=PATIENCE).raise_for_status().json()
    assert told["encoding"] == "mapbox"  # what MapLibre takes a raster-dem for
    west, south, east, north = told["bounds"]
    z = told["maxzoom"]
    x = int(((west + east) / 2 + 180) / 360 * 2**z)
    y = int((1 - np.arcsinh(np.tan(np.radians((south + north) / 2))) / np.pi) / 2 * 2**z)
    tile = httpx.get(told["tiles"][0].format(z=z, x=x, y=y), trust_env=False, timeout=PATIENCE).raise_for_status()
    assert tile.content.startswith(b"\x89PNG")


def test_its_programs_run(
    server: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lodestream-demo").mkdir()
    np.save(tmp_path / "lodestream-demo" / "terrain.npy", terrain((256, 480)))
    (tmp_path / "terrain.lode").write_bytes(ls.encode(terrain((256, 480))))
    programs = blocks("python")
    assert len(programs) == 3
    programs.pop()  # its lines stand in docs/python.md, where they run: see test_python_page.py
    names: dict[str, object] = {}
    for program in programs:
        exec(program.replace("http://127.0.0.1:8000", server), names)
    window, surface = names["window"], names["surface"]
    assert isinstance(window, np.ndarray)
    assert np.array_equal(window, surface.points[100:220, 300:460])  # type: ignore[attr-defined]
    assert "(256, 480)" in capsys.readouterr().out
