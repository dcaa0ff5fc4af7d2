from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream import OptionError, Target, Tolerance


@pytest.mark.parametrize(
    ("text", "tolerance"),
    [
        ("0.5", Tolerance(0.5)),
        ("1e-3d", Tolerance(1e-3, relative=True)),
        ("0", Tolerance(0.0)),
        (" 2 d", Tolerance(2.0, relative=True)),
    ],
)
def test_an_error_is_in_the_unit_or_a_fraction(text: str, tolerance: Tolerance) -> None:
    assert Tolerance.parse(text) == tolerance
    assert tolerance.absolute(200.0) == tolerance.value * (200.0 if tolerance.relative else 1.0)


@given(value=st.floats(0, allow_infinity=False), relative=st.booleans())
def test_a_tolerance_is_the_one_that_its_text_says(value: float, relative: bool) -> None:
    tolerance = Tolerance(value, relative)
    assert Tolerance.parse(str(tolerance)) == tolerance
    assert str(Tolerance.parse(f" {value:.20e}{'d' if relative else ''}")) == str(tolerance)


@pytest.mark.parametrize(
    ("tolerance", "text"),
    [
        (Tolerance(0.5), "0.5"),
        (Tolerance(1e-3, relative=True), "0.001d"),
        (Tolerance(2), "2.0"),
        (Tolerance(np.float64(0.25)), "0.25"),
    ],
)
def test_a_tolerance_has_one_spelling(tolerance: Tolerance, text: str) -> None:
    assert str(tolerance) == text


@pytest.mark.parametrize("text", ["", "d", "fine", "-1", "nan", "inf", "1e-3dd", "1 m"])
def test_other_texts_are_refused(text: str) -> None:
    with pytest.raises(OptionError, match="expected"):
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
        {"seconds": 0.0},
        {"seconds": float("nan")},
        {"order": "best"},
    ],
)
def test_targets_that_make_no_sense_are_refused(limits: dict[str, Any]) -> None:
    with pytest.raises(OptionError, match="expected"):
        Target(**limits)


def test_a_target_without_limits_is_the_whole_surface() -> None:
    assert Target() == Target(order="quality")
    assert Target().level is None
