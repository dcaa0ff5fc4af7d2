"""The examples in docstrings do what they say, beside a server and with a file and its container in the folder."""

from __future__ import annotations

import doctest
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import lodestream as ls
from lodestream import page
from lodestream_server import running_server

ROOT = Path(__file__).parents[1]
#: An example that runs: what needs more than there is here says ``doctest: +SKIP``.
EXAMPLE = re.compile(r"(?m)^ *>>> (?!.*doctest: \+SKIP)")
#: The address in the examples: the server here has another port.
ADDRESS = "http://127.0.0.1:8000"


def modules() -> list[str]:
    """The modules with examples. To read them all costs less than to import them all."""
    folders = [ROOT / each for each in ("core", "server", "client")]
    return sorted(
        ".".join(path.relative_to(folder).with_suffix("").parts).removesuffix(".__init__")
        for folder in folders
        for path in folder.glob("lodestream*/**/*.py")
        if EXAMPLE.search(path.read_text())
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``terrain.npy`` and ``terrain.lode``."""
    folder = tmp_path_factory.mktemp("examples")
    y, x = np.mgrid[0:97, 0:70]
    heights = (90 * np.sin(x / 9) * np.cos(y / 13)).astype(np.float32)
    np.save(folder / "terrain.npy", heights)
    (folder / "terrain.lode").write_bytes(ls.encode(heights))
    return folder


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, one_fork_server: None) -> Iterator[str]:
    with running_server(tmp_path_factory.mktemp("server") / "data", workers=1) as url:
        yield url


@pytest.mark.parametrize("name", modules())
def test_the_examples_of_a_module(
    name: str, folder: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name == "lodestream_client.notebook.widget" and page.widget_modules() is None:
        pytest.skip(page.HOW_TO_BUILD)
    module = importlib.import_module(name)
    monkeypatch.chdir(folder)
    runner = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS)
    for found in doctest.DocTestFinder(exclude_empty=True).find(module):
        if any(ADDRESS in example.source for example in found.examples):
            server = request.getfixturevalue("server")
            for example in found.examples:
                example.source = example.source.replace(ADDRESS, server)
        runner.run(found)
    assert runner.tries > 0
    assert runner.failures == 0
