"""`docs/architecture.md` names the modules that are there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text()


def named(heading: str) -> list[str]:
    """The modules that the tables of a section name, from its first column."""
    section = re.split(r"(?m)^## ", PAGE.partition(f"\n## {heading}\n")[2])[0]
    names: list[str] = []
    column = 0
    for line in section.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else []
        if {"module", "modules"} & set(cells):
            column = next(at for at, cell in enumerate(cells) if cell in ("module", "modules"))
        names += re.findall(r"`(\w+)`", cells[column]) if cells else []
    return names


@pytest.mark.parametrize(
    ("heading", "package"),
    [
        ("Modules of the core", "core/lodestream"),
        ("The client", "client/lodestream_client"),
        ("The server", "server/lodestream_server"),
    ],
)
def test_every_module_stands_once_in_the_tables(heading: str, package: str) -> None:
    folder = ROOT / package
    modules = {path.stem for path in folder.glob("*.py")} | {path.parent.name for path in folder.glob("*/__init__.py")}
    assert sorted(named(heading)) == sorted(modules - {"__init__", "__main__"})
