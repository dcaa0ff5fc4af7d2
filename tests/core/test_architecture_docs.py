"""`docs/architecture.md` says where things are: its tables of packages, their order, and every path on it are true."""

from __future__ import annotations

import ast
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "architecture.md").read_text()

#: Packages and the headings under which their tables are.
HEADINGS = {
    "The core": "core/lodestream",
    "The client": "client/lodestream_client",
    "The server": "server/lodestream_server",
}
#: Lines of the page, at most.
LONGEST = 300


def section(heading: str) -> str:
    """Return the text under a heading of the second order, up to the next one."""
    return re.split(r"(?m)^## ", PAGE.partition(f"\n## {heading}\n")[2])[0]


def rows(heading: str) -> list[list[str]]:
    """Return the cells of each row of the table in a section, without its head."""
    lines = [line for line in section(heading).splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def table(heading: str) -> list[str]:
    """Return the packages, as "name/", and single modules, as "name", that a table names, in its order."""
    return [name for names, _ in rows(heading) for name in re.findall(r"`(\w+/?)`", names)]


def tree(folder: Path) -> list[str]:
    """Return the packages and single modules of a folder, named as in `table`."""
    packages = [f"{path.parent.name}/" for path in folder.glob("*/__init__.py")]
    modules = [path.stem for path in folder.glob("*.py") if path.stem not in ("__init__", "__main__")]
    return packages + modules


def paths() -> list[str]:
    """Return what the page names by a path of the tree, or by the name of a file."""
    top = "|".join(re.escape(path.name) for path in ROOT.iterdir() if not path.name.startswith(".git"))
    return sorted({name for name in re.findall(r"`([^`\s]+)`", PAGE) if re.match(rf"({top})(/|$)|.*\.(py|c|h)$", name)})


def modules() -> list[Path]:
    """Return all modules of the three packages."""
    return [path for folder in HEADINGS.values() for path in sorted((ROOT / folder).rglob("*.py"))]


@pytest.mark.parametrize(("heading", "folder"), HEADINGS.items())
def test_every_package_and_single_module_is_in_the_table_once(heading: str, folder: str) -> None:
    assert sorted(table(heading)) == sorted(tree(ROOT / folder))


@pytest.mark.parametrize(("heading", "folder"), HEADINGS.items())
def test_every_row_says_what_it_is_about(heading: str, folder: str) -> None:
    assert all(len(meaning) > 20 for _, meaning in rows(heading))


@pytest.mark.parametrize(("heading", "folder"), HEADINGS.items())
def test_the_tables_follow_the_layers_that_imports_are_checked_by(heading: str, folder: str) -> None:
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = next(contract["layers"] for contract in contracts if contract.get("containers") == [Path(folder).name])
    place = {name: at for at, layer in enumerate(layers) for name in layer.split(" | ")}
    order = [place[name.rstrip("/")] for name in table(heading) if name.rstrip("/") in place]
    assert order == sorted(order)
    assert set(order) == set(range(len(layers)))


def test_the_docstring_of_every_module_says_in_its_first_line_what_it_is() -> None:
    first = {}
    for path in modules():
        lines = (ast.get_docstring(ast.parse(path.read_text())) or "").splitlines()
        first[str(path.relative_to(ROOT))] = lines[0] if lines else ""
    assert len(first) > 300
    assert {name: line for name, line in first.items() if len(line) < 12 or line[-1] not in ".:,?"} == {}


def test_every_path_of_the_page_is_there() -> None:
    assert len(paths()) > 60
    assert [name for name in paths() if not (ROOT / name).exists()] == []


def test_what_to_open_is_told_of_at_least_twenty_changes() -> None:
    changes = rows("To change X, open Y")
    assert len(changes) >= 20
    for change, first, _ in changes:
        assert change
        assert set(re.findall(r"`([^`\s]+)`", first)) & set(paths()), change


def test_the_page_is_short_and_has_one_figure() -> None:
    assert len(PAGE.splitlines()) <= LONGEST
    assert PAGE.count("\n```") == 2
