"""Commands and programs of every page: they exist, and a table says which test runs them, or why none does."""

from __future__ import annotations

import argparse
import importlib.util
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from lodestream_client.program import build_parser

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "SECURITY.md",
    ROOT / "client/web/README.md",
    *sorted((ROOT / "docs").glob("*.md")),
]

#: Where the blocks of a page run, by page and language. An entry is a test, or "not run: " and the reason.
RUN = {
    ("README.md", "console"): "tests/client/test_readme.py",
    ("README.md", "js"): "tests/client/test_readme.py",
    ("README.md", "python"): "tests/client/test_readme.py",
    ("client/web/README.md", "indented"): "not run: tasks of package.json that install, build and test the package; "
    "`make page` and `make test-web` run the same",
    ("client/web/README.md", "js"): "client/web/tests/readme.test.ts",
    ("docs/api.md", "pycon"): "tests/test_doctests.py",
    ("docs/api.md", "python"): "not run: signatures",
    ("docs/benchmarks.md", "indented"): "not run: it takes hours",
    (
        "docs/gis.md",
        "indented",
    ): "not run: the address is an example; tests/server/routes/test_gis.py requests the same",
    ("docs/gis.md", "python"): "not run: the address is an example; tests/server/routes/test_gis.py reads the same",
    ("docs/http.md", "json"): "not run: examples of the models, which tests/server/routes/test_models.py checks",
    ("docs/installing.md", "console"): "not run: pip needs the network; `make release-rehearsal` installs the same",
    ("docs/large.md", "bash"): "not run: the files are examples; tests/client/commands/test_large_surfaces.py has"
    " these options",
    ("docs/large.md", "python"): "not run: it needs data of the reader; tests/core/encoding/test_dask.py does the same",
    ("docs/maps.md", "html"): "not run: it is client/web/examples/map.html, which tests/web opens",
    ("docs/maps.md", "python"): "tests/core/maps/test_page.py",
    ("docs/maps.md", "xml"): "tests/server/routes/test_gis.py",
    ("docs/mounting.md", "python"): "tests/server/routes/test_mounting.py",
    ("docs/notebooks.md", "python"): "not run: it shows a widget; tests/client/notebook runs docs/notebook.ipynb",
    ("docs/operating.md", "console"): "tests/server/routes/test_operating_page.py",
    ("docs/operating.md", "python"): "not run: it needs a cluster, as the page says",
    ("docs/protocol.md", "python"): "tests/client/stream/test_streams.py",
    ("docs/publishing.md", "indented"): "not run: the bucket is an example; tests/client/publishing runs the same",
    ("docs/python.md", "python"): "tests/client/test_python_page.py",
    (
        "docs/scaling.md",
        "console",
    ): "not run: the bucket is an example; tests/server/test_many_servers.py runs the same",
    ("docs/tutorial.md", "console"): "tests/test_tutorial.py",
    ("docs/tutorial.md", "indented"): "not run: pip needs the network; the test installs the wheel",
    ("docs/tutorial.md", "python"): "tests/test_tutorial.py",
    ("docs/viewer.md", "html"): "not run: it is client/web/examples/static.html, which tests/web opens",
}

