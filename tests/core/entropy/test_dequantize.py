"""Coefficients from what is known of them: against the rules of docs/format.md, section 8, a coefficient at a time."""

from __future__ import annotations

from unittest.mock import Mock, patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.entropy import dequantize
from lodestream.entropy.band_fields import BAND_FIELDS, COLUMNS, OFFSET, ROWS, STRIDE
from lodestream.entropy.dequantize import UNANNOUNCED, spread_bands
from lodestream.quantization.band_steps import ODD, TRANSITIONS

LARGEST = 2**28


class Case:
    """Bands of random tiles, one beside the other, in arrays with a little room around."""

    def __init__(
        self, shapes: list[tuple[int, int]], steps: list[int], states: list[int], bits: int, seed: int
    ) -> None:
        rng = np.random.default_rng(seed)
        count = len(shapes)
        self.bands = np.zeros((count, BAND_FIELDS), np.int64)
        self.origins = np.zeros((count, 3), np.int64)
        place, left = 5, 2
        for number, (rows, columns) in enumerate(shapes):
            stride = columns + int(rng.integers(0, 3))
            self.bands[number, [OFFSET, STRIDE, ROWS, COLUMNS]] = place, stride, rows, columns
            self.origins[number] = number, 3, left
            place, left = place + rows * stride, left + columns
        self.steps, self.state = np.array(steps, np.int64), np.array(states, np.int8)
        self.known = (rng.integers(0, 2**bits, place) >> rng.integers(0, bits + 2, place)).astype(np.int32)
        self.sign = np.where(self.known > 0, rng.choice([-1, 1], place), 0).astype(np.int8)
        self.early = rng.integers(0, 30, place).astype(np.uint8)
        self.shape = (max(rows for rows, _ in shapes) + 5, left + 4)

    def empty(self) -> NDArray[np.int32]:
        """A place for all of it, from row 2 and column 1 on, full of -1."""
        return np.full((self.shape[0] - 2, self.shape[1] + 7), -1, np.int32)[:, 3 : 2 + self.shape[1]]

    def spread(self, finer: int, numbers: NDArray[np.int64] | None = None) -> NDArray[np.int32]:
        """What becomes of it, where nothing is spread -1."""
        numbers, out = np.arange(len(self.bands)) if numbers is None else numbers, self.empty()
        arrays = self.known, self.sign, self.early, self.bands, self.origins, self.steps
        spread_bands(*arrays, numbers, self.state, finer, out, (2, 1))
        return out

    def expected(self, finer: int) -> NDArray[np.int32]:
        """The same by the rules."""
        out = self.empty()
        for number, (tile, top, left) in enumerate(self.origins.tolist()):
            offset, stride, rows, columns = self.bands[number, [OFFSET, STRIDE, ROWS, COLUMNS]].tolist()
            step, remaining = int(self.steps[number]), int(self.state[tile])
            trellis = 0
            for i, j in in_blocks(rows, columns):
                trellis = 0 if (i % 8, j) == (0, 0) else trellis
                at = offset + i * stride + j
                magnitude, marked = int(self.known[at]), int(self.early[at])
                value = magnitude_of(magnitude, marked, remaining, step, bool(ODD[trellis]))
                trellis = int(TRANSITIONS[trellis, magnitude & 1])
                value = min(value * (8 if tile >= finer else 1), LARGEST)
                out[top - 2 + i, left - 1 + j] = int(self.sign[at]) * value
        return out


def kernel_refuses(case: Case, numbers: list[int], origin: tuple[int, int] = (2, 1)) -> None:
    arrays = case.known, case.sign, case.early, case.bands, case.origins, case.steps
    with pytest.raises(ValueError, match="do not fit"):
        kernels.spread(*arrays, np.array(numbers), case.state, 0, case.empty(), *origin)


