"""Aims that are met or missed."""

from __future__ import annotations

import math

import pytest

from benchmarks import measure


@pytest.fixture(autouse=True)
def _none_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "_gates", [])


def test_a_figure_at_its_aim_meets_it() -> None:
    assert measure.gate("speed", 4.0, at_least=4.0) == "met"
    assert measure.gate("time", 10.0, at_most=10.0) == "met"


def test_a_figure_on_the_wrong_side_misses() -> None:
    assert measure.gate("speed", 3.9, at_least=4.0) == "missed"
    assert measure.gate("time", 10.1, at_most=10.0) == "missed"


def test_what_was_not_measured_misses() -> None:
    assert measure.gate("ratio", math.nan, at_least=1.0) == "missed"
    assert measure.gate("ratio", math.nan, at_most=1.0) == "missed"


def test_a_gate_has_one_aim() -> None:
    with pytest.raises(ValueError, match="one aim"):
        measure.gate("ratio", 1.0)
    with pytest.raises(ValueError, match="one aim"):
        measure.gate("ratio", 1.0, at_least=1.0, at_most=2.0)


def test_all_gates_stand_in_one_table(capsys: pytest.CaptureFixture[str]) -> None:
    measure.gate("encode", 2.5, at_least=4.0)
    measure.gate("prefix", 8.0, at_most=10.0, unit=" ms")
    measure.gates()
    lines = capsys.readouterr().out.splitlines()
    assert [cell.strip() for cell in lines[-2].split("|")] == ["", "encode", "2.5", "at least 4", "missed", ""]
    assert [cell.strip() for cell in lines[-1].split("|")] == ["", "prefix", "8 ms", "at most 10 ms", "met", ""]


def test_nothing_is_printed_without_gates(capsys: pytest.CaptureFixture[str]) -> None:
    measure.gates()
    assert not capsys.readouterr().out
