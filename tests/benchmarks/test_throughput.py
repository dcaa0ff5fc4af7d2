"""What a worker tells of encoding and decoding."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lodestream
from benchmarks.throughput import _Work


@pytest.fixture
def path(tmp_path: Path) -> Path:
    found = tmp_path / "steps.npy"
    np.save(found, np.add.outer(np.arange(33) ** 2, np.arange(20)).astype(np.int16))
    return found


def test_a_worker_tells_how_large_its_results_are(path: Path) -> None:
    worker, points = _Work(path), np.load(path)
    encoded, decoded = worker.encode(), worker.decode()
    assert encoded["output"] == len(lodestream.encode(points))
    assert decoded["output"] == points.nbytes
    assert all(len(told["seconds"]) == 3 for told in (encoded, decoded))


def test_a_worker_decodes_what_another_process_encoded(path: Path) -> None:
    worker, points = _Work(path), np.load(path)
    worker.prepare()
    assert path.with_suffix(".lode").read_bytes() == lodestream.encode(points)
    assert worker.decode()["output"] == points.nbytes
