"""Writes docs/api.md from the docstrings, which griffe reads: ``python -m tests.client.api_manual``."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import griffe

ROOT = Path(__file__).parents[2]
PATH = ROOT / "docs" / "api.md"

#: What the page has, in its order: a heading, the module, and what is said of it.
PACKAGES = (
    ("lodestream", "lodestream", "Surfaces, files, containers; no network."),
    ("lodestream.maps", "lodestream.maps", "Tiles of heights for maps and globes ([maps.md](maps.md)); no network."),
    ("lodestream_client", "lodestream_client", "A server's surfaces: `Client`, and `AsyncClient` for asyncio."),
)

_INTRODUCTION = """\
# Python

Every public name of `lodestream`, `lodestream.maps` and `lodestream_client`, from its docstring. The examples run in
the tests, in a folder with a surface, `terrain.npy`, of 97 x 70 heights, and its container `terrain.lode`, beside a
server on `http://127.0.0.1:8000` (`lodestream serve`). [python.md](python.md) shows surfaces in xarray, pyvista,
trimesh, zarr and notebooks; [cli.md](cli.md) has the command line.

This page is written by `python -m tests.client.api_manual`; a test checks it.
"""

_TITLES = {"parameters": "Parameters", "attributes": "Attributes", "returns": "Returns", "raises": "Raises"}
#: Members that come with a class of Python's own, or are are of no use here.
_NOT_SHOWN = frozenset(["with_traceback", "add_note"])


def public_names(module: griffe.Module) -> Iterator[tuple[str, griffe.Object]]:
    """Each exported name, sorted, and what it stands for."""
    for name in sorted(map(str, module.exports or ()), key=str.lower):
        member = _real(module[name])
        if isinstance(member, griffe.Attribute):  # another name of what is here: ``list = list_surfaces``
            member = _real(module[str(member.value)])
        yield name, member


@cache
def load() -> griffe.ModulesCollection:
    """Both packages, as their sources say."""
    loader = griffe.GriffeLoader(
        search_paths=[ROOT / "core", ROOT / "client"],
        docstring_parser=griffe.Parser.numpy,
        docstring_options={"warn_unknown_params": False},  # those of `connect` stand in a TypedDict
    )
    for package in ("lodestream", "lodestream_client"):
        loader.load(package)
    loader.resolve_aliases(external=False)
    return loader.modules_collection


def render() -> str:
    """The whole page."""
    modules = load()
    parts = [_INTRODUCTION]
    for heading, path, said in PACKAGES:
        names = list(public_names(modules[path]))
        listed = ", ".join(f"[`{name}`](#{_anchor(path, name)})" for name, _ in names)
        parts += [f"## {heading}\n", f"{said}\n", f"{listed}\n"]
        for name, thing in names:
            parts += [f'<a id="{_anchor(path, name)}"></a>\n', f"### {path}.{name}\n"]
            if thing.name != name:
                parts.append(f"The same as [`{thing.name}`](#{_anchor(path, thing.name)}).\n")
            else:
                parts += _described(name, thing)
    return re.sub(r"\n{3,}", "\n\n", "\n".join(parts))


def _anchor(path: str, name: str) -> str:
    return f"{path}.{name}"


def _described(name: str, thing: griffe.Object) -> Iterator[str]:
    """Signature and docstring of a name, and of what a class has."""
    if thing.is_module:
        yield from _sections(thing)
        for each, member in public_names(own(thing)):
            yield f"#### {name}.{each}\n"
            yield from _described(each, member)
        return
    yield f"```python\n{_signature(name, thing)}\n```\n"
    yield from _sections(thing)
    if thing.is_class:
        members = {each: _real(member) for each, member in thing.all_members.items() if _shown(each, _real(member))}
        for each, target in sorted(members.items(), key=lambda item: (not item[1].is_attribute, item[0])):
            if target.is_attribute and target.docstring is not None:
                yield f"**`{each}`**: {_prose(target.docstring.parsed[0].value).strip()}\n"
            else:
                yield f"#### {name}.{each}\n\n```python\n{_signature(each, target)}\n```\n"
                yield from _sections(target)


def own(module: Any) -> griffe.Module:
    """A module that is a public name itself."""
    assert isinstance(module, griffe.Module)
    return module


def _real(member: Any) -> griffe.Object:
    """What a name stands for, which is perhaps imported or inherited."""
    target = member.final_target if member.is_alias else member
    assert isinstance(target, griffe.Object)
    return target


def _shown(name: str, member: griffe.Object) -> bool:
    return not name.startswith("_") and name not in _NOT_SHOWN and bool(member.docstring)


def _signature(name: str, thing: griffe.Object) -> str:
    if isinstance(thing, griffe.Class):
        bases = ", ".join(str(base) for base in thing.bases)
        made: Any = thing.parameters if "__init__" in thing.all_members else []
        shown = [_parameter(each) for each in made if each.name != "self" and not each.name.startswith("_")]
        head = _wrapped(name if shown else f"class {name}", _starred(made, shown), "")
        return f"{head}  # {bases}" if bases else head
    assert isinstance(thing, griffe.Function)
    shown = [_parameter(each) for each in thing.parameters if each.name not in ("self", "cls")]
    before = "async def" if "async" in thing.labels else "def"
    returns = f" -> {thing.returns}" if thing.returns is not None else ""
    return _wrapped(f"{before} {name}", _starred(thing.parameters, shown), returns)


def _starred(parameters: Any, shown: list[str]) -> list[str]:
    """The parameters with the star before those that are by keyword only."""
    kinds = [each.kind for each in parameters if each.name not in ("self", "cls") and not each.name.startswith("_")]
    keyword, variable = griffe.ParameterKind.keyword_only, griffe.ParameterKind.var_positional
    if keyword in kinds and variable not in kinds:
        shown = [*shown[: kinds.index(keyword)], "*", *shown[kinds.index(keyword) :]]
    return shown


def _parameter(each: griffe.Parameter) -> str:
    kinds = griffe.ParameterKind
    star = "*" if each.kind is kinds.var_positional else "**" if each.kind is kinds.var_keyword else ""
    text = f"{star}{each.name}" + (f": {each.annotation}" if each.annotation is not None else "")
    return text if each.default is None or star else f"{text} = {each.default}"


def _wrapped(head: str, parameters: list[str], tail: str) -> str:
    line = f"{head}({', '.join(parameters)}){tail}" if parameters or not head.startswith("class") else head
    if len(line) <= 110:
        return line
    return f"{head}(\n" + "".join(f"    {each},\n" for each in parameters) + f"){tail}"


def _sections(thing: griffe.Object) -> Iterator[str]:
    for section in thing.docstring.parsed if thing.docstring else ():
        kind = section.kind.value
        if kind == "text":
            yield _prose(section.value)
        elif kind == "admonition":
            yield _prose(section.value.description)
        elif kind == "examples":
            for part, text in section.value:
                yield _fenced(text) if part.value == "examples" else _prose(text)
        else:
            yield f"{_TITLES[kind]}:\n"
            yield "\n".join(_item(each) for each in section.value) + "\n"


def _item(each: Any) -> str:
    """An entry of a list: name and type of a parameter, the type of a result, or the class of an error."""
    name = getattr(each, "name", "")
    annotation = "" if each.annotation is None else str(each.annotation).strip()
    head = " ".join(
        filter(None, [f"`{name}`" if name else "", f"({annotation})" if name and annotation else annotation])
    )
    text = _prose(each.description).strip() if each.description else ""
    return textwrap.indent(f"{head}: {text}" if text else head, "  ").replace("  ", "- ", 1)


def _prose(text: str) -> str:
    """Text of a docstring as Markdown: examples and figures fenced, code in single quotes."""
    parts = []
    for part in re.split(r"\n{2,}", text.strip("\n")):
        if part.lstrip().startswith(">>>"):
            parts.append(_fenced(textwrap.dedent(part)).rstrip("\n"))
        elif part.startswith("    "):
            parts.append(f"```text\n{textwrap.dedent(part)}\n```")
        elif part.strip() != "::":
            parts.append(part.replace("``", "`").removesuffix("::"))
    return "\n\n".join(parts) + "\n"


def _fenced(text: str) -> str:
    return f"```pycon\n{text.strip()}\n```\n"


if __name__ == "__main__":
    PATH.write_text(render())
