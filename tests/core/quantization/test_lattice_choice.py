from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.errors import InputError
from lodestream.quantization.lattice_choice import channel_of, choose_lattices
from lodestream.quantization.measure import distances


def through(points: NDArray[Any], precision: float | None) -> NDArray[Any]:
    """What the lattices alone keep of the points."""
    geometric = 1 if points.ndim == 2 else min(points.shape[2], 3)
    kept = np.empty_like(points)
    for number, lattice in enumerate(choose_lattices(points, geometric, precision)):
        values = channel_of(points, number)
        channel_of(kept, number)[...] = lattice.values(lattice.coordinates(values), points.dtype)
    return kept


def largest_error(points: NDArray[Any], precision: float) -> float | None:
    """In exact integers where the points are integers; None where the precision is refused."""
    try:
        kept = through(points, precision)
    except InputError:
        return None
    if points.dtype.kind in "iu" and points.ndim == 2:
        return float(max(abs(int(a) - int(b)) for a, b in zip(points.ravel(), kept.ravel(), strict=True)))
    return distances(points, kept, 1 if points.ndim == 2 else min(points.shape[2], 3))[1]


@given(
    scale=st.sampled_from([1e-30, 1e-6, 1.0, 1e5, 1e30]),
    offset=st.sampled_from([0.0, 1.0, -1000.0]),
    relative=st.floats(1e-6, 2.0),
    channels=st.sampled_from([0, 2, 3, 5]),
    dtype=st.sampled_from(["float32", "float64"]),
    seed=st.integers(0, 2**32),
)
def test_the_precision_is_never_exceeded(
    scale: float, offset: float, relative: float, channels: int, dtype: str, seed: int
) -> None:
    shape = (5, 6, channels) if channels else (5, 6)
    points = (scale * (offset + np.random.default_rng(seed).normal(size=shape))).astype(dtype)
    precision = scale * relative
    error = largest_error(points, precision)
    assert (dtype == "float32" or relative < 1e-5) if error is None else error <= precision


@given(
    dtype=st.sampled_from(["int8", "uint8", "int16", "int32", "uint32", "int64", "uint64"]),
    precision=st.one_of(st.floats(0.1, 100), st.floats(1, 1e18)),
    centre=st.sampled_from([0.0, 0.4, 1.0]),
    span=st.integers(1, 2**50),
    seed=st.integers(0, 2**32),
)
def test_the_precision_of_integers_is_never_exceeded(
    dtype: str, precision: float, centre: float, span: int, seed: int
) -> None:
    limits = np.iinfo(dtype)
    rng = np.random.default_rng(seed)
    low = limits.min + int(centre * (int(limits.max) - int(limits.min)))
    values = [min(max(low + int(rng.integers(-span, span)), limits.min), limits.max) for _ in range(12)]
    points = np.array(values, dtype).reshape(3, 4)
    error = largest_error(points, precision)
    if error is None:
        assert span > 2**22 * precision or abs(low) + span >= 2**53
    else:
        assert error <= precision


def test_without_a_precision_coordinates_share_a_step() -> None:
    points = np.random.default_rng(0).normal(size=(9, 9, 4)) * [1, 100, 1, 1e6]
    lattices = choose_lattices(points, 3, None)
    assert lattices[0].step == lattices[1].step == lattices[2].step == pytest.approx(np.ptp(points[..., 1]) / 2**20)
    assert lattices[3].step == pytest.approx(np.ptp(points[..., 3]) / 2**20)


def test_a_channel_s_own_lattice_is_kept_unless_the_precision_allows_less() -> None:
    points = np.arange(30.0).reshape(5, 6) * 0.25
    assert choose_lattices(points, 1, None)[0].step == 0.25
    assert choose_lattices(points, 1, 0.1)[0].step == 0.25
    assert choose_lattices(points, 1, 0.5)[0].step == pytest.approx(1.0)
    integers = np.arange(30).reshape(5, 6)
    assert [choose_lattices(integers, 1, p)[0].step for p in (None, 0.3, 1.0, 2.9)] == [1.0, 1.0, 3.0, 5.0]


@pytest.mark.parametrize("precision", [0.0, -1.0, float("nan"), float("inf"), 1e-20])
def test_a_precision_that_cannot_be_kept_is_refused(precision: float) -> None:
    with pytest.raises(InputError, match="expected a precision"):
        choose_lattices(np.random.default_rng(0).normal(size=(5, 5)), 1, precision)


def test_integers_over_more_steps_than_a_lattice_has_are_refused_with_a_precision() -> None:
    points = np.array([[-(2**31), 2**31 - 1], [5, 6]], np.int32)
    with pytest.raises(InputError, match="expected a precision of at least"):
        choose_lattices(points, 1, 1.0)
    large = np.array([[2**62, 2**62 + 1000]])
    with pytest.raises(InputError, match="expected a precision above"):
        choose_lattices(large, 1, 1.0)


def test_values_whose_sums_overflow_are_refused() -> None:
    with pytest.raises(InputError, match="magnitude"):
        choose_lattices(np.array([[1.7e308, -1.7e308]]), 1, None)
