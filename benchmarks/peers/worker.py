"""One coder on one surface in a process of its own: ``python -m benchmarks.peers.worker SURFACE CODER OUT``."""

from __future__ import annotations

import os
import sys
from pathlib import Path

# Before numpy is loaded: every figure is of one core.
_THREADS = ("OMP_NUM", "OPENBLAS_NUM", "MKL_NUM", "OPJ_NUM", "LODESTREAM")
for _name in _THREADS:
    os.environ[f"{_name}_THREADS"] = "1"

from .registry import function_of  # noqa: E402 - see above
from .surfaces import specimen  # noqa: E402
from .trial import Trial  # noqa: E402


def main() -> None:
    """Write the rows as JSON."""
    name, peer, out = sys.argv[1:]
    run = function_of(peer)
    trial = Trial(specimen(name), Path(out))
    run(trial)
    trial.write()


if __name__ == "__main__":
    main()
