"""Reads files one after another, each in a process of its own under limits, and tells how each was refused.

``python -m tests.core.formats.refusals`` takes a JSON list of [path, options] on standard input and prints one JSON
object for each: the class of the error and its message, the greatest memory in bytes (libraries included) and the
processor's seconds. What they need is loaded before, so that its time does not count for any file.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

__all__ = ["Refusal", "refusals"]

#: Of a processor, which on a busy machine does less in each; what grows with the square of a file takes minutes.
SECONDS = 30
#: What a file may make a process take at most before the system refuses, so that a failing test harms nobody.
_MOST_MEMORY = 3 << 30


@dataclass(frozen=True)
class Refusal:
    """How a file was refused."""

    error: str
    message: str
    memory: int
    seconds: float


def refusals(cases: list[tuple[Path, dict[str, Any]]]) -> list[Refusal]:
    """Read each file in a process of its own; skips the test where processes cannot be forked and limited."""
    if sys.platform == "win32":
        pytest.skip("Windows neither forks processes nor limits them")
    done = subprocess.run(
        [sys.executable, "-m", __name__],
        input=json.dumps([[str(path), options] for path, options in cases]),
        cwd=Path(__file__).parents[3],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)},
        capture_output=True,
        text=True,
        check=True,
    )
    return [Refusal(**json.loads(line)) for line in done.stdout.splitlines()]


def _main() -> None:
    import lodestream.formats
    import lodestream.mesh.recognise  # noqa: F401

    cases = json.load(sys.stdin)
    if any(Path(path).suffix in (".nc", ".png", ".tif") for path, _ in cases):
        _load_libraries()
    for path, options in cases:
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(reading)
            os.write(writing, json.dumps(_read(path, options)).encode())
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading) as pipe:
            answer = pipe.read()
        _, status, usage = os.wait4(child, 0)
        found = json.loads(answer) if answer else {"error": f"ended with {status}", "message": ""}
        print(
            json.dumps(found | {"memory": usage.ru_maxrss * 1024, "seconds": usage.ru_utime + usage.ru_stime}),
            flush=True,
        )


def _load_libraries() -> None:
    import h5netcdf  # noqa: F401
    import PIL.PngImagePlugin  # noqa: F401
    import rasterio
    import scipy.io  # noqa: F401
    import xarray
    from xarray.backends import h5netcdf_, scipy_  # noqa: F401

    with rasterio.Env():
        pass
    xarray.Dataset()


def _read(path: str, options: dict[str, Any]) -> dict[str, str]:
    import resource
    import warnings

    from lodestream import formats

    resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
    resource.setrlimit(resource.RLIMIT_DATA, (_MOST_MEMORY, _MOST_MEMORY))
    warnings.simplefilter("ignore")
    try:
        surface = formats.read(path, **options)
    except Exception as error:
        return {"error": type(error).__name__, "message": str(error)[:400]}
    return {"error": "none", "message": repr(surface)}


if __name__ == "__main__":
    _main()
