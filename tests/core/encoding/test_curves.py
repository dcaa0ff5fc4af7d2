"""Slopes of coding passes beside plain Python, and curves that do not fit."""

from __future__ import annotations

from bisect import bisect_left
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.encoding.allocation import _worth
from lodestream.encoding.curves import Worth
from lodestream.grid.layout import Layout

from .test_allocation import curves_for, layouts
from .tile_curves import TileCurve, joined

Floats = NDArray[np.float64]


def plain_slopes(curve: TileCurve, worth: Worth | None) -> Floats:
    def least(slope: float) -> float:
        if worth is None:
            return 0.0
        place = min(bisect_left(worth.falling.tolist(), -slope), len(worth.known) - 1)
        return min(worth.most, worth.share * float(worth.known[place]))

    runs: list[tuple[float, float, int]] = []
    known = 0.0
    for bits, gain in zip(curve.bits[::-1].tolist(), curve.gains[::-1].tolist(), strict=True):
        run = (max(bits, 1e-9), max(gain, 0.0), 1)
        known += run[0]
        while runs:
            last = runs[-1]
            saved = last[1] * run[0] - run[1] * last[0]
            if saved > 0 and saved >= max(least(last[1] / last[0]), 0.02 * known) * (last[1] + run[1]):
                break
            runs.pop()
            run = (run[0] + last[0], run[1] + last[1], run[2] + last[2])
        runs.append(run)
    return np.array([gain / bits for bits, gain, passes in runs for _ in range(passes)][::-1])


def plain_lift(slopes: dict[tuple[int, int], Floats], layout: Layout) -> None:
    for (tile, channel), own in sorted(slopes.items(), reverse=True):
        parent = slopes.get((int(layout.parents[tile]), channel))
        if parent is None:
            continue
        for number in range(0, len(parent), 2):
            parent[number] = max(parent[number], float(own[number : number + 2].max(initial=0.0)))
        if len(parent) > len(own):
            parent[len(own) :] = np.maximum(parent[len(own) :], own.max())
        parent[:] = np.maximum.accumulate(parent)


@given(layouts, st.integers(1, 3), st.integers(0, 2**32), st.integers(1, 5))
def test_slopes_are_those_of_plain_python(layout: Layout, channels: int, seed: int, at_once: int) -> None:
    given_curves = curves_for(layout, channels, seed)
    curves = joined(given_curves)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lodestream.encoding.curves._AT_ONCE", at_once)
        bare = curves.slopes()
        assert bare.tolist() == [slope for curve in given_curves for slope in plain_slopes(curve, None).tolist()]
        worth = _worth(curves)
        slopes = curves.slopes(worth)
        expected = {(curve.tile, curve.channel): plain_slopes(curve, worth) for curve in given_curves}
        assert slopes.tolist() == [slope for own in expected.values() for slope in own.tolist()]
        curves.lift_parents(slopes, layout)
        plain_lift(expected, layout)
        assert slopes.tolist() == [slope for own in expected.values() for slope in own.tolist()]


def test_curves_come_in_any_number_and_length() -> None:
    lengths = [64, 1, 63, 0, 2]
    rng = np.random.default_rng(0)
    given_curves = [TileCurve(k, 0, rng.random(n), rng.random(n)) for k, n in enumerate(lengths)]
    curves = joined(given_curves)
    assert curves.ends.tolist() == [64, 65, 128, 128, 130]
    assert curves.bytes == pytest.approx(sum(curve.bits.sum() for curve in given_curves) / 8)
    assert curves.slopes().tolist() == [s for curve in given_curves for s in plain_slopes(curve, None).tolist()]


def arguments(**other: Any) -> tuple[Any, ...]:
    """Of `pass_slopes`, which fit, with others in their place."""
    own: dict[str, Any] = {
        "bits": np.ones(6),
        "gains": np.ones(6),
        "ends": np.array([2, 6]),
        "first": 0,
        "last": 2,
        "falling": np.zeros(3),
        "known": np.ones(3),
        "shares": (0.0, 0.0, 0.0),
        "slopes": np.empty(6),
    }
    own |= other
    return (*(own[name] for name in list(own)[:7]), *own["shares"], own["slopes"])


@pytest.mark.parametrize(
    "other",
    [
        {"gains": np.ones(5)},
        {"slopes": np.ones(7)},
        {"known": np.ones(2)},
        {"first": -1},
        {"last": 3},
        {"ends": np.array([2, 7])},
        {"ends": np.array([3, 2])},
        {"ends": np.array([-1, 2])},
        {"bits": np.ones(65), "gains": np.ones(65), "slopes": np.ones(65), "ends": np.array([0, 65])},
    ],
    ids=str,
)
def test_curves_that_do_not_fit_are_refused(other: dict[str, Any]) -> None:
    kernels.pass_slopes(*arguments())
    with pytest.raises(ValueError, match="lengths or places do not fit"):
        kernels.pass_slopes(*arguments(**other))


@pytest.mark.parametrize(
    ("ends", "parents", "last"),
    [
        ([2, 6], [-1, 1], 2),
        ([2, 6], [-1, 5], 2),
        ([2, 7], [-1, 0], 2),
        ([2, 6], [-1], 2),
        ([2, 6], [-1, 0], 3),
        ([3, 4, 2], [-1, 0, 0], 3),
    ],
)
def test_parents_that_do_not_fit_are_refused(ends: list[int], parents: list[int], last: int) -> None:
    kernels.lift_slopes(np.array([2, 6]), np.array([-1, 0]), 0, 2, np.ones(6))
    with pytest.raises(ValueError, match="lengths or places do not fit"):
        kernels.lift_slopes(np.array(ends), np.array(parents), 0, last, np.ones(6))
