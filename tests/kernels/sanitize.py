"""``make sanitize``: the tests of kernels under AddressSanitizer and UndefinedBehaviorSanitizer, which of their lines
the tests run, whether faults that are planted are found, and each kernel called with anything for a while.

Needs gcc or clang; where neither is, it says so and that is all.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from lodestream.library import library_name

from .compiling import BUILD, COVERAGE, KERNELS, ROOT, SANITIZERS, compiled, preloaded, sanitizing_compiler
from .coverage import lines_run, told
from .declared import declarations
from .fuzzing import FAULTS, fuzz_all

__all__ = ["PLANTED_WANTED", "TESTS", "main", "run_tests"]

#: Tests that decode the golden files at every layer, their prefixes, and files with a bit flipped.
TESTS = ("tests/core/container/test_golden.py", "tests/core/entropy/test_mask.py", "tests/kernels/test_refusals.py")
#: With these they run every line of the kernels; that takes minutes more.
MORE_TESTS = tuple(
    f"tests/core/{folder}/test_{name}.py"
    for folder, names in (
        ("decoding", ("kernel_calls",)),
        ("encoding", ("single_error", "rate_distortion", "fill", "large_units")),
        ("entropy", ("bitplanes_kernel", "dequantize", "bitplanes")),
        ("formats", ("lzf",)),
        ("mesh", ("mesh_walks", "hostile_walks", "mesh_attributes")),
        ("quantization", ("distortion", "mesh_lattice")),
        ("residual", ("chunk_coder",)),
        ("transform", ("all_levels", "lifting", "pyramid")),
    )
    for name in names
)

#: Tests of these tools, which `make test` skips: what they compile takes a minute.
PLANTED = "tests/kernels/test_sanitizers.py"
PLANTED_WANTED = "LODESTREAM_SANITIZERS"

_SECONDS = 20.0


def main() -> int:
    """Do all of it; 1 where anything was found."""
    parser = argparse.ArgumentParser(prog="python -m tests.kernels.sanitize", description=__doc__)
    parser.add_argument(
        "--seconds", type=float, default=_SECONDS, help=f"of fuzzing, all kernels (default: {_SECONDS:g})"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the fuzzer (default: 1)")
    parser.add_argument(
        "--every-line", action="store_true", help="run more tests; fail where a line of C is run by none"
    )
    args = parser.parse_args()
    compiler = sanitizing_compiler()
    if compiler is None:
        print("sanitize: skipped, there is neither a gcc nor a clang with sanitizers")
        return 0
    started = time.monotonic()
    failed = _planted_are_missed()
    failed |= _tests(compiler, args.every_line)
    found = fuzz_all(list(declarations()), args.seconds, seed=args.seed)
    print("\n".join(map(str, found)))
    failed |= any(item.fault for item in found)
    print(f"sanitize: {'FAILED' if failed else 'no fault'}, {time.monotonic() - started:.0f} s")
    return int(failed)


def run_tests(compiler: str, library: Path, arguments: Sequence[str], reports: Path) -> list[str]:
    """Run tests with a library that was compiled with sanitizers.

    Parameters
    ----------
    compiler : "gcc" or "clang"
    library : Path
    arguments : sequence of str
        For pytest.
    reports : Path
        A folder for what the sanitizers say.

    Returns
    -------
    list of str
        What was wrong.
    """
    reports.mkdir(parents=True, exist_ok=True)
    for old in reports.glob("report.*"):
        old.unlink()
    environment = {
        **os.environ,
        "LD_PRELOAD": preloaded(compiler),
        "ASAN_OPTIONS": f"detect_leaks=0:allocator_may_return_null=1:log_path={reports}/report",
        "UBSAN_OPTIONS": f"print_stacktrace=1:log_path={reports}/report",
        "HYPOTHESIS_PROFILE": "sanitizers",
        "PYTHONMALLOC": "malloc",  # else Python's own allocator lies between an array and what stands beside it
        "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
    }
    command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.kernels.plugin", "--kernels", str(library)]
    done = subprocess.run([*command, *arguments], env=environment, cwd=ROOT)
    wrong = [f"pytest ended with {done.returncode}"] if done.returncode else []
    said = (report.read_text(errors="replace").splitlines() for report in sorted(reports.glob("report.*")))
    return [*wrong, *("\n".join(lines[:40]) for lines in said)]


def _planted_are_missed() -> bool:
    """Run the tests of these tools; whether one fails."""
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", PLANTED]
    return subprocess.run(command, env={**os.environ, PLANTED_WANTED: "1"}, cwd=ROOT).returncode != 0


def _tests(compiler: str, every_line: bool) -> bool:
    """Run all of them; whether anything was wrong, as lines that never ran are where every one is asked for."""
    counts = compiler == "gcc" and shutil.which("gcov") is not None
    flags = [*SANITIZERS, *(COVERAGE if counts else ["-O1"])]
    flags += ["-shared-libsan"] if compiler == "clang" else []
    beside = ["write_coverage.c"] if counts else []
    library = compiled(library_name(), [compiler], flags, beside, folder=BUILD / "sanitized")
    for old in library.parent.glob("*.gcda"):
        old.unlink()
    chosen = [*TESTS, *(MORE_TESTS if every_line else ())]
    # What a fault ends is not started again: pytest-xdist may then wait for ever.
    shared = ["-n", "2", "--dist", "loadfile", "--max-worker-restart", "0"]
    wrong = run_tests(compiler, library, [*shared, *chosen], FAULTS)
    print("\n".join(wrong))
    if counts:
        lines = lines_run(library.parent, KERNELS)
        print("\n".join(told(lines)))
        if every_line and any(file.missing for file in lines):
            wrong.append("lines that never ran")
    else:
        print("lines of C run by the tests: skipped, there is no gcc with gcov")
    return bool(wrong)


if __name__ == "__main__":
    sys.exit(main())
