from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.kernels import PART_COLUMNS, PART_ROWS
from lodestream.quantization import distortion
from lodestream.quantization.distortion import Original, coordinate_distances, store_values
from lodestream.quantization.lattice import Lattice
from lodestream.quantization.measure import distances
from lodestream.transform.pyramid import PADDING

DTYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]
LATTICES = [
    Lattice("affine", 0.1, 0.3),
    Lattice("affine", -3.0, 1e-7),
    Lattice("decimal", 7.0, 100.0),
    Lattice("affine", 1e300, 1e290),
    Lattice("affine", 0.0, 1e-200),
    Lattice("affine", 0.0, 0.5),  # halves, which are rounded to even
    Lattice("affine", 2.0**62, 2.0**40),
    Lattice("decimal", 1e300, 1e-5),
]


def coordinates(shape: tuple[int, int, int]) -> NDArray[np.int32]:
    count, rows, columns = shape
    rng = np.random.default_rng(columns)
    values = rng.integers(-(2**26), 2**26, (count, rows, columns + PADDING)) >> rng.integers(0, 26, shape[1])[:, None]
    return values.astype(np.int32)


@pytest.mark.parametrize("dtype", DTYPES)
def test_values_are_those_of_the_lattice_bit_for_bit(dtype: str) -> None:
    numbers = coordinates((1, 40, 700))[0, :, :700]
    for lattice, fraction, channels in itertools.product(LATTICES, (0, 5), (1, 3)):
        points = np.zeros((40, 700, channels), dtype)
        store_values(lattice, (numbers, fraction), points, channels - 1)
        assert points[..., -1].tobytes() == lattice.values(numbers, points.dtype, fraction).tobytes()
        assert not points[..., :-1].any()


@pytest.mark.sweep(5)
@pytest.mark.parametrize("dtype", DTYPES)
def test_distances_are_those_of_the_reconstruction(dtype: str) -> None:
    for shape, geometric in itertools.product([(259, 515), (1, 3), (3, 1025)], (1, 2, 3)):
        numbers = coordinates((geometric, *shape))
        # Where there are many cells it is their sums that count, and every third lattice is enough.
        step = 3 if min(shape) > kernels.PART_ROWS else 1
        for number, fraction in itertools.product(range(0, len(LATTICES), step), (0, 4)):
            lattices = (LATTICES[number:] + LATTICES[:number])[:geometric]
            reconstruction = np.zeros((*shape, geometric), dtype)
            for channel, lattice in enumerate(lattices):
                store_values(lattice, (numbers[channel, :, : shape[1]], fraction), reconstruction, channel)
            original = np.roll(reconstruction, 1, axis=1)
            found = coordinate_distances([Original(original, None)], lattices, [numbers], [fraction] * geometric)
            assert len(found) == (1 if geometric == 1 else 1 + geometric)
            assert found[0] == pytest.approx(distances(original, reconstruction, geometric), rel=1e-12, abs=0)
            for channel, pair in enumerate(found[1:]):
                expected = distances(original[..., channel], reconstruction[..., channel], 1)
                assert pair == pytest.approx(expected, rel=1e-12, abs=1e-150 * found[0][1])
            same = coordinate_distances([Original(reconstruction, None)], lattices, [numbers], [fraction] * geometric)
            assert same == [(0.0, 0.0)] * len(found)


def exact_differences(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.float64]:
    """Of floats as float64 has them; of integers, whose magnitudes are rounded to it."""
    if a.dtype.kind == "f":
        difference: NDArray[np.float64] = a.astype(np.float64) - b.astype(np.float64)
        return difference
    magnitudes: NDArray[np.float64] = np.abs(a.astype(object) - b.astype(object)).astype(np.float64)
    return magnitudes


