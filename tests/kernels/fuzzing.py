"""Kernels called with anything: ``python -m tests.kernels.fuzzing NAMES``; ``fuzz.c`` does it.

A case is a call: integers, and arrays of any length with any elements. It is one of those that `scenes` makes, or one
that reached new code, with changes. What a fault came of is kept in ``build/kernels/faults`` and made again by
``python -m tests.kernels.fuzzing --again FILE``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

from . import scenes
from .compiling import BUILD, KERNELS, SANITIZERS, compiled, sanitizing_compiler
from .declared import declarations

__all__ = ["FAULTS", "Fuzzed", "fuzz", "fuzz_all", "fuzzer", "seeds"]

FAULTS = BUILD / "faults"

#: Calls that hold more memory are no beginnings, and so many of a kernel are enough: the fuzzer keeps those that reach
#: new code.
_MOST_BYTES = 1 << 19
_MOST_CALLS = 400


@dataclass(frozen=True)
class Fuzzed:
    """What became of a kernel.

    Attributes
    ----------
    kernel : str
    cases, accepted : int
        Calls, and those of them that the kernel did not refuse.
    kept : int
        Cases that reached new code.
    seconds : float
    fault : str or None
        What the sanitizers said, and where the case is.
    """

    kernel: str
    cases: int
    accepted: int
    kept: int
    seconds: float
    fault: str | None

    def __str__(self) -> str:
        if self.fault is not None:
            return f"{self.kernel}: FAULT after {self.seconds:.1f} s\n{self.fault}"
        return (
            f"{self.kernel}: {self.cases:,} cases in {self.seconds:.0f} s, {self.accepted:,} of them not refused, "
            f"{self.kept:,} that reached new code"
        )


def fuzzer(
    compiler: str, kernels: Path = KERNELS, names: Collection[str] | None = None, folder: Path | None = None
) -> Path:
    """The program, compiled where it must be; parameters as `compiled` takes them."""
    return compiled(
        "fuzz",
        [compiler],
        ["-O2", "-g"],
        ["calls.c", "mutate.c", "fuzz.c"],
        kernel_flags=["-O1", *SANITIZERS, "-fsanitize-coverage=trace-pc,trace-cmp"],
        link_flags=SANITIZERS,
        kernels=kernels,
        names=names,
        folder=folder,
    )


def seeds() -> Path:
    """Recorded calls to begin with, recorded anew."""
    BUILD.mkdir(parents=True, exist_ok=True)
    path = BUILD / "seeds.calls"
    scenes.seeds(path, _MOST_BYTES, _MOST_CALLS)
    return path


def fuzz(program: Path, kernel: str, beginnings: Path, seconds: float, cases: int = 2**62, seed: int = 1) -> Fuzzed:
    """Fuzz one kernel, for so many seconds or cases, or until the first fault."""
    FAULTS.mkdir(parents=True, exist_ok=True)
    fault = FAULTS / f"{kernel}.{os.getpid()}.calls"
    started = time.monotonic()
    command = [str(program), kernel, str(seconds), str(cases), str(seed), str(beginnings), str(fault)]
    done = subprocess.run(command, capture_output=True, text=True, errors="replace")
    taken = time.monotonic() - started
    if done.returncode:
        words = [line for line in done.stderr.splitlines() if line.strip()][:30]
        where = f"made again by: python -m tests.kernels.fuzzing --again {fault}"
        return Fuzzed(kernel, 0, 0, 0, taken, "\n".join([*words, where if fault.exists() else "no case was kept"]))
    done_, accepted, kept, _ = map(int, done.stdout.split())
    return Fuzzed(kernel, done_, accepted, kept, taken, None)


def fuzz_all(
    names: Sequence[str], seconds: float, cases: int = 2**62, seed: int = 1, kept: Path | None = None
) -> list[Fuzzed]:
    """Fuzz several kernels, all together for so many seconds, as many at a time as there are processors.

    In the folder `kept` is noted which kernels had so many cases: they are not called again with the same folder.

    Raises
    ------
    RuntimeError
        Where there is no compiler that has sanitizers.
    """
    compiler = sanitizing_compiler()
    if compiler is None:
        raise RuntimeError("expected gcc or clang with sanitizers, found neither")
    program, beginnings = fuzzer(compiler), seeds()
    processors = min(os.cpu_count() or 1, len(names))
    each = seconds * processors / len(names)

    def work(name: str) -> Fuzzed:
        file = None if kept is None else kept / f"{name}.json"
        if file is not None and file.exists():
            return Fuzzed(**json.loads(file.read_text()))
        found = fuzz(program, name, beginnings, each, cases, seed)
        if file is not None and found.fault is None and found.cases >= cases:
            file.write_text(json.dumps(asdict(found)))
        return found

    with ThreadPoolExecutor(processors) as pool:
        return list(pool.map(work, names))


def main() -> int:
    """Fuzz some kernels, or make a fault again; 1 where there is a fault."""
    parser = argparse.ArgumentParser(prog="python -m tests.kernels.fuzzing", description=__doc__)
    parser.add_argument("kernel", nargs="*", help="all when none is named")
    parser.add_argument("--seconds", type=float, default=20.0, help="for each (default: 20)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--again", type=Path, metavar="FILE", help="make the calls of a file, and say what happens")
    args = parser.parse_args()
    compiler = sanitizing_compiler()
    if compiler is None:
        print("skipped: there is neither a gcc nor a clang with sanitizers")
        return 0
    if args.again is not None:
        command = [str(fuzzer(compiler)), "-", "0", "0", "0", str(args.again), os.devnull]
        return subprocess.run(command).returncode
    names = args.kernel or list(declarations())
    unknown = sorted(set(names) - declarations().keys())
    if unknown:
        parser.error(f"expected kernels of {', '.join(declarations())}, got {', '.join(unknown)}")
    processors = min(os.cpu_count() or 1, len(names))
    found = fuzz_all(names, args.seconds * len(names) / processors, seed=args.seed)
    print("\n".join(map(str, found)))
    return 1 if any(item.fault for item in found) else 0


if __name__ == "__main__":
    sys.exit(main())
