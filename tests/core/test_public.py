from __future__ import annotations

import ast
import importlib
import pkgutil
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import lodestream as ls
from lodestream import errors
from lodestream.protocol.messages import MessageError
from tests.patience import PATIENCE

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
    if hasattr(module, "__path__") and not hasattr(module, "__all__"):
        return  # a package without names of its own
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


SHAPE = re.compile(
    r"\bshapes?\b"
    r"|\((?:[\w.* ]+,)+[^)]*\)"  # the axes by name: (row, column)
)
ERRORS = {*errors.__all__, MessageError.__name__}


def sources() -> Iterator[tuple[str, ast.Module]]:
    """Every module of the core."""
    for path in sorted(SOURCE.parent.rglob("*.py")):
        yield str(path.relative_to(SOURCE.parent)), ast.parse(path.read_text())


def exported(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """The functions that a module exports, and the methods of its classes that have a public name."""
    said = [
        node.value for node in tree.body if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    ]
    names = ast.literal_eval(said[0]) if said else []
    for node in tree.body:
        overload = isinstance(node, ast.FunctionDef) and "overload" in map(ast.unparse, node.decorator_list)
        if isinstance(node, ast.FunctionDef) and node.name in names and not overload:
            yield node
        if isinstance(node, ast.ClassDef) and node.name in names:
            yield from (
                each for each in node.body if isinstance(each, ast.FunctionDef) and not each.name.startswith("_")
            )


def raised(node: ast.AST) -> Iterator[str]:
    """Names of the errors that a function raises itself."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Raise) and isinstance(child.exc, ast.Call):
            yield ast.unparse(child.exc.func)
        if not isinstance(child, ast.FunctionDef | ast.Lambda):
            yield from raised(child)


def is_array(node: ast.Assign) -> bool:
    """Whether it names a type of arrays."""
    return ast.unparse(node.value).startswith("NDArray[")


def test_whatever_takes_or_gives_arrays_tells_their_shape() -> None:
    silent, seen = [], 0
    for path, tree in sources():
        aliases = {
            ast.unparse(node.targets[0]) for node in tree.body if isinstance(node, ast.Assign) and is_array(node)
        }
        array = re.compile(rf"\b(?:{'|'.join(['NDArray', 'ArrayLike', *aliases])})\b")
        for function in exported(tree):
            arguments = [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]
            annotations = [function.returns, *(argument.annotation for argument in arguments)]
            if any(array.search(ast.unparse(each)) for each in annotations if each is not None):
                seen += 1
                if not SHAPE.search(ast.get_docstring(function) or ""):
                    silent.append(f"{path}: {function.name}")
    assert not silent, silent
    assert seen > 150, "fewer than there were when this was written"


def test_whatever_raises_an_error_names_it() -> None:
    silent, seen = [], 0
    for path, tree in sources():
        for function in exported(tree):
            own = ERRORS & set(raised(function))
            seen += bool(own)
            silent += [
                f"{path}: {function.name}: {name}" for name in own if name not in (ast.get_docstring(function) or "")
            ]
    assert not silent, silent
    assert seen > 100, "fewer than there were when this was written"


def run(script: str) -> str:
    """What a script prints in a fresh interpreter."""
    command = [sys.executable, "-c", f"import sys; sys.path.insert(0, {str(SOURCE.parents[1])!r}); {script}"]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=PATIENCE).stdout.strip()
