from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.quantization.distortion import store_values
from lodestream.quantization.lattice import (
    LATTICE_BITS,
    Lattice,
    find_lattice,
    offset_lattice,
    precision_lattice,
    to_dtype,
)
from tests.examples import examples

INTEGERS = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"]


def whole(largest: int, size: int = 500, seed: int = 0) -> NDArray[np.int64]:
    values = np.random.default_rng(seed).integers(-largest, largest, size, endpoint=True)
    values[:2] = -largest, largest
    return values


def assert_restores(lattice: Lattice | None, values: NDArray[Any]) -> None:
    assert lattice is not None
    q = lattice.coordinates(values)
    assert q.dtype == np.int32
    assert np.abs(q.astype(np.int64)).max() < 2**LATTICE_BITS
    restored = lattice.values(q, values.dtype)
    assert restored.dtype == values.dtype
    np.testing.assert_array_equal(restored, values)


@pytest.mark.parametrize("dtype", INTEGERS)
def test_integers_of_every_type_lie_on_a_lattice(dtype: str) -> None:
    limits = np.iinfo(dtype)
    low, high = max(limits.min, -(2**22)), min(limits.max, 2**22)
    values = np.random.default_rng(1).integers(low, high, (20, 30), np.int64, endpoint=True).astype(dtype)
    values[0, :2] = low, high
    assert_restores(find_lattice(values), values)


@pytest.mark.parametrize("offset", [0, 7, -(2**40), 2**52])
@pytest.mark.parametrize("step", [1, 3, 100, 2**20])
def test_integers_with_a_common_step_take_it(step: int, offset: int) -> None:
    values = whole(2**10) * step + offset
    lattice = find_lattice(values)
    assert_restores(lattice, values)
    assert lattice is not None
    assert lattice.step % step == 0


def test_integers_too_many_or_too_large_have_no_lattice() -> None:
    assert find_lattice(np.array([0, 1, 2**24 + 1])) is None
    assert find_lattice(np.array([2**53 + 1, 2**53 + 2])) is None
    assert find_lattice(np.array([-(2**63), 2**63 - 1])) is None
    assert find_lattice(np.array([0, 2**64 - 1], np.uint64)) is None


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("places", range(1, 10))
def test_decimals_of_one_to_nine_places_lie_on_a_lattice(places: int, dtype: str) -> None:
    for offset in (0, 10**places, -3 * 10 ** (places - 1)):
        values = ((whole(2**14) + offset) / 10.0**places).astype(dtype)
        lattice = find_lattice(values)
        assert_restores(lattice, values)


def test_decimals_use_the_fewest_places() -> None:
    values = np.round(np.random.default_rng(2).uniform(-500, 9000, 5000), 2)
    lattice = find_lattice(values)
    assert lattice is not None
    assert (lattice.rule, lattice.step) == ("decimal", 100.0)
    assert lattice.origin == pytest.approx(425000, abs=1000)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("exponent", [-120, -30, -3, 0, 5, 90])
def test_scaled_powers_of_two_lie_on_a_lattice(exponent: int, dtype: str) -> None:
    for steps, offset in ((2**23 - 1, 0), (1000, 2**23), (1, 0)):
        values = np.ldexp((whole(steps) + offset).astype(np.float64), exponent).astype(dtype)
        assert_restores(find_lattice(values), values)


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 0.1, 1 / 3, 1e8, 1e30])
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_found_lattice_restores_every_value_at_any_scale(scale: float, dtype: str) -> None:
    for values in (
        (whole(2**12) * scale).astype(dtype),
        (np.random.default_rng(3).normal(size=300) * scale).astype(dtype),
        np.full(9, scale, dtype),
        np.array([0, scale, -scale], dtype),
    ):
        lattice = find_lattice(values)
        if lattice is not None:
            assert_restores(lattice, values)
        if np.ptp(values) == 0:
            assert lattice is not None


@given(
    step=st.sampled_from([1.0, 0.5, 2.0**-40, 2.0**30, 0.1, 0.01, 1e-9, 3.0, 1 / 3]),
    offset=st.integers(-(2**30), 2**30),
    largest=st.integers(0, 2**23),
    dtype=st.sampled_from(["float32", "float64"]),
    seed=st.integers(0, 2**32),
)
def test_no_found_lattice_ever_loses_anything(step: float, offset: int, largest: int, dtype: str, seed: int) -> None:
    values = ((whole(largest, 40, seed) + offset) * step).astype(dtype)
    lattice = find_lattice(values)
    if lattice is not None:
        assert_restores(lattice, values)
    else:
        assert np.ptp(values) > 0


