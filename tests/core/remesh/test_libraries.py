"""The libraries of remeshing keep to the threads that there are."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("igl")

#: In a process of its own: igl asks once how many threads it may begin.
_PROGRAM = """
import os
import resource

import numpy as np

from lodestream.remesh.libraries import igl

tree = igl().AABB()
corners, faces = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
tree.init(corners, faces)
resource.setrlimit(resource.RLIMIT_NPROC, (0, 0))
os.setuid(65534)
print(len(tree.squared_distance(corners, faces, np.ones((50_000, 3)))))
"""


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="takes processes from another user")
def test_a_process_that_may_begin_no_thread_finds_closest_points() -> None:
    root = Path(__file__).parents[3]
    environment = {**os.environ, "LODESTREAM_THREADS": "1", "PYTHONPATH": str(root / "core")}
    ended = subprocess.run(
        [sys.executable, "-c", _PROGRAM], capture_output=True, text=True, env=environment, check=False
    )
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.strip() == "3"
