"""The commands of docs/operating.md: those of curl run as they stand there, for the others a table says why not."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
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
    return re.findall(r"^\$ (.*)$", "".join(re.findall(r"```console\n(.*?)```", PAGE, re.DOTALL)), re.MULTILINE)


def test_every_program_is_run_or_there_is_a_reason() -> None:
    programs = {re.sub(r"^(?:[A-Z_]+=\S+ )*", "", command).split()[0] for command in commands()}
    assert programs == {"curl", *NOT_RUN}


def test_curl_uploads_and_fetches_what_the_page_says(server: str, http: httpx.Client, tmp_path: Path) -> None:
    if shutil.which("curl") is None:
        pytest.skip("curl is not installed")
    pytest.importorskip("rasterio")
    heights = hills(60, 50)
    ls.write(ls.Surface(heights), tmp_path / "mountain.tif")
    upload, *others = [command for command in commands() if command.startswith("curl")]
    assert len(others) == 6

    def curl(command: str) -> str:
        line = command.replace("http://127.0.0.1:8000", server).replace(
            "curl ", "curl -q --noproxy '*' --silent --show-error --fail ", 1
        )
        done = subprocess.run(
            ["bash", "-c", line], cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE, check=False
        )
        assert done.returncode == 0, f"{command}: {done.stderr}"
        return done.stdout

    surface = json.loads(curl(upload))["id"]
    settled(http, f"/v1/surfaces/{surface}")
    answers = [curl(re.sub(r"\bID\b", surface, command)) for command in others]
    assert json.loads(answers[0])["state"] == "ready"
    assert json.loads(answers[-1])["id"] == surface
    points = ls.decode((tmp_path / "mountain.lode").read_bytes()).points
    assert np.array_equal(points, heights)
    coarse = ls.read(tmp_path / "coarse.ply").points
    assert coarse.shape[:2] == ls.read(tmp_path / "coarse.tif").points.shape
    assert coarse.shape[0] < 60