def test_values_that_the_sample_misses_count() -> None:
    for spike in (1.5, 0.1, np.pi):
        values = np.zeros(10000)
        values[1] = spike
        lattice = find_lattice(values)
        if lattice is not None:
            assert_restores(lattice, values)
        assert (lattice is None) == (spike == np.pi)


@pytest.mark.parametrize(
    "values",
    [
        np.array([5e-324, 0.0]),
        np.array([5e-324, 1.0]),
        np.array([5e-324, -5e-324, 1e-310]),
        np.array([1.7e308, -1.7e308]),
        np.array([3.4028235e38, -3.4028235e38], np.float32),
        np.array([1e-45, 1e-40], np.float32),
    ],
)
def test_subnormals_and_extremes_are_restored_or_left_to_residual(values: NDArray[Any]) -> None:
    lattice = find_lattice(values)
    if lattice is not None:
        with np.errstate(over="ignore"):
            assert_restores(lattice, values)
    assert lattice is None or np.isfinite(lattice.step)


@given(
    low=st.floats(-1e30, 1e30),
    span=st.floats(0, 1e30),
    steps=st.floats(1, 1e12),
    seed=st.integers(0, 2**32),
)
def test_a_lattice_of_some_precision_spans_all_values(low: float, span: float, steps: float, seed: int) -> None:
    values = low + span * np.random.default_rng(seed).random(30)
    lattice = precision_lattice(float(values.min()), float(values.max()), span / steps)
    q = lattice.coordinates(values)
    assert np.abs(q.astype(np.int64)).max() <= 2 ** (LATTICE_BITS - 1)
    error = np.abs(lattice.values(q, values.dtype) - values).max()
    assert error <= lattice.step / 2 * (1 + 1e-9) + 4 * np.spacing(np.abs(values).max())


@pytest.mark.parametrize("dtype", INTEGERS)
def test_integers_are_rounded_and_clipped_to_their_range(dtype: str) -> None:
    limits = np.iinfo(dtype)
    values = to_dtype(np.array([-1e30, -0.6, 0.4, 0.6, 99.5, 1e30]), np.dtype(dtype))
    expected = [limits.min, max(-1, limits.min), 0, 1, 100, limits.max]
    np.testing.assert_array_equal(values, np.array(expected, dtype))
    for edge in (limits.min, limits.max):
        near = to_dtype(np.array([float(edge)]), np.dtype(dtype))
        assert near.dtype == dtype
        assert int(near[0]) == edge


def test_float32_reconstructions_that_overshoot_stay_finite() -> None:
    values = to_dtype(np.array([1e39, -1e39, 3.4028235e38]), np.dtype(np.float32))
    largest = np.finfo(np.float32).max
    np.testing.assert_array_equal(values, np.array([largest, -largest, largest], np.float32))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("origin", [0.0, -10000.0])
def test_values_computed_from_coded_integers_are_found(dtype: type[np.floating[Any]], origin: float) -> None:
    codes = np.random.default_rng(3).integers(100_000, 137_000, 5000)
    values = (origin + 0.1 * codes).astype(dtype)
    lattice = find_lattice(values)
    assert lattice is not None
    assert lattice.values(lattice.coordinates(values), values.dtype).tobytes() == values.tobytes()


@pytest.mark.parametrize("dtype", ["float32", "float64", "int16"])
def test_noise_has_no_lattice_with_offsets(dtype: str) -> None:
    values = (100 * np.random.default_rng(7).normal(size=(60, 80))).astype(dtype)
    assert offset_lattice(values) is None


def test_lattices_with_offsets_are_found_at_any_scale() -> None:
    rng = np.random.default_rng(8)
    steps = np.cumsum(rng.integers(-9, 10, (64, 64)), 1)
    offsets = np.repeat(np.repeat(rng.random((8, 8)), 8, 0), 8, 1)
    for step in (1e-9, 0.005, 0.3048, 1.2345, 1e7):
        lattice = offset_lattice(((steps + offsets) * step).astype(np.float32))
        assert lattice is not None
        assert lattice.step == pytest.approx(step, rel=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (5, 1), (3, 3)])
