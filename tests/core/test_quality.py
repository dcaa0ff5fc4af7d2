from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream import OptionError, Quality, Tolerance

TOLERANCES = st.builds(Tolerance, st.floats(0, allow_infinity=False), st.booleans())
#: Names with equals signs, and the empty one, too.
ATTRIBUTES = st.dictionaries(st.text("ab=; \n", max_size=4), TOLERANCES, max_size=3)


@given(points=st.none() | TOLERANCES, rms=st.none() | TOLERANCES, attributes=ATTRIBUTES)
def test_a_quality_is_the_one_that_its_texts_say(
    points: Tolerance | None, rms: Tolerance | None, attributes: dict[str, Tolerance]
) -> None:
    if points is not None and rms is not None:
        rms = None
    quality = Quality(precision=points, rms=rms, attributes=attributes)
    precisions, error = quality.texts()
    assert Quality.parse(precisions, error) == quality
    assert pickle.loads(pickle.dumps(quality)) == quality
    assert hash(Quality.parse(precisions, error)) == hash(quality)


def test_numbers_and_texts_are_a_shorthand() -> None:
    assert Quality.of(np.float64(0.5), attributes={"heat": "0.1%"}) == Quality(
        precision=Tolerance(0.5), attributes={"heat": Tolerance(1e-3, relative=True)}
    )
    assert Quality.of(rms=2) == Quality(rms=Tolerance(2.0))
    assert Quality.of() == Quality() == Quality.parse()


@pytest.mark.parametrize(
    ("precisions", "rms", "words"),
    [
        (["1", "2"], None, "the precision of the points is given twice"),
        (["a=1", "a=2"], None, "the precision of 'a' is given twice"),
        (["1"], "1", "not both"),
        (["a"], None, "precision: 'a' is not an error bound"),
        (["a=b"], None, "precision: 'b' is not an error bound"),
        ([], "fine", "rms: 'fine' is not an error bound"),
        ([""], None, "precision: '' is not an error bound"),
    ],
)
def test_texts_that_contradict_each_other_are_refused(precisions: list[str], rms: str | None, words: str) -> None:
    with pytest.raises(OptionError, match=words):
        Quality.parse(precisions, rms)


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (-1.0, "an error of 0 or more, got -1"),
        ("nan", "'nan' is not an error bound"),
        (float("inf"), "an error of 0 or more, got inf"),
        ([1], "expected a number such as 0.5"),
        ("1 m", "'1 m' is not an error bound"),
    ],
)
@pytest.mark.parametrize("place", ["precision", "rms", "attributes"])
def test_what_is_no_error_is_refused(place: str, error: Any, words: str) -> None:
    asked: dict[str, Any] = {place: {"a": error} if place == "attributes" else error}
    with pytest.raises(OptionError, match=words):
        Quality.of(**asked)


def test_the_encoder_takes_a_quality_or_its_shorthand() -> None:
    heights = np.cumsum(np.random.default_rng(3).normal(size=(20, 30)), axis=0)
    surface = ls.Surface(heights, attributes={"heat": heights[::-1]})
    quality = Quality.of("1%", attributes={"heat": 0.1})
    short = ls.encode(surface, "1%", attribute_precision={"heat": 0.1})
    assert ls.encode(surface, quality=quality) == short
    assert ls.encode(heights, quality=Quality.of(rms=0.1)) == ls.encode(heights, rms=0.1)
    for more in ({"precision": 1.0}, {"rms": 1.0}, {"attribute_precision": {"heat": 0.1}}):
        with pytest.raises(OptionError, match="either a quality or"):
            ls.encode(surface, quality=quality, **more)
