"""docs/notebook.ipynb runs from its first cell to its last, in a kernel of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from lodestream import page
from tests.patience import PATIENCE

NOTEBOOK = Path(__file__).parents[3] / "docs" / "notebook.ipynb"
SERVER = "http://127.0.0.1:8000"

# In a process of its own: what these libraries warn of is not ours.
_RUN = """
import sys
import nbformat
from nbclient import NotebookClient

notebook = nbformat.read(sys.argv[1], as_version=4)
NotebookClient(notebook, timeout=float(sys.argv[2]), kernel_name="python3").execute()
nbformat.write(notebook, sys.argv[1])
"""


def run(notebook: dict[str, Any], folder: Path, environment: dict[str, str]) -> list[dict[str, Any]]:
    path = folder / "notebook.ipynb"
    path.write_text(json.dumps(notebook))
    done = subprocess.run(
        [sys.executable, "-c", _RUN, str(path), str(PATIENCE)],
        cwd=folder,
        env={**environment, "MPLBACKEND": "agg", "JUPYTER_PLATFORM_DIRS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]


def shown(cell: dict[str, Any], media_type: str) -> str:
    return "".join(line for output in cell["outputs"] for line in output.get("data", {}).get(media_type, []))


def printed(cell: dict[str, Any]) -> str:
    return "".join(line for output in cell["outputs"] for line in output.get("text", []))


@pytest.mark.long
@pytest.mark.skipif(page.widget_modules() is None, reason=page.HOW_TO_BUILD)
def test_it_runs(server: str, installed: dict[str, str], tmp_path: Path) -> None:
    for library in ("anywidget", "ipykernel", "nbclient", "pyvista", "xarray", "matplotlib"):
        pytest.importorskip(library)
    text = NOTEBOOK.read_text()
    assert text.count(SERVER) == 1
    notebook = json.loads(text.replace(SERVER, server))
    assert all(cell.get("outputs", []) == [] for cell in notebook["cells"])
    cells = run(notebook, tmp_path, installed)
    by_source = {"".join(cell["source"]): cell for cell in cells}

    def cell(words: str) -> dict[str, Any]:
        [found] = [cell for source, cell in by_source.items() if words in source]
        return found

    assert "data:image/png" in shown(cell('ls.read("terrain.npy")'), "text/html")
    for words in ('Widget("terrain.lode"', "Widget(made.url"):
        assert any("application/vnd.jupyter.widget-view+json" in output["data"] for output in cell(words)["outputs"])
    lines = printed(cell("stream.stop()")).splitlines()
    assert len(lines) > 2
    assert "RMS error" in lines[-1]
    assert "data:image/png" in shown(cell("stream.stop()"), "text/html")
    assert "xarray" in shown(cell("import xarray"), "text/html")
    assert "StructuredGrid" in shown(cell("import pyvista"), "text/html")
