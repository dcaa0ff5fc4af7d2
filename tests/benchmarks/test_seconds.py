"""How long a receiver waits: bytes over a link, and decoding."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import lodestream
from benchmarks.peers import ours
from benchmarks.peers.curves import Results
from benchmarks.peers.registry import OURS, old
from benchmarks.peers.seconds import arrival, beaten, choices, gates, moments, overlapped
from benchmarks.peers.waiting import waiting
from benchmarks.rate import layers_of


def _row(size: int, rms: float, seconds: float) -> dict[str, Any]:
    return {"bytes": size, "rms": rms, "max": 4 * rms, "decode_s": seconds, "encode_s": 1.0}


def _results(peers: dict[str, list[dict[str, Any]]], told: list[dict[str, Any]]) -> Results:
    runs: dict[str, Any] = {f"hill|{name}": {"rows": rows} for name, rows in peers.items()}
    runs[f"hill|{OURS}"] = {"rows": [], "moments": told}
    return Results({"surfaces": {"hill": {"group": "smooth"}}, "runs": runs})


def _told(target: float, size: int, seconds: float) -> dict[str, Any]:
    return {"target": target, "bytes": [size], "feed_s": [seconds], "picture_s": 0.0}


def test_a_slow_link_hides_all_decoding_but_that_of_the_last_layer() -> None:
    assert arrival([125, 250], [0.1, 0.2], 0.05, 1000.0) == pytest.approx(2.0 + 0.2 + 0.05)


def test_a_fast_link_waits_for_all_decoding() -> None:
    assert arrival([125, 250], [0.1, 0.2], 0.05, 1e12) == pytest.approx(0.35)


def test_overlapped_is_the_larger_of_both() -> None:
    assert overlapped([125, 250], [0.1, 0.2], 0.05, 1000.0) == 2.0
    assert overlapped([125, 250], [0.1, 0.2], 0.05, 1e12) == pytest.approx(0.35)


def test_streams_count_that_meet_the_error_and_what_lies_between_two() -> None:
    rows = [_row(100, 1e-2, 1.0), _row(10_000, 1e-4, 3.0), _row(20_000, 0.0, 2.0)]
    between = (pytest.approx(1000.0), pytest.approx(1.0 + 2.0 * 900 / 9900))
    assert choices(rows, 1e-3) == [(10_000, 3.0), (20_000, 2.0), between]
    assert choices(rows, 1e-5)[0] == (20_000, 2.0)
    assert choices(rows[:2], 1e-5) == []


def test_only_what_is_exact_is_exact() -> None:
    almost = _row(50, 0.0, 1.0) | {"max": 1e-12}
    assert choices([almost, _row(90, 0.0, 1.0)], 0.0) == [(90, 1.0)]


def test_each_link_has_its_own_best_peer() -> None:
    results = _results({"SZ3": [_row(1000, 0.0, 0.5)], "LERC": [_row(9000, 0.0, 0.001)]}, [_told(0.0, 1000, 0.01)])
    slow, *_, fast = moments(results)
    assert (slow.link, slow.peer) == (1e6, "LERC")
    assert slow.peer_seconds == pytest.approx(0.073)
    assert slow.ours == pytest.approx(0.018)
    assert fast.peer == "LERC"
    assert fast.peer_seconds == pytest.approx(0.001072)
    assert fast.ratio == pytest.approx(0.010008 / 0.001072)


def test_beaten_where_one_stream_is_smaller_and_faster() -> None:
    smaller, faster = _row(900, 0.0, 0.5), _row(9000, 0.0, 0.001)
    told = [_told(0.0, 1000, 0.01)]
    assert beaten(_results({"SZ3": [smaller], "LERC": [faster]}, told)) == ([], 1)
    lost, count = beaten(_results({"SZ3": [_row(900, 0.0, 0.005)]}, told))
    assert count == 1
    assert lost == ["hill, exact: SZ3, 0.90 of the bytes, 0.50 of the time"]


def test_coders_of_meshes_beat_nobody() -> None:
    assert beaten(_results({"meshoptimizer": [_row(900, 0.0, 0.005)]}, [_told(0.0, 1000, 0.01)])) == ([], 0)


def test_gates_name_each_link() -> None:
    results = _results({"SZ3": [_row(2000, 0.0, 0.02)]}, [_told(0.0, 1000, 0.01)])
    found = {gate.name: gate for gate in gates(results)}
    assert found["3. seconds at 1 Mbit/s over the best peer's, mean"].found == pytest.approx(0.018 / 0.036)
    assert all(gate.met for gate in found.values())


def test_the_page_says_so_where_nothing_was_measured() -> None:
    assert "Nothing was measured." in list(waiting(Results({"surfaces": {}, "runs": {}})))


def test_the_page_names_the_worst_cell() -> None:
    results = _results({"SZ3": [_row(2000, 0.0, 0.02)]}, [_told(0.0, 1000, 0.01)])
    line = next(line for line in waiting(results) if line.startswith("| 1 Mbit/s"))
    assert "hill, exact: 18.0 ms, SZ3 36.0 ms" in line
    assert line.endswith("| met |")


def test_moments_of_a_stream_end_where_its_layers_do() -> None:
    points = np.add.outer(np.arange(40) ** 2, np.arange(33)).astype(np.int16)
    container = lodestream.encode(points)
    marks = layers_of(container)
    told = ours.moments(container, marks, float(np.ptp(points)))
    assert told[-1]["target"] == 0.0
    assert told[-1]["bytes"] == [mark.bytes for mark in marks]
    for moment in told:
        assert len(moment["feed_s"]) == len(moment["bytes"])
        assert all(math.isfinite(seconds) for seconds in (*moment["feed_s"], moment["picture_s"]))


def test_versions_from_before_the_newest_are_old() -> None:
    assert old(["numpy 1.0", "imagecodecs 2026.3.6"]) == ["imagecodecs 2026.3.6"]
    assert old(["imagecodecs 2026.10.10"]) == []
    assert old(["imagecodecs not installed"]) == ["imagecodecs not installed"]
