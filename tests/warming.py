"""Compiles the kernels once, before many processes of tests would each compile them: ``python -m tests.warming``.

Two processes do it at once. One begins with the coder, the other comes to it last and loads what is there by then.
"""

from __future__ import annotations

import multiprocessing
import sys

import numpy as np

from lodestream import decode, encode
from lodestream_server.worker import warm


def warm_coder() -> None:
    """Compile what surfaces of one level need, which no transform has a part in."""
    for points in (np.array([[0.0, 1.0], [2.5, 7.0]]), np.sqrt(np.arange(12.0)).reshape(2, 2, 3)):
        decode(encode(points))
        decode(encode(points, rms="1e-2d"))


def main() -> int:
    """Run both; 0, or not if one of them has failed."""
    beside = multiprocessing.get_context("spawn").Process(target=warm_coder)
    beside.start()
    warm()
    beside.join()
    return beside.exitcode or 0


if __name__ == "__main__":
    sys.exit(main())