def plain_distances(
    original: NDArray[Any], reconstruction: NDArray[Any], counted: NDArray[np.bool_]
) -> tuple[float, float]:
    """RMS and largest distance, their sums taken in the order of the kernel."""
    with np.errstate(over="ignore"):
        squares = np.zeros(original.shape[:2])
        for channel in range(reconstruction.shape[2]):
            delta = exact_differences(original[..., channel], reconstruction[..., channel])
            squares += delta * delta
    squares[~counted] = 0.0
    totals = []
    rows, columns = original.shape[0], original.shape[1]
    for top, left in itertools.product(range(0, rows, PART_ROWS), range(0, columns, PART_COLUMNS)):
        cell = squares[top : top + PART_ROWS, left : left + PART_COLUMNS]
        sums = np.zeros(cell.shape[1])
        for row in cell:
            sums += row
        total = 0.0
        for own in sums.tolist():
            total += own
        totals.append(total)
    return math.sqrt(math.fsum(totals) / np.count_nonzero(counted)), math.sqrt(squares.max())


@pytest.mark.sweep(5)
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.long
def test_distances_are_summed_in_one_order(dtype: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for shape, geometric in itertools.product([(259, 1027), (1, 3), (2, 512)], (1, 3)):
        numbers = coordinates((geometric, *shape))
        counted = np.random.default_rng(5).random(shape) < 0.8
        counted[0, 0] = True
        lattices = [LATTICES[0], LATTICES[2], LATTICES[5]][:geometric]
        shown = np.zeros((*shape, geometric), dtype)
        for channel, lattice in enumerate(lattices):
            store_values(lattice, (numbers[channel, :, : shape[1]], 3), shown, channel)
        original = np.zeros((*shape, geometric + 1), dtype)
        original[..., :-1] = np.roll(shown, 1, axis=1)
        for mask in (None, counted):
            known = np.ones(shape, np.bool_) if mask is None else mask
            expected = [plain_distances(original, shown, known)]
            if geometric > 1:
                channels = [slice(k, k + 1) for k in range(geometric)]
                expected += [plain_distances(original[..., own], shown[..., own], known) for own in channels]
            for at_once in (1, 16):
                monkeypatch.setattr(distortion, "_CELLS_PER_CALL", at_once)
                found = coordinate_distances([Original(original, mask)], lattices, [numbers], [3] * geometric)
                assert found == expected


@pytest.mark.parametrize("dtype", ["int64", "uint64"])
@pytest.mark.parametrize("lattice", [LATTICES[0], LATTICES[6], Lattice("affine", 0.0, 2.0**33)])
def test_integers_that_float64_cannot_tell_apart_have_distances(dtype: str, lattice: Lattice) -> None:
    limits = np.iinfo(dtype)
    ends = [limits.min, limits.min + 1, limits.max - 1, limits.max, 0, 2**53 + 1, 2**62 + 1, 2**62 + 3]
    original = np.random.default_rng(2).choice(np.array(ends, dtype), (40, 300, 1))
    numbers = coordinates((1, 40, 300))
    numbers[0, 0, :4] = -(2**31), 2**31 - 1, 0, 1
    shown = np.zeros((40, 300, 1), dtype)
    store_values(lattice, (numbers[0, :, :300], 0), shown, 0)
    every = np.ones((40, 300), np.bool_)
    for near in (0, 1, 3):  # differences of one are no float64 beyond 2**53
        own = (
            original
            if near == 0
            else np.where(
                shown > limits.max - near, shown - np.dtype(dtype).type(near), shown + np.dtype(dtype).type(near)
            )
        )
        own = own.astype(dtype)
        expected = plain_distances(own, shown, every)
        assert coordinate_distances([Original(own, None)], [lattice], [numbers], [0]) == [expected]
        if near:
            assert expected == (near, near)


@given(
    dtype=st.sampled_from(["int8", "int16", "uint8", "uint16", "int32", "float32"]),
    origin=st.integers(-(2**20) - 1, 2**20 + 1),
    step=st.integers(1, 2**20 + 1),
    fraction=st.integers(0, 9),
    shape=st.tuples(st.integers(1, 5), st.integers(1, 300)),
    masked=st.booleans(),
    seed=st.integers(0, 2**32),
)
def test_distances_on_a_lattice_of_whole_numbers_are_those_of_float64(
    dtype: str, origin: int, step: int, fraction: int, shape: tuple[int, int], masked: bool, seed: int
) -> None:
    """Integers of 16 bits are compared in integers, and nothing leaves their range: not even the farthest values."""
    rng = np.random.default_rng(seed)
    lattice = Lattice("affine", float(origin), float(step))
    low, high = (np.iinfo(dtype).min, np.iinfo(dtype).max) if dtype[0] != "f" else (-(2**15), 2**15)
    original = rng.integers(max(low, -(2**17)), min(high, 2**17) + 1, (*shape, 1)).astype(dtype)
    near = np.rint((original[..., 0].astype(np.float64) - origin) / step * 2**fraction) + rng.integers(-3, 4, shape)
    farthest = rng.choice(np.array([-(2**31), -(2**26), 0, 2**26, 2**31 - 1]), shape)
    numbers = np.where(rng.random(shape) < 0.3, farthest, near).clip(-(2**31), 2**31 - 1).astype(np.int32)[None]
    counted = rng.random(shape) < 0.8 if masked else None
    if counted is not None:
        counted[0, 0] = True
    shown = np.zeros((*shape, 1), dtype)
    store_values(lattice, (numbers[0], fraction), shown, 0)
    expected = plain_distances(original, shown, np.ones(shape, np.bool_) if counted is None else counted)
    assert coordinate_distances([Original(original, counted)], [lattice], [numbers], [fraction]) == [expected]


@given(
    shape=st.tuples(st.integers(1, 9), st.integers(1, 30), st.integers(1, 3)),
    dtype=st.sampled_from(DTYPES),
    decimal=st.booleans(),
    origin=st.floats(-1e20, 1e20),
    step=st.floats(1e-20, 1e20),
    fraction=st.integers(0, 5),
    at_once=st.integers(1, 40),
    seed=st.integers(0, 2**32),
)
def test_values_of_any_lattice_come_in_any_runs(
    shape: tuple[int, int, int],
    dtype: str,
    decimal: bool,
    origin: float,
    step: float,
    fraction: int,
    at_once: int,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    rows, columns, channels = shape
    wide = rng.integers(-(2**31), 2**31, (rows, columns + 3)) >> rng.integers(0, 32, (rows, columns + 3))
    numbers = wide.astype(np.int32)[:, 1 : columns + 1]
    lattice = Lattice("decimal" if decimal else "affine", origin, step)
    points = np.zeros(shape, dtype)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(distortion, "_POINTS_PER_CALL", at_once)
        store_values(lattice, (numbers, fraction), points, channels - 1)
    assert points[..., -1].tobytes() == lattice.values(numbers, points.dtype, fraction).tobytes()
    assert not points[..., :-1].any()


GOOD: dict[str, Any] = {
    "coordinates": np.zeros((3, 4), np.int32),
    "points": np.zeros((3, 4, 2), np.float32),
    "channels": 2,
    "channel": 1,
    "first": 0,
    "last": 12,
    "decimal": 0,
    "origin": 0.0,
    "step": 1.0,
    "scale": 1.0,
}


@pytest.mark.parametrize(
    "changed",
    [
        {"points": np.zeros((3, 4, 1), np.float32)},
        {"points": np.zeros((3, 5, 2), np.float32)},
        {"points": np.zeros(25, np.float32)},
        {"channels": 0},
        {"channels": -2},
        {"channel": 2},
        {"channel": -1},
        {"first": -1},
        {"first": 12, "last": 11},
        {"last": 13},
        {"coordinates": np.zeros((3, 4), np.int32)[:0]},
        {"coordinates": np.zeros((3, 4), np.int32)[:, :0]},
        {"origin": math.nan},
        {"origin": math.inf},
        {"step": 0.0},
        {"step": -1.0},
        {"step": math.inf},
        {"scale": math.nan},
    ],
)
def test_values_that_do_not_fit_are_refused(changed: dict[str, Any]) -> None:
    assert kernels.store_values(*GOOD.values()) == 0
    with pytest.raises(ValueError, match="do not fit"):
        kernels.store_values(*(GOOD | changed).values())


COMPARED: dict[str, Any] = {
    "points": np.zeros((3, 600, 3), np.float32),
    "coordinates": np.zeros((2, 3, 602), np.int32),
    "rules": np.tile([0.0, 0.0, 1.0, 1.0], 2),
    "counted": np.zeros(0, np.bool_),
    "figures": np.zeros((3, 3, 2)),
    "rows": 3,
    "columns": 600,
    "channels": 3,
    "channel": 1,
    "height": 3,
    "pitch": 602,
    "first": 0,
    "last": 3,
}


@pytest.mark.parametrize(
    "changed",
    [
        {"points": np.zeros((3, 600, 2), np.float32)},
        {"rows": 0},
        {"rows": 2**62},
        {"columns": -1},
        {"channels": 1},
        {"coordinates": np.zeros((1, 3, 602), np.int32)},
        {"height": 2},
        {"pitch": 599},
        {"pitch": 603},
        {"rules": np.zeros(0)},
        {"rules": np.ones(7)},
        {"rules": np.tile([0.0, 0.0, 1.0, 1.0], 4)},
        {"rules": np.tile([0.0, math.nan, 1.0, 1.0], 2)},
        {"rules": np.tile([0.0, 0.0, 0.0, 1.0], 2)},
        {"counted": np.zeros(3 * 599, np.bool_)},
        {"first": -1},
        {"first": 2, "last": 1},
        {"last": 4},
        {"figures": np.zeros((3, 2))},
        {"figures": np.zeros(0)},
        {"channel": -1},
        {"channel": 2},
        {"channel": 2**62},
        {
            "points": np.zeros((3, 600, 4), np.float32),
            "channels": 4,
            "channel": 0,
            "coordinates": np.zeros((4, 3, 602), np.int32),
            "rules": np.tile([0.0, 0.0, 1.0, 1.0], 4),
            "figures": np.zeros((3, 5, 2)),
        },
    ],
)
def test_distances_that_do_not_fit_are_refused(changed: dict[str, Any]) -> None:
    assert kernels.square_distances(*COMPARED.values()) == 0
    with pytest.raises(ValueError, match="do not fit"):
        kernels.square_distances(*(COMPARED | changed).values())


@pytest.mark.parametrize("dtype", ["int16", "int64", "float32"])
def test_a_channel_among_others_is_compared_by_itself(dtype: str) -> None:
    numbers = coordinates((1, 20, 30))
    points = np.random.default_rng(3).integers(-100, 100, (20, 30, 5)).astype(dtype)
    shown = np.zeros((20, 30, 1), dtype)
    store_values(LATTICES[5], (numbers[0, :, :30], 4), shown, 0)
    counted = np.random.default_rng(4).random((20, 30)) < 0.5
    for mask in (None, counted):
        found = coordinate_distances([Original(points, mask)], [LATTICES[5]], [numbers], [4], 3)
        chosen = np.ones((20, 30), np.bool_) if mask is None else mask
        assert found == [pytest.approx(distances(points[..., 3][chosen][None], shown[..., 0][chosen][None], 1))]
    nowhere = Original(points, np.zeros((20, 30), np.bool_))
    assert coordinate_distances([nowhere], [LATTICES[5]], [numbers], [4], 3) == [(0.0, 0.0)]


def test_attributes_have_no_part_in_distances() -> None:
    numbers = coordinates((3, 20, 30))
    points = np.zeros((20, 30, 5), np.float32)
    for channel in range(3):
        store_values(LATTICES[0], (numbers[channel, :, :30], 0), points, channel)
    points[..., 3:] = 1e30
    points[4, 5, 2] += 1024.0
    rms, worst = coordinate_distances([Original(points, None)], LATTICES[:1] * 3, [numbers], [0, 0, 0])[0]
    assert worst == pytest.approx(1024.0, rel=1e-3)
    assert rms == pytest.approx(worst / np.sqrt(600))
