"""The tools that look for faults find those that are planted, and none where there is none.

``make sanitize`` runs this, with LODESTREAM_SANITIZERS: `make test` compiles nothing with sanitizers.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lodestream.library import library_name

from .compiling import COVERAGE, SANITIZERS, compiled, sanitizing_compiler
from .conftest import NAMES, Sources
from .coverage import lines_run, told
from .fuzzing import Fuzzed, fuzz, fuzzer
from .sanitize import PLANTED_WANTED, run_tests

if not os.environ.get(PLANTED_WANTED):
    pytest.skip(f"make sanitize runs this ({PLANTED_WANTED} is not set)", allow_module_level=True)

COMPILER = sanitizing_compiler() or ""

pytestmark = pytest.mark.skipif(not COMPILER, reason="there is neither a gcc nor a clang with sanitizers")

READ = "(coder->place < coder->size ? coder->data[coder->place] : 0);\n        } else"

#: A file, what it says, what it is to say, and words of what is then said of it.
FAULTS = {
    "a read past the end": ("binary_coder.h", READ, READ.replace("<", "<=", 1), "heap-buffer-overflow"),
    "a length that is not checked": ("mask.c", "last > rows * groups_across(columns) ||", "", "heap-buffer-overflow"),
    "a shift of a negative number": ("mask.c", "above = 0,", "above = -1,", "left shift of negative value"),
    "a loop without end": ("binary_coder.h", "coder->width >= NARROWEST && ", "", "longer than two seconds"),
}


def fuzzed(sources: Sources, masks: Path, seconds: float, cases: int = 2**62) -> Fuzzed:
    program = fuzzer(COMPILER, sources.folder, NAMES, sources.folder.parent / "fuzz")
    return fuzz(program, "mask", masks, seconds, cases)


@pytest.mark.parametrize("fault", FAULTS)
def test_the_fuzzer_finds_what_is_planted(sources: Sources, masks: Path, fault: str) -> None:
    file, right, wrong, words = FAULTS[fault]
    sources.plant(file, right, wrong)
    found = fuzzed(sources, masks, 240).fault or ""
    assert words in found
    assert "made again by" in found


def test_the_fuzzer_finds_nothing_where_there_is_nothing(sources: Sources, masks: Path) -> None:
    found = fuzzed(sources, masks, 60, 500)
    assert found.fault is None
    assert 500 <= found.cases < 600
    assert 0 < found.accepted < found.cases
    assert found.kept > 8


def library_of(sources: Sources) -> Path:
    flags, beside, folder = [*SANITIZERS, *COVERAGE], ["write_coverage.c"], sources.folder.parent / "library"
    return compiled(library_name(), [COMPILER], flags, beside, kernels=sources.folder, folder=folder)


@pytest.mark.skipif(COMPILER != "gcc", reason="there is no gcc")
def test_a_fault_in_the_library_fails_the_tests_that_reach_it(sources: Sources, tmp_path: Path) -> None:
    arguments = ["tests/core/entropy/test_mask.py", "-k", "missing_bytes", "-n0"]
    reports = tmp_path / "reports"
    assert run_tests(COMPILER, library_of(sources), arguments, reports) == []
    lines = {file.file: file for file in lines_run(sources.folder.parent / "library", sources.folder)}
    refused = 1 + next(
        number
        for number, line in enumerate((sources.folder / "mask.c").read_text().splitlines())
        if "return LODE_REFUSED" in line
    )
    assert refused in lines["mask.c"].missing
    assert 1 < len(lines["mask.c"].missing) < 20 < lines["mask.c"].count
    assert f"mask.c: never run: {lines['mask.c'].missing[0]}" in told(list(lines.values()))[-2]
    file, right, wrong, words = FAULTS["a read past the end"]
    sources.plant(file, right, wrong)
    found = "\n".join(run_tests(COMPILER, library_of(sources), arguments, reports))
    assert words in found
    assert "binary_coder.h" in found
