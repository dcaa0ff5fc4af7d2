"""How bytes of peers are counted, and which whole numbers they are given."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from benchmarks.peers.curves import Results, bytes_at, envelope
from benchmarks.peers.lattice import lattice_of
from benchmarks.peers.registry import OURS


def _row(size: int, rms: float, stream: str = "") -> dict[str, Any]:
    return {"bytes": size, "rms": rms, "max": 4 * rms, "stream": stream, "setting": "", "file": size}


def test_envelope_drops_rows_beaten_in_bytes_and_error() -> None:
    rows = [_row(100, 1e-2), _row(200, 2e-2), _row(400, 1e-3), _row(300, 1e-3)]
    assert envelope(rows, "rms") == [(100, 1e-2), (300, 1e-3)]


def test_bytes_between_settings_are_interpolated_in_log_log() -> None:
    rows = [_row(100, 1e-2), _row(10_000, 1e-4)]
    assert bytes_at(rows, "rms", 1e-3) == pytest.approx(1000)


def test_first_row_counts_whole_for_larger_errors() -> None:
    assert bytes_at([_row(100, 1e-2)], "rms", 1e-1) == 100


def test_error_below_the_last_lossy_row_costs_the_lossless_one() -> None:
    rows = [_row(100, 1e-2), _row(900, 0.0)]
    assert bytes_at(rows, "rms", 9e-3) == 900
    assert bytes_at(rows[:1], "rms", 9e-3) is None


def test_best_peer_is_compared_with_our_best_stream() -> None:
    runs = {
        f"hill|{OURS}": [_row(120, 1e-2, "exact"), _row(9000, 0.0, "exact"), _row(90, 1e-2, "precision")],
        "hill|SZ3": [_row(200, 1e-2), _row(8000, 0.0)],
        "hill|ZFP": [_row(150, 1e-2)],
    }
    results = Results({"surfaces": {"hill": {"group": "smooth"}}, "runs": {k: {"rows": r} for k, r in runs.items()}})
    coarse, *finer = results.cells(["hill"], "rms")
    assert (coarse.peer, coarse.peer_bytes, coarse.ours, coarse.exact) == ("ZFP", 150, 90, 120)
    assert [(cell.peer, cell.ours, cell.counts) for cell in finer] == [("SZ3", 9000, True)] * 3


@pytest.mark.parametrize(
    ("points", "step"),
    [
        (np.array([[3, 5], [7, 9]], np.int16), 1.0),
        (np.array([[0.25, 0.5], [1.0, 3.75]], np.float32), 0.25),
        (np.array([[0.1, 0.2], [0.3, 1.7]]), 0.1),
        (-10000 + 0.1 * np.array([[100123.0, 100124.0], [100999.0, 123456.0]]), 0.1),
    ],
)
def test_lattice_gives_every_value_back(points: np.ndarray[Any, Any], step: float) -> None:
    lattice = lattice_of(points)
    assert lattice is not None
    assert lattice.step == pytest.approx(step)
    assert lattice.numbers.min() == 0
    restored = lattice.points(lattice.numbers)
    assert restored.dtype == points.dtype
    assert np.array_equal(restored.reshape(points.shape), points)


def test_values_on_no_lattice_have_none() -> None:
    assert lattice_of(np.array([[math.pi, math.e], [1e-9, 1e9]])) is None
