"""One coder on one surface in a process of its own: ``python -m benchmarks.peers.worker SURFACE CODER OUT``."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

# Before numpy is loaded: every figure is of one core.
_THREADS = ("OMP", "OPENBLAS", "MKL", "OPJ")
for _name in _THREADS:
    os.environ[f"{_name}_NUM_THREADS"] = "1"

from .registry import function_of  # noqa: E402 - see above
from .surfaces import specimen  # noqa: E402
from .trial import Trial  # noqa: E402


def main() -> None:
    """Write the rows as JSON."""
    name, peer, out = sys.argv[1:]
    start = time.perf_counter()
    run = function_of(peer)
    trial = Trial(specimen(name))
    run(trial)
    result = {"rows": trial.rows, "notes": trial.notes, "seconds": time.perf_counter() - start}
    Path(out).write_text(json.dumps(result))


if __name__ == "__main__":
    main()
