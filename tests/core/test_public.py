from __future__ import annotations

import ast
import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest

import lodestream as ls

SOURCE = Path(ls.__file__)
#: A script that VTK's process runs.
NO_MODULES = ("lodestream.formats.vtk.process",)


def test_every_public_name_is_there_sorted_and_from_where_it_is_said_to_be() -> None:
    assert sorted(ls.__all__, key=str.lower) == sorted([*ls._HOMES, "paper"], key=str.lower)
    assert len(set(ls.__all__)) == len(ls.__all__)
    assert ls.paper is importlib.import_module("lodestream.transform.paper")
    for name in ls._HOMES:
        home = importlib.import_module(f"lodestream.{ls._HOMES[name]}")
        assert name in home.__all__
        assert getattr(ls, name) is getattr(home, name)


def test_what_type_checkers_see_is_what_is_loaded() -> None:
    tree = ast.parse(SOURCE.read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level == 1]
    seen = {alias.name: node.module for node in imports for alias in node.names}
    assert seen == {**ls._HOMES, "paper": "transform"}


def modules() -> list[str]:
    """Every module of the core that may be imported, in all its packages."""
    found = pkgutil.walk_packages([str(SOURCE.parent)], "lodestream.")
    return ["lodestream", *(each.name for each in found if each.name not in NO_MODULES)]


@pytest.mark.parametrize("name", modules())
def test_every_module_says_what_it_is_and_what_it_exports(name: str) -> None:
    module = importlib.import_module(name)
    assert module.__doc__
    if (hasattr(module, "__path__") and not hasattr(module, "__all__")) or name.startswith("lodestream.reference."):
        return  # a package without names of its own; a page as a program, of which only the package exports anything
    for each in module.__all__:
        # An alias of types may be there for type checkers only.
        assert hasattr(module, each) or f"    {each}: TypeAlias = " in Path(str(module.__file__)).read_text()


def test_importing_the_package_loads_neither_kernels_nor_numbers_nor_readers() -> None:
    script = (
        "import sys; before = set(sys.modules); import lodestream; dir(lodestream); lodestream.CorruptStreamError;"
        "print(sorted({name.partition('.')[0] for name in set(sys.modules) - before}"
        " & {'ctypes', 'numpy', 'rasterio', 'msgpack', 'scipy'}))"
    )
    assert run(script) == "[]"


def test_names_that_are_not_there_are_refused_and_those_that_are_listed() -> None:
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        ls.nothing  # noqa: B018 - looking it up is the test
    assert set(ls.__all__) <= set(dir(ls))
    assert ls.__version__


def run(script: str) -> str:
    """What a script prints in a fresh interpreter."""
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(SOURCE.parents[1])!r}); {script}"]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=100).stdout.strip()
