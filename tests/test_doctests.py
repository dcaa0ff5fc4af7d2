"""The examples in docstrings do what they say."""

from __future__ import annotations

import doctest
import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: An example that runs: those of streams need a server, and say ``doctest: +SKIP``.
EXAMPLE = re.compile(r"(?m)^ *>>> (?!.*doctest: \+SKIP)")


def modules() -> list[str]:
    """The modules with examples. To read them all costs less than to import them all."""
    folders = [ROOT / each for each in ("core", "server", "client")]
    return sorted(
        ".".join(path.relative_to(folder).with_suffix("").parts).removesuffix(".__init__")
        for folder in folders
        for path in folder.glob("lodestream*/**/*.py")
        if EXAMPLE.search(path.read_text())
    )


@pytest.mark.parametrize("name", modules())
def test_the_examples_of_a_module(name: str) -> None:
    found = doctest.testmod(importlib.import_module(name))
    assert found.attempted > 0
    assert found.failed == 0
