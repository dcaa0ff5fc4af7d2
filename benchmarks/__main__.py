"""Run the benchmarks: all of them, or those named, in this order."""

from __future__ import annotations

import argparse
import importlib
import os
import platform
import sys
from importlib.metadata import version

SECTIONS = (
    "start",
    "transform",
    "solver",
    "rate",
    "windows",
    "effort",
    "coder",
    "throughput",
    "prefix",
    "seconds",
    "memory",
    "meshes",
    "blocks",
    "formats",
    "patches",
    "tiles",
    "stream",
)

#: Sections that take long: only when they are named.
LONG = ("scale", "scale_blocks", "small", "remeshing", "pixels", "stops", "map_bytes", "bucket")

# Before numpy is loaded: every figure is of one core, but where another number of threads is named.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LODESTREAM_THREADS"):
    os.environ[_variable] = "1"

import lodestream  # noqa: E402 - see above

from .measure import gates  # noqa: E402


def processor() -> str:
    """The processor's name where the system tells it."""
    try:
        with open("/proc/cpuinfo") as lines:
            return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def main() -> int:
    """Print the tables of each section, and then all gates."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument(
        "section", nargs="*", help=f"of {', '.join(SECTIONS)}; all of these when none is named; or {', '.join(LONG)}"
    )
    chosen = parser.parse_args().section
    unknown = sorted(set(chosen) - {*SECTIONS, *LONG})
    if unknown:
        parser.error(f"expected sections of {', '.join(SECTIONS)}, got {', '.join(unknown)}")
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "pywavelets"))
    print(f"Lodestream {lodestream.__version__}, Python {platform.python_version()}, {packages}")
    print(f"one core of {processor()}", flush=True)
    for section in (*SECTIONS, *LONG):
        if section in chosen or (not chosen and section in SECTIONS):
            importlib.import_module(f"benchmarks.{section}").main()
    gates()
    return 0


if __name__ == "__main__":
    sys.exit(main())
