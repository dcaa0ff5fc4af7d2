"""Containers to measure decoding with; ``python -m tests.web.bench FOLDER REPEATS`` writes them and times this library.

Prints JSON: of each file points, and the least seconds of processor and clock of decoding it.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import lodestream as ls
from tests.core.surfaces import terrain

_SIDE = 1025


def surfaces() -> dict[str, tuple[Any, dict[str, Any]]]:
    """Points and options of encoding: integers on a lattice, floats with exactness, x, y, z, and one error."""
    heights = terrain((_SIDE, _SIDE), 7)
    rows, columns = np.mgrid[:_SIDE, :_SIDE].astype(np.float64)
    around = np.stack([columns + heights / 50, rows - heights / 70, heights], axis=2)
    return {
        "int16": (np.rint(heights).astype(np.int16), {}),
        "float32": ((heights / 3).astype(np.float32), {}),
        "xyz-float32": (around.astype(np.float32), {}),
        "xyz-rms": (around.astype(np.float32), {"rms": "0.01%"}),
    }


def main(folder: Path, repeats: int) -> None:
    """Write, decode, print."""
    told = {}
    for name, (points, options) in surfaces().items():
        container = ls.encode(points, **options)
        (folder / name).write_bytes(container)
        processor, clock = [], []
        for _ in range(repeats):
            started, used = time.perf_counter(), time.process_time()
            ls.decode(container)
            processor.append(time.process_time() - used)
            clock.append(time.perf_counter() - started)
        told[name] = {"points": _SIDE * _SIDE, "processor": min(processor), "clock": min(clock)}
    print(json.dumps(told))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