def in_blocks(rows: int, columns: int) -> list[tuple[int, int]]:
    """Places in raster order of blocks of 8 x 8."""
    return sorted(np.ndindex(rows, columns), key=lambda at: (at[0] // 8, at[1] // 8, *at))


def magnitude_of(magnitude: int, marked: int, remaining: int, step: int, odd: bool) -> int:
    """A magnitude before it is limited."""
    if remaining >= UNANNOUNCED:
        return 0
    plane = (remaining + 1) >> 1
    high = magnitude >> plane << plane
    early = bool(remaining & 1) and marked == plane and magnitude >> (plane - 1) != 0
    lower = 1 << max(plane - 1, 0)
    if not step:
        if remaining == 0:
            return magnitude
        return high + ((7 << plane) >> 4) if high else lower + (7 * lower >> 4) if early else 0
    if remaining == 0:
        sixteenths = 16 * magnitude - (8 if odd and magnitude else 0)
    elif high:
        sixteenths = 16 * high + 7 * ((1 << plane) - 1) - 4
    else:
        sixteenths = 16 * lower + 7 * (lower - 1) - 4 if early else 0
    return sixteenths * step >> 4


@given(
    shapes=st.lists(st.tuples(st.integers(1, 20), st.integers(1, 40)), min_size=1, max_size=4),
    bits=st.integers(1, 28),
    finer=st.integers(0, 4),
    seed=st.integers(0, 2**32),
    data=st.data(),
)
def test_coefficients_are_those_of_the_rules(
    shapes: list[tuple[int, int]], bits: int, finer: int, seed: int, data: st.DataObject
) -> None:
    steps = data.draw(st.lists(st.sampled_from([0, 0, 1, 2, 7, 4096, 2**26 - 1]), min_size=4, max_size=4))
    states = data.draw(st.lists(st.integers(0, 57), min_size=4, max_size=4))
    case = Case(shapes, steps[: len(shapes)], states, bits, seed)
    np.testing.assert_array_equal(case.spread(finer), case.expected(finer))


def test_every_number_of_passes_at_the_largest_magnitudes() -> None:
    for remaining in range(58):
        steps = [0, 1, 3, 2**26 - 1]
        case = Case([(9, 17)] * 4, steps, [remaining] * 4, 28, remaining)
        case.known[case.known > 2**20] = 2**28 - 1
        for finer in (0, 4):
            out = case.spread(finer)
            np.testing.assert_array_equal(out, case.expected(finer))
            assert np.abs(out).max() <= LARGEST


def test_only_the_bands_that_are_named_are_spread() -> None:
    case = Case([(5, 6)] * 4, [0] * 4, [0] * 4, 9, 1)
    out = case.spread(4, np.array([2, 0]))
    expected = case.expected(4)
    expected[:, 7:13] = expected[:, 19:] = -1
    np.testing.assert_array_equal(out, expected)
    assert (case.spread(4, np.empty(0, np.int64)) == -1).all()


@pytest.mark.parametrize(("at_once", "bands"), [(1, [1] * 5), (60, [2, 2, 1]), (149, [4, 1]), (150, [5])])
def test_bands_are_divided_between_calls(at_once: int, bands: list[int]) -> None:
    case = Case([(5, 6)] * 5, [0, 3, 0, 0, 9], [0, 1, 2, 3, 4], 9, 1)
    spread = Mock(wraps=kernels.spread)
    with patch.object(dequantize, "_COEFFICIENTS_PER_CALL", at_once), patch.object(kernels, "spread", spread):
        np.testing.assert_array_equal(case.spread(2), case.expected(2))
    assert [call.args[6].size for call in spread.call_args_list] == bands


def test_what_does_not_lie_inside_is_refused() -> None:
    case = Case([(5, 6), (7, 8)], [0, 5], [0, 3], 9, 1)
    case.spread(0)
    for name, place, value in [
        ("known", slice(0, -1), None),
        ("sign", slice(1, None), None),
        ("early", slice(1, None), None),
        ("bands", slice(0, 1), None),
        ("origins", slice(0, 1), None),
        ("steps", slice(0, 1), None),
        ("state", slice(0, 1), None),
        ("bands", (1, OFFSET), -1),
        ("bands", (1, OFFSET), 2**62),
        ("bands", (1, OFFSET), case.bands[1, OFFSET] + 3),
        ("bands", (1, STRIDE), 7),
        ("bands", (1, STRIDE), 2**62),
        ("bands", (1, ROWS), -1),
        ("bands", (1, ROWS), 2**40),
        ("bands", (1, COLUMNS), -1),
        ("bands", (1, COLUMNS), 2**62),
        ("origins", (1, 0), -1),
        ("origins", (1, 0), 2),
        ("origins", (0, 2), -1),
        ("origins", (1, 1), 2**31),
        ("origins", (1, 2), 2**31),
        ("origins", (1, 1), -(2**63)),
        ("origins", (1, 2), -(2**63)),
        ("steps", 0, -1),
        ("steps", 0, 2**26),
        ("state", 1, -1),
    ]:
        hostile = Case([(5, 6), (7, 8)], [0, 5], [0, 3], 9, 1)
        array = getattr(hostile, name)
        if value is None:
            setattr(hostile, name, array[place].copy())
        else:
            array[place] = value
        kernel_refuses(hostile, [0, 1])
    kernel_refuses(case, [0, 1], (-1, 1))
    kernel_refuses(case, [0, 1], (2, -1))
    kernel_refuses(case, [-1])
    kernel_refuses(case, [0, 2])


@pytest.mark.parametrize(("step", "remaining"), [(0, 0), (0, 3), (5, 0), (5, 3), (0, UNANNOUNCED)])
def test_what_lies_outside_is_left_out(step: int, remaining: int) -> None:
    case = Case([(19, 11), (12, 9)], [step, step], [remaining, remaining], 9, 3)
    whole, arrays = case.expected(1), (case.known, case.sign, case.early, case.bands, case.origins, case.steps)
    rows, columns = whole.shape
    for top, left in [*((k, 0) for k in range(rows)), *((0, k) for k in range(columns)), (6, 5), (13, 14)]:
        for bottom in range(top + 1, rows + 1, 3):
            for right in range(left + 1, columns + 1, 4):
                part = slice(top, bottom), slice(left, right)
                out = case.empty()[part]
                spread_bands(*arrays, np.arange(2), case.state, 1, out, (2 + top, 1 + left))
                np.testing.assert_array_equal(out, whole[part])


@given(seed=st.integers(0, 2**32), step=st.sampled_from([0, 1, 2**26 - 1]))
def test_any_numbers_stay_inside(seed: int, step: int) -> None:
    rng = np.random.default_rng(seed)
    case = Case([(9, 30), (3, 7)], [step, step], [0, 0], 9, seed)
    outside = np.ones(case.empty().shape, np.bool_)
    outside[1:10, 1:31] = outside[1:4, 31:38] = False
    case.known[:] = rng.integers(-(2**31), 2**31, case.known.size)
    case.sign[:] = rng.integers(-128, 128, case.sign.size)
    case.early[:] = rng.integers(0, 256, case.early.size)
    for remaining in range(58):
        case.state[:] = remaining
        assert (case.spread(int(rng.integers(0, 3)))[outside] == -1).all()
