from __future__ import annotations

import inspect
import pickle
from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream import OptionError, Selection, Target, Tolerance


@pytest.mark.parametrize(
    ("text", "tolerance"),
    [
        ("0.5", Tolerance(0.5)),
        ("0.1%", Tolerance(1e-3, relative=True)),
        ("0", Tolerance(0.0)),
        (" 200 %", Tolerance(2.0, relative=True)),
        ("7e-2%", Tolerance(7e-4, relative=True)),
    ],
)
def test_an_error_is_in_the_unit_or_a_fraction(text: str, tolerance: Tolerance) -> None:
    assert Tolerance.parse(text) == tolerance
    assert tolerance.absolute(200.0) == tolerance.value * (200.0 if tolerance.relative else 1.0)


@given(value=st.floats(0, allow_infinity=False), relative=st.booleans())
def test_a_tolerance_is_the_one_that_its_text_says(value: float, relative: bool) -> None:
    tolerance = Tolerance(value, relative)
    assert Tolerance.parse(str(tolerance)) == tolerance
    text = f"{Decimal(value).scaleb(2):.40e}%" if relative else f" {value:.20e}"
    assert str(Tolerance.parse(text)) == str(tolerance)


@pytest.mark.parametrize(
    ("tolerance", "text"),
    [
        (Tolerance(0.5), "0.5"),
        (Tolerance(1e-3, relative=True), "0.1%"),
        (Tolerance(0.29, relative=True), "29%"),
        (Tolerance(0, relative=True), "0%"),
        (Tolerance(1e-12, relative=True), "1e-10%"),
        (Tolerance(2), "2.0"),
        (Tolerance(np.float64(0.25)), "0.25"),
    ],
)
def test_a_tolerance_has_one_spelling(tolerance: Tolerance, text: str) -> None:
    assert str(tolerance) == text


@pytest.mark.parametrize("text", ["", "%", "fine", "-1", "-1%", "nan", "nan%", "inf", "0.1%%", "1e%", "1e-3d", "1 m"])
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(OptionError, match="is not an error bound: write 0 or more"):
        Tolerance.parse(text)


@pytest.mark.parametrize(
    "limits",
    [
        {"level": -1},
        {"level": 1, "max_bytes": 100},
        {"level": 0, "seconds": 1.0},
        {"level": 0, "until_rms": Tolerance(1.0)},
        {"level": 0, "until_max": Tolerance(1.0)},
        {"max_bytes": 0},
        {"max_bytes": "3kB"},
        {"seconds": 0.0},
        {"seconds": float("nan")},
        {"order": "best"},
        {"level": "2"},
        {"level": 1.5},
        {"level": True},
        {"level": np.bool_(True)},
        {"region": (100, 220, 300, 460)},
        {"region": ((100, 220),)},
        {"region": ((0.5, 3), (0, 4))},
        {"first": 5},
        {"until_rms": {1: 0.5}},
        {"until_max": {("z",): 0.5, "z": 1}},
    ],
)
def test_targets_that_make_no_sense_are_refused(limits: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match="expected"):
        Target(**limits)


def test_a_level_may_be_the_integer_of_any_library() -> None:
    level = Target(level=np.int8(2)).level  # type: ignore[arg-type]
    assert level == 2
    assert type(level) is int


def test_a_target_without_limits_is_the_whole_surface() -> None:
    assert Target() == Target(order="quality")
    assert Target().level is None


@pytest.mark.parametrize("limit", [0.5, "0.5", Tolerance(0.5), np.float32(0.5)])
def test_an_error_is_a_number_a_text_or_a_tolerance(limit: Any) -> None:
    target = Target(until_rms=limit)
    assert target.until_rms == Tolerance(0.5)
    assert target == Target(until_rms=Tolerance(0.5))
    assert Target(until_max={"b": limit, "a": "2"}).channels == (("a", "max", 2.0), ("b", "max", 0.5))


def test_no_errors_of_channels_are_no_limit() -> None:
    assert Target(until_rms={}) == Target()
    assert Target(until_rms={}).channels == ()


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        ({"until_rms": {"a": "0.1%"}}, "an error of 'a' in its own unit, got 0.1%"),
        ({"until_rms": {"a": -1}}, "an error of 0 or more, got -1"),
        ({"until_rms": {"a": 1}, "until_max": 2}, "either an error of the whole surface or errors of channels"),
        ({"until_rms": {"a": 1}, "region": ((0, 1), (0, 1))}, "either errors of channels or a region"),
        ({"until_rms": {"a": 1}, "level": 2}, "either a level or other limits"),
        ({"until_rms": "much"}, "write 0 or more, such as 0.5"),
    ],
)
def test_errors_that_make_no_sense_are_refused(limits: dict[str, Any], expected: str) -> None:
    with pytest.raises(OptionError, match=expected):
        Target(**limits)


@pytest.mark.parametrize("names", [("speed", "kind"), ["speed", "kind"], "speed,kind", "speed, kind"])
def test_attributes_are_names_or_a_text_with_commas(names: Any) -> None:
    assert Target(attributes=names).attributes == ("speed", "kind")
    assert Selection(attributes=names).attributes == ("speed", "kind")
    with pytest.raises(OptionError, match="expected attributes as names or a text with commas, got int"):
        Target(attributes=3)  # type: ignore[arg-type]


def test_words_of_other_calls_are_answered_with_the_keyword() -> None:
    words: dict[str, Any]
    for word, keyword in (("rms", "until_rms=5"), ("max_error", "until_max=5"), ("bytes", "max_bytes=5")):
        words = {word: 5}
        with pytest.raises(OptionError, match=f"^expected {keyword}, got {word}=$"):
            Target(**words)
    with pytest.raises(TypeError, match="unexpected keyword argument 'zoom'"):
        Target(zoom=5)  # type: ignore[call-arg]
    assert "until_rms" in inspect.signature(Target).parameters
    assert pickle.loads(pickle.dumps(Target(until_rms=5))) == replace(Target(until_rms=3), until_rms=5)