PROGRAMS = "lodestream|make|python3?|pip|npm|npx|curl|docker|rsync|sudo"
_FENCED = re.compile(r"^```(\w+)\n(.*?)^```", re.DOTALL | re.MULTILINE)
_INDENTED = re.compile(rf"^    (?:\$ )?((?:{PROGRAMS}) .*)$", re.MULTILINE)
_INLINE = re.compile(rf"`((?:[A-Z_]+=\S+ )*(?:{PROGRAMS})\b[^`]*)`")
_SHELL = {"console", "bash", "sh"}
_TARGETS = set(re.findall(r"^([a-z-]+):.*## ", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)) | {
    "help"
}
_EXTRAS = set(tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"])


def name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def block_commands(text: str) -> Iterator[str]:
    """The commands of blocks of a shell, without prompts, variables before them, ``&`` and comments."""
    for language, block in _FENCED.findall(text):
        if language in _SHELL:
            lines = re.sub(r"\\\n *", "", block).splitlines()
            yield from (line.removeprefix("$ ") for line in lines if language != "console" or line.startswith("$ "))
    yield from _INDENTED.findall(_FENCED.sub("", text))


def words(command: str) -> list[str]:
    command = re.sub(r"^(?:[A-Z_]+=)?\$\((.*)\)$", r"\1", command)  # URL=$(...)
    command = command.partition(" | ")[0].removesuffix("&")
    split = shlex.split(command, comments=True)
    while split and (re.fullmatch(r"[A-Z_]+=.*", split[0]) or split[0] == "sudo"):
        split = split[3:] if split[0] == "sudo" else split[1:]  # sudo -u USER
    return split


def parsers(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    (action,) = (it for it in parser._actions if isinstance(it, argparse._SubParsersAction))
    return dict(action.choices)


@pytest.fixture(scope="module")
def command_line() -> argparse.ArgumentParser:
    return build_parser()


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_of_blocks_are_understood(page: Path, command_line: argparse.ArgumentParser) -> None:
    for command in block_commands(page.read_text(encoding="utf-8")):
        program, *arguments = words(command)
        if program == "lodestream":
            address = "http://127.0.0.1:8000/v1/surfaces/ID"
            command_line.parse_args([re.sub(r"^(\$?URL)$", address, argument) for argument in arguments])
        else:
            check_program(program, arguments)


@pytest.mark.parametrize("page", PAGES, ids=name)
def test_commands_in_the_text_exist(page: Path, command_line: argparse.ArgumentParser) -> None:
    known = parsers(command_line)
    for command in _INLINE.findall(" ".join(_FENCED.sub("", page.read_text(encoding="utf-8")).split())):
        program, *arguments = re.sub(r"^(?:[A-Z_]+=\S+ )*", "", command).split()
        if program != "lodestream":
            check_program(program, arguments)
        elif arguments and arguments[0][0] != "-":
            assert arguments[0] in known, command
            parser = known[arguments[0]]
            if any(isinstance(it, argparse._SubParsersAction) for it in parser._actions) and arguments[1:]:
                parser = parsers(parser)[arguments[1].strip(",")]
            options = {option for action in parser._actions for option in action.option_strings}
            assert {it.partition("=")[0].strip(",") for it in arguments if it.startswith("--")} <= options, command


def check_program(program: str, arguments: list[str]) -> None:
    """Check what a command names: targets of make, modules of this project, extras, files of docker."""
    line = " ".join([program, *arguments])
    if program == "make":
        targets = [it for it in arguments if "=" not in it and not it.startswith('"')]
        assert set(targets[:1]) <= _TARGETS, line
    elif program.startswith("python") and arguments[:1] == ["-m"]:
        package = arguments[1].split(".")[0]
        if package in ("benchmarks", "tests", "lodestream_client", "lodestream_server"):
            assert importlib.util.find_spec(arguments[1]) is not None, line
    elif program == "pip":
        for extras in re.findall(r"\[([\w,]+)\]", line):
            assert set(extras.split(",")) <= _EXTRAS, line
    elif program == "docker" and "-f" in arguments:
        assert (ROOT / arguments[arguments.index("-f") + 1]).is_file(), line


def test_every_block_is_run_by_a_test_or_there_is_a_reason() -> None:
    there = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        there |= {(name(page), language) for language, _ in _FENCED.findall(text)}
        if _INDENTED.search(_FENCED.sub("", text)):
            there.add((name(page), "indented"))
    told = {"text", "ini", "nginx", "yaml"}  # output, and files of other programs
    assert {it for it in there if it[1] not in told} == set(RUN)
    for (page_name, _), runs in RUN.items():
        for path in re.findall(r"(?:tests|client|docs)/[\w/.]*\w", runs):
            assert (ROOT / path).exists(), path
        if not runs.startswith("not run: "):
            stem = Path(page_name).name
            assert stem in (ROOT / runs).read_text(encoding="utf-8") or page_name == "docs/api.md", runs


def test_a_command_that_is_not_there_is_noticed(command_line: argparse.ArgumentParser) -> None:
    assert list(block_commands("```console\n$ URL=$(lodestream push a b) # x\noutput\n```\n\n    make demo\n")) == [
        "URL=$(lodestream push a b) # x",
        "make demo",
    ]
    assert words("LODESTREAM_TOKEN=x lodestream list URL & # all") == ["lodestream", "list", "URL", "&"]
    with pytest.raises(AssertionError):
        check_program("make", ["tea"])
    with pytest.raises(AssertionError):
        check_program("pip", ["install", "lodestream[tea]"])