def test_small_and_flat_surfaces_have_no_lattice_with_offsets(shape: tuple[int, int]) -> None:
    assert offset_lattice(np.zeros(shape, np.float32)) is None


@examples(20)
@given(
    seed=st.integers(0, 2**32 - 1),
    step=st.sampled_from([1.0, 0.025, 0.3048, 7.3, 1 / 3]),
    spread=st.sampled_from([1.0, 5.0, 80.0]),
    away=st.sampled_from([0.0, 1e-6, 0.01, 0.3]),
    smooth=st.booleans(),
)
def test_no_step_is_left_out_that_divides_most_differences(
    seed: int, step: float, spread: float, away: float, smooth: bool
) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.normal(0, spread, (30, 40))
    steps = np.rint(steps.cumsum(axis=1) if smooth else steps) + rng.uniform(0, 1, (30, 1))
    # Some lie off the lattice, so that from most to few of the differences are its steps.
    steps += away * rng.normal(size=steps.shape) * (rng.random(steps.shape) < rng.uniform(0, 1))
    values = (steps * step).astype(np.float32)
    assert offset_lattice(values) == with_every_step(values)


def with_every_step(values: NDArray[np.float32]) -> Lattice | None:
    """`offset_lattice` of a small array, without leaving anything out."""
    low, high = float(values.min()), float(values.max())
    rows = values[:: min(max(1, values.size // 65536), max(1, values.shape[0] // 8))].astype(np.float64)
    differences = np.diff(rows, axis=1).ravel()
    tolerance = 2 * float(np.spacing(np.float32(max(abs(low), abs(high)))))
    moved = np.abs(differences[np.abs(differences) > 64 * tolerance])
    if 2 * moved.size < differences.size:
        return None

    def share(step: float) -> float:
        return float((np.abs(moved - np.rint(moved / step) * step) <= tolerance).mean())

    steps = {m * 10.0**k * unit for k in range(-9, 4) for m in (1.0, 2.0, 2.5, 5.0) for unit in (1.0, 0.3048)}
    for first in np.sort(moved)[:: max(1, moved.size // 64)]:
        step = float(first)
        for reach in (2, 8, 32, 128, 512):
            near = moved[moved < reach * step]
            times = np.rint(near / step)
            whole = np.abs(near - times * step) < max(4 * tolerance, 0.2 * step / reach)
            if (times * whole).any():
                step = float((near * times)[whole].sum() / (times * times)[whole].sum())
        steps.add(step)
    for step in sorted((step for step in steps if 64 * tolerance <= step <= moved.max()), reverse=True):
        if (high - low) / step < 2**LATTICE_BITS - 4 and share(step) > 0.7:
            short = float(f"{step:.5g}")
            step = short if share(short) >= share(step) else step
            half = float((int((high - low) / step) + 2) // 2)
            return Lattice("affine", float(np.rint(low / step)) * step + half * step, step)
    return None


@pytest.mark.parametrize("rule", ["affine", "decimal"])
@pytest.mark.parametrize("origin", [0.0, -1e9, 1e300, -1.7e308])
@pytest.mark.parametrize("step", [1e-300, 1e-3, 1.0, 1e250, 1e299, 1e308])
def test_values_of_a_lattice_are_finite(rule: str, origin: float, step: float) -> None:
    q = np.array([[-(2**31), -1, 0, 1, 2**31 - 1]], np.int32)
    made = np.empty((1, 5, 1))
    lattice = Lattice(rule, origin, step)
    store_values(lattice, (q, 0), made, 0)
    assert np.isfinite(made).all()
    np.testing.assert_array_equal(made[..., 0], lattice.values(q, np.dtype("f8")))


@pytest.mark.parametrize("lattice", [Lattice("affine", 1.0, 1e308), Lattice("decimal", 0.0, 1e-308)])
def test_what_overflows_float64_is_its_largest_number(lattice: Lattice) -> None:
    most = np.finfo(np.float64).max
    found = lattice.values(np.array([[-7, 1, 9]], np.int32), np.dtype("f8"))
    np.testing.assert_allclose(found, [[-most, 1e308, most]], rtol=1e-12)
