"""`docs/architecture.md` says where things are: its tables of modules, their order, and every path on it are true."""

from __future__ import annotations

import re
import tomllib
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text()

#: Packages and the headings under which their modules stand.
HEADINGS = {
    "The core": "core/lodestream",
    "The client": "client/lodestream_client",
    "The server": "server/lodestream_server",
}


def section(heading: str) -> str:
    """The text under a heading of the second order, up to the next one."""
    return re.split(r"(?m)^## ", PAGE.partition(f"\n## {heading}\n")[2])[0]


def rows(heading: str) -> list[list[str]]:
    """The cells of each row of the table in a section, without its head."""
    lines = [line for line in section(heading).splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def told(heading: str) -> dict[str, list[str]]:
    """The modules that a table names, by package; those outside packages under an empty name."""
    modules: dict[str, list[str]] = defaultdict(list)
    for package, names, _ in rows(heading):
        modules[package.strip("`/").replace("(root)", "")] += re.findall(r"`(\w+)`", names)
    return {package: sorted(names) for package, names in modules.items()}


def there(folder: Path) -> dict[str, list[str]]:
    """The modules of a package in the tree, by package."""
    modules: dict[str, list[str]] = defaultdict(list)
    for path in folder.rglob("*.py"):
        if path.stem not in ("__init__", "__main__"):
            modules["/".join(path.relative_to(folder).parts[:-1])].append(path.stem)
    return {package: sorted(names) for package, names in modules.items()}


def paths() -> list[str]:
    """What the page names by a path of the tree, or by the name of a file."""
    top = "|".join(re.escape(path.name) for path in ROOT.iterdir() if not path.name.startswith(".git"))
    return sorted({name for name in re.findall(r"`([^`\s]+)`", PAGE) if re.match(rf"({top})(/|$)|.*\.(py|c|h)$", name)})


@pytest.mark.parametrize(("heading", "folder"), HEADINGS.items())
def test_every_module_stands_once_in_the_table_beside_its_package(heading: str, folder: str) -> None:
    assert told(heading) == there(ROOT / folder)


@pytest.mark.parametrize(("heading", "folder"), HEADINGS.items())
def test_the_tables_follow_the_layers_that_imports_are_checked_by(heading: str, folder: str) -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(each["layers"] for each in contracts if each.get("containers") == [Path(folder).name])
    place = {name: at for at, layer in enumerate(layers) for name in layer.split(" | ")}
    told_in_order = [
        place[name]
        for package, modules, _ in rows(heading)
        for name in (re.findall(r"`(\w+)`", modules) if package == "(root)" else [package.strip("`").split("/")[0]])
        if name in place
    ]
    assert told_in_order == sorted(told_in_order)
    assert set(told_in_order) == set(range(len(layers)))


def test_every_path_of_the_page_is_there() -> None:
    assert len(paths()) > 60
    assert [name for name in paths() if not (ROOT / name).exists()] == []


def test_what_to_open_is_told_of_at_least_twenty_changes() -> None:
    changes = rows("To change X, open Y")
    assert len(changes) >= 20
    for change, first, _ in changes:
        assert change
        assert set(re.findall(r"`([^`\s]+)`", first)) & set(paths()), change
