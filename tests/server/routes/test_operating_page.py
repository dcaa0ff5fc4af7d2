"""The commands of docs/operating.md: those of curl run as they stand there, for the others a table says why not."""

from __future__ import annotations

import gc
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import httpx
import numpy as np
import pytest

import lodestream as ls
from tests.patience import PATIENCE
from tests.server.helpers import hills, settled

PAGE = (Path(__file__).parents[3] / "docs" / "operating.md").read_text()
NOT_RUN = {
    "docker": "there is no engine; test_image.py checks the files",
    "lodestream": "tests/client/test_pages.py parses them, tests of the commands run the same with other folders",
    "pip": "it needs the network",
    "rsync": "it needs another machine; tests/history copies a data folder in this order",
    "sudo": "it needs the user lodestream",
}


def commands() -> list[str]:
    blocks = "".join(re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL))
    return re.findall(r"^\$ (.*)$", re.sub(r"\\\n *", "", blocks), re.MULTILINE)


def test_every_program_is_run_or_there_is_a_reason() -> None:
    programs = {re.sub(r"^(?:[A-Z_]+=\S+ )*", "", command).split()[0] for command in commands()}
    assert programs == {"curl", *NOT_RUN}


@pytest.fixture
def curl(server: str, tmp_path: Path) -> Callable[[str], str]:
    """Run a command of curl in a folder with a file mountain.tif; what it prints."""
    if shutil.which("curl") is None:
        pytest.skip("curl is not installed")
    pytest.importorskip("rasterio")
    ls.write(ls.Surface(hills(60, 50)), tmp_path / "mountain.tif")

    def run(command: str) -> str:
        line = command.replace("http://127.0.0.1:8000", server).replace(
            "curl ", "curl -q --noproxy '*' --silent --show-error --fail ", 1
        )
        done = subprocess.run(
            ["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE, check=False
        )
        assert done.returncode == 0, f"{command}: {done.stderr}"
        return done.stdout

    return run


def curls(*, resumable: bool) -> list[str]:
    return [it for it in commands() if it.startswith("curl") and ("/v1/uploads" in it) is resumable]


def test_curl_uploads_and_fetches_what_the_page_says(
    curl: Callable[[str], str], http: httpx.Client, tmp_path: Path
) -> None:
    upload, *others = curls(resumable=False)
    assert len(others) == 6
    surface = json.loads(curl(upload))["id"]
    settled(http, f"/v1/surfaces/{surface}")
    answers = [curl(re.sub(r"\bID\b", surface, command)) for command in others]
    assert json.loads(answers[0])["state"] == "ready"
    assert json.loads(answers[-1])["id"] == surface
    points = ls.decode((tmp_path / "mountain.lode").read_bytes()).points
    assert np.array_equal(points, hills(60, 50))
    coarse = ls.read(tmp_path / "coarse.ply").points
    assert coarse.shape[:2] == ls.read(tmp_path / "coarse.tif").points.shape
    assert coarse.shape[0] < 60


def test_curl_sends_a_file_in_parts_as_the_page_says(curl: Callable[[str], str], http: httpx.Client) -> None:
    def header(answer: str, name: str) -> str:
        return next(line for line in answer.splitlines() if line.lower().startswith(name)).partition(": ")[2]

    begin, *others = curls(resumable=True)
    upload = header(curl(begin), "location").rpartition("/")[2]
    part, how_far, rest = (curl(command.replace("UPLOAD", upload)) for command in others)
    assert header(part, "upload-offset") == header(how_far, "upload-offset") == "5000"
    surface = settled(http, header(rest, "location"))
    assert (surface["state"], surface["filenames"]) == ("ready", ["mountain.tif"])
    container = http.get(f"{surface['url']}/container").raise_for_status().content
    assert np.array_equal(ls.decode(container).points, hills(60, 50))


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # tuspy's
def test_tuspy_sends_a_file_as_the_page_says(
    server: str, http: httpx.Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tus = pytest.importorskip("tusclient.client")
    np.save(tmp_path / "mountain.npy", hills(60, 50, seed=2))
    monkeypatch.chdir(tmp_path)
    (line,) = re.findall(r"`(TusClient\(.*?\.upload\(\))`", PAGE)
    line = line.replace("http://127.0.0.1:8000", server).replace("mountain.tif", "mountain.npy")
    eval(line, {"TusClient": tus.TusClient})
    gc.collect()  # while the warning is ignored
    (surface,) = [it for it in http.get("/v1/surfaces?limit=1000").json()["surfaces"] if it["name"] == "Mountain"]
    assert settled(http, surface["url"])["state"] == "ready"
