"""The choice of indices against plain computations of the same, and the search for a base."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.encoding import rate_distortion
from lodestream.encoding.noise_shaping import feedback_rules
from lodestream.encoding.rate_distortion import IndexChooser, longest_base
from lodestream.entropy.band_fields import (
    BAND_FIELDS,
    COLUMN_SHIFT,
    COLUMNS,
    OFFSET,
    PARENT,
    PARENT_STRIDE,
    ROW_SHIFT,
    ROWS,
    STRIDE,
)
from lodestream.entropy.tiles import TileTable
from lodestream.grid.layout import Grid, Layout
from lodestream.kernels import CLASSES, INDICES, RATES
from lodestream.quantization.band_steps import MOST_BASE, ODD, TRANSITIONS, Quantiser
from lodestream.transform.predictors import COEFFICIENT_BITS
from tests.examples import examples

WORTH = 0.05
BITS = rate_distortion._laplace()

layouts = st.builds(
    Layout,
    st.lists(
        st.builds(Grid, st.tuples(st.integers(1, 40), st.integers(1, 40)), st.tuples(st.booleans(), st.booleans())),
        min_size=1,
        max_size=3,
    ),
    st.tuples(st.integers(1, 4), st.integers(1, 4)),
)


def coefficients_of(table: TileTable, rng: np.random.Generator) -> NDArray[np.int32]:
    """Random ones, from none in a band to very large, with zeros around each band."""
    flat = np.zeros(table.size, np.int32)
    for band in table.bands:
        scale = 2.0 ** rng.integers(-2, 25)
        for row in range(band[ROWS]):
            start = band[OFFSET] + row * band[STRIDE]
            flat[start : start + band[COLUMNS]] = rng.laplace(0, scale, band[COLUMNS])
    return flat


@examples(25)
@given(layout=layouts, base=st.integers(1, 5000), at_once=st.integers(1, 500), seed=st.integers(0, 2**32))
def test_classes_are_those_of_what_is_around(layout: Layout, base: int, at_once: int, seed: int) -> None:
    table = TileTable.of(layout)
    flat, steps = coefficients_of(table, np.random.default_rng(seed)), table.steps(Quantiser(base))
    relative, classes = np.zeros(table.size), np.zeros(table.size, np.int8)
    sizes = table.bands[:, ROWS] * table.bands[:, COLUMNS]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rate_distortion, "_AT_ONCE", at_once)
        runs = rate_distortion._runs(sizes)
    assert [first for first, _ in runs] + [len(sizes)] == [0] + [last for _, last in runs]
    assert all(sizes[first:last].sum() <= at_once or last == first + 1 for first, last in runs)
    for first, last in runs:
        kernels.classify(table.bands[first:last], steps[first:last], flat, relative, classes)
    expected, groups = np.zeros(table.size), np.zeros(table.size, np.int8)
    places = [_places(band) for band in table.bands]
    for own, step in zip(places, steps, strict=True):
        expected[own] = flat[own] * (1.0 / step)
    size = np.abs(expected)
    for own, band in zip(places, table.bands, strict=True):
        near, stride = own[..., np.newaxis], band[STRIDE]
        sides = size[near + np.array([-1, 1, -stride, stride])].sum(axis=-1)
        corners = size[near + np.array([-stride - 1, -stride + 1, stride - 1, stride + 1])].sum(axis=-1)
        i, j = np.ogrid[: band[ROWS], : band[COLUMNS]]
        above = size[band[PARENT] + (i >> band[ROW_SHIFT]) * band[PARENT_STRIDE] + (j >> band[COLUMN_SHIFT])]
        around = (2 * sides + corners + 2 * above) / 14
        groups[own] = np.clip(np.floor(2 * np.log2(around + 1e-3) + 8), 0, CLASSES - 1)
    assert relative.tobytes() == expected.tobytes()
    assert np.array_equal(classes, groups)


def _places(band: NDArray[np.int64]) -> NDArray[np.int64]:
    i, j = np.ogrid[: band[ROWS], : band[COLUMNS]]
    return np.asarray(band[OFFSET] + i * band[STRIDE] + j)


def rates_of(bits: NDArray[np.float64]) -> NDArray[np.float32]:
    """What indices cost without a table of them: float32, shape (quantiser, class, index)."""
    rates = np.zeros((*bits.shape[:2], RATES), np.float32)
    for k in range(RATES):
        beyond = 2 * math.log2(k - INDICES + 3) if k >= INDICES - 1 else 0.0
        rates[:, :, k] = WORTH * (bits[:, :, min(k, INDICES - 1)] + (k > 0) + beyond)
    return rates


RATES_OF_INDICES = rates_of(BITS)


def test_rates_are_bits_with_a_sign() -> None:
    assert rate_distortion._rates(BITS) == pytest.approx(RATES_OF_INDICES, rel=1e-6)


def choose(
    values: NDArray[np.float64], classes: NDArray[np.int8], rule: NDArray[np.float32]
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Indices of a band, and how often each was chosen."""
    rows, columns = values.shape
    band = np.zeros((1, BAND_FIELDS), np.int64)
    band[0, [STRIDE, ROWS, COLUMNS]] = columns, rows, columns
    chosen, counts = np.zeros(values.shape, np.int32), np.zeros(BITS.shape)
    room = np.empty(64 * columns, np.int16), np.empty(2 * columns, np.float32)
    kernels.choose(band, rule, values, classes, RATES_OF_INDICES, chosen, counts, *room)
    return chosen, counts


def point_of(k: int, odd: int, half: float) -> float:
    """Where an index without its sign lies."""
    return k - half * odd if k else 0.0


def check(
    values: NDArray[np.float64], classes: NDArray[np.int8], rule: NDArray[np.float32]
) -> tuple[NDArray[np.int32], float]:
    """What is chosen and what it costs, with what is fed back; counts are those of the indices."""
    chosen, counts = choose(values, classes, rule)
    half, weight, *taps = rule.tolist()
    total, expected, errors = 0.0, np.zeros(BITS.shape), np.zeros(values.shape)
    for top in range(0, len(values), 8):
        state = 0
        for i, j in in_blocks(len(values), values.shape[1], top):
            odd, k = int(ODD[state]), abs(int(chosen[i, j]))
            errors[i, j] = values[i, j] - math.copysign(point_of(k, odd, half), chosen[i, j])
            total += float(RATES_OF_INDICES[odd, classes[i, j], min(k, RATES - 1)])
            expected[odd, classes[i, j], min(k, INDICES - 1)] += 1
            state = int(TRANSITIONS[state, k & 1])
    assert np.array_equal(counts, expected)
    return chosen, total + weight * float((shaped(errors, taps) ** 2).sum())


def shaped(errors: NDArray[np.float64], taps: Sequence[float]) -> NDArray[np.float64]:
    """Errors, and what is fed back of those above and to the left."""
    for axis, (first, second) in enumerate([taps[:2], taps[2:]]):
        padded = np.pad(errors, [(2, 0) if axis == 0 else (0, 0), (2, 0) if axis == 1 else (0, 0)])
        n = errors.shape[axis]
        zero, one, two = (padded.take(range(2 - k, 2 - k + n), axis) for k in range(3))
        errors = zero + first * one + second * two
    return errors


def in_blocks(rows: int, columns: int, top: int) -> list[tuple[int, int]]:
    """Places of a row of blocks in the order in which they are coded."""
    bottom = min(top + 8, rows)
    return [
        (i, j) for left in range(0, columns, 8) for i in range(top, bottom) for j in range(left, min(left + 8, columns))
    ]


def cheapest(values: NDArray[np.float64], classes: NDArray[np.int8], rule: NDArray[np.float32]) -> NDArray[np.int32]:
    """Viterbi's algorithm, each of whose survivors is a whole band with its errors."""
    half, weight, *taps = rule.tolist()
    rows, columns = values.shape
    indices, errors = np.zeros(values.shape, np.int32), np.zeros(values.shape)
    for top in range(0, rows, 8):
        survivors = {0: (0.0, indices, errors)}
        for i, j in in_blocks(rows, columns, top):
            after: dict[int, tuple[float, int, int, float]] = {}
            for state, (cost, _, known) in sorted(survivors.items()):
                odd = int(ODD[state])
                around = np.zeros((3, 3))
                around[max(2 - i, 0) :, max(2 - j, 0) :] = known[max(i - 2, 0) : i + 1, max(j - 2, 0) : j + 1]
                around[2, 2] = 0.0
                wanted = values[i, j] + shaped(around, taps)[2, 2]
                for k in {0, int(abs(wanted) + half * odd), int(abs(wanted) + half * odd) + 1}:
                    point = point_of(k, odd, half)
                    rate = float(RATES_OF_INDICES[odd, classes[i, j], min(k, RATES - 1)])
                    total = cost + weight * (abs(wanted) - point) ** 2 + rate
                    to = int(TRANSITIONS[state, k & 1])
                    if to not in after or total < after[to][0]:
                        after[to] = total, state, int(math.copysign(k, wanted)), math.copysign(point, wanted)
            grown = {}
            for to, (total, state, k, point) in after.items():
                _, own, known = survivors[state]
                grown[to] = total, own.copy(), known.copy()
                grown[to][1][i, j], grown[to][2][i, j] = k, values[i, j] - point
            survivors = grown
        _, indices, errors = min(survivors.values(), key=lambda survivor: survivor[0])
    return indices


rules = st.builds(
    lambda half, weight, taps: np.array([half, weight, *taps], np.float32),
    st.sampled_from([0.5, 0.5, 0.625, 1.0]),
    st.floats(0.25, 4.0, width=32),
    st.sampled_from([(0, 0, 0, 0), (0.17, 0, -0.34, 0.09), (-0.17, 0.03, 0.27, 0), (-0.34, 0.09, -0.27, 0.06)]),
)


@examples(15)
@given(
    sizes=st.lists(st.floats(-6, 6), min_size=1, max_size=5),
    classes=st.lists(st.integers(0, CLASSES - 1), min_size=5, max_size=5),
    half=st.sampled_from([0.5, 0.75]),
)
def test_without_feedback_the_cheapest_of_all_indices_are_found(
    sizes: list[float], classes: list[int], half: float
) -> None:
    def cost(indices: tuple[int, ...]) -> float:
        state, total = 0, 0.0
        for size, group, k in zip(sizes, classes, indices, strict=False):
            odd = int(ODD[state])
            total += (abs(size) - point_of(k, odd, half)) ** 2 + float(RATES_OF_INDICES[odd, group, k])
            state = int(TRANSITIONS[state, k & 1])
        return total

    nearest = [sorted({0, int(abs(size)), int(abs(size)) + 1, int(abs(size) + half) + 1}) for size in sizes]
    best = min(cost(way) for way in itertools.product(*nearest))
    rule = np.array([half, 1, 0, 0, 0, 0], np.float32)
    _, found = check(np.array([sizes]), np.array([classes[: len(sizes)]], np.int8), rule)
    assert found == pytest.approx(best, rel=1e-5, abs=1e-5)


@examples(13)
@given(
    shape=st.tuples(st.integers(1, 18), st.integers(1, 19)),
    scale=st.floats(-7, 6).map(lambda power: 2.0**power),
    rule=rules,
    seed=st.integers(0, 2**32),
)
def test_each_survivor_keeps_its_errors(
    shape: tuple[int, int], scale: float, rule: NDArray[np.float32], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    # Few binary places: float32 then makes no difference but in what is fed back.
    values = np.rint(64 * np.clip(rng.laplace(0, scale, shape), -30, 30)) / 64
    values[8:16] *= rng.integers(0, 2)  # a row of blocks without anything
    classes = rng.integers(0, CLASSES, shape).astype(np.int8)
    chosen, cost = check(values, classes, rule)
    expected = cheapest(values, classes, rule)
    if not np.array_equal(chosen, expected):  # two ways cost the same but for the rounding of float32
        assert (chosen != expected).mean() < 0.2 or values.size < 40
        assert cost == pytest.approx(cost_of(values, classes, expected, rule), rel=0.02)


def cost_of(
    values: NDArray[np.float64], classes: NDArray[np.int8], chosen: NDArray[np.int32], rule: NDArray[np.float32]
) -> float:
    """What some indices cost."""
    half, weight, *taps = rule.tolist()
    total, errors = 0.0, np.zeros(values.shape)
    for top in range(0, len(values), 8):
        state = 0
        for i, j in in_blocks(len(values), values.shape[1], top):
            odd, k = int(ODD[state]), abs(int(chosen[i, j]))
            errors[i, j] = values[i, j] - math.copysign(point_of(k, odd, half), chosen[i, j])
            total += float(RATES_OF_INDICES[odd, classes[i, j], min(k, RATES - 1)])
            state = int(TRANSITIONS[state, k & 1])
    return total + float(weight * (shaped(errors, taps) ** 2).sum())


@given(
    value=st.floats(30, 2.0**27).flatmap(lambda value: st.sampled_from([value, -value])),
    half=st.sampled_from([0.5, 1.0]),
    seed=st.integers(0, 99),
)
def test_indices_of_large_coefficients_are_near(value: float, half: float, seed: int) -> None:
    values = value + np.random.default_rng(seed).normal(size=(9, 9))
    rule = np.array([half, 1, -0.34, 0.09, 0.27, 0], np.float32)
    chosen, _ = choose(values, np.full((9, 9), CLASSES - 1, np.int8), rule)
    assert np.abs(chosen - values).max() < 3


@pytest.mark.parametrize("value", [2.0**31, -(2.0**31), 1e300, -np.inf, np.nan])
def test_no_index_is_larger_than_a_coefficient_may_be(value: float) -> None:
    rule = np.array([0.5, 1, -0.34, 0.09, -0.34, 0.09], np.float32)
    chosen, counts = choose(np.array([[value]]), np.array([[3]], np.int8), rule)
    assert 2**27 < abs(int(chosen[0, 0])) < 2**COEFFICIENT_BITS
    assert counts[0, 3, -1] == counts.sum() == 1


@examples(5)
@given(layout=layouts, base=st.integers(1, 500), at_once=st.integers(1, 300), seed=st.integers(0, 2**32))
def test_indices_do_not_depend_on_how_bands_are_cut_into_calls(
    layout: Layout, base: int, at_once: int, seed: int
) -> None:
    table = TileTable.of(layout)
    flat = coefficients_of(table, np.random.default_rng(seed))
    whole, cut = IndexChooser(table), IndexChooser(table)
    for turn in range(2):
        quantiser = Quantiser(base + turn)
        steps, rules = table.steps(quantiser), feedback_rules(table, quantiser)
        expected = chosen_by(whole, steps, rules, flat)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(rate_distortion, "_AT_ONCE", at_once)
            assert np.array_equal(chosen_by(cut, steps, rules, flat), expected)
        error = np.zeros(table.size)
        for band, step in zip(table.bands, steps, strict=True):
            own = _places(band)
            error[own] = np.abs(flat[own] / step - expected[own])
        assert error.max() < 3


def chosen_by(
    chooser: IndexChooser, steps: NDArray[np.int64], rules: NDArray[np.float32], flat: NDArray[np.int32]
) -> NDArray[np.int32]:
    chooser.begin(steps, rules)
    chooser.choose(np.arange(len(steps)), flat)
    return chooser.end()


SIZE = 90
#: 6 rows of 10 columns, a row and a column before and behind them, and a parent for each 2 x 2.
BAND = {OFFSET: 14, STRIDE: 12, ROWS: 5, COLUMNS: 10, PARENT: 2, PARENT_STRIDE: 6, ROW_SHIFT: 1, COLUMN_SHIFT: 1}


def guarded(count: int, dtype: str) -> tuple[NDArray[Any], NDArray[Any]]:
    """An array, and the longer one that it lies in."""
    whole = np.full(count + 200, 77, dtype)
    whole[100:-100] = 0
    return whole[100:-100], whole


class Arrays:
    """What the two kernels are given, and what lies around what they write."""

    def __init__(self, changed: dict[int, int], size: int = SIZE, room: int = 10) -> None:
        self.bands = np.zeros((1, BAND_FIELDS), np.int64)
        for field, value in (BAND | changed).items():
            self.bands[0, field] = value
        self.steps = np.array([3])
        self.coefficients = np.random.default_rng(size).integers(-99, 99, size).astype(np.int32)
        kinds = {"relative": (size, "f8"), "classes": (size, "i1"), "chosen": (size, "i4")}
        kinds |= {"counts": (BITS.size, "f8"), "ways": (64 * room, "i2"), "above": (2 * room, "f4")}
        self.rules = np.array([0.5, 1, -0.34, 0.09, 0.27, 0], np.float32)
        self.rates = RATES_OF_INDICES
        self.written = {name: guarded(*kind) for name, kind in kinds.items()}

    def __getattr__(self, name: str) -> NDArray[Any]:
        return self.written[name][0]

    def classify(self) -> int:
        return kernels.classify(self.bands, self.steps, self.coefficients, self.relative, self.classes)

    def choose(self) -> int:
        rest = self.chosen, self.counts, self.ways, self.above
        return kernels.choose(self.bands, self.rules, self.relative, self.classes, self.rates, *rest)

    def check(self) -> None:
        """Nothing around what may be written was written."""
        for _, whole in self.written.values():
            assert (whole[:100] == 77).all()
            assert (whole[-100:] == 77).all()


OUTSIDE: list[dict[int, int]] = [
    {OFFSET: -1},
    {OFFSET: SIZE},
    {OFFSET: SIZE - 57},
    {OFFSET: 2**63 - 1},
    {OFFSET: -(2**63)},
    {STRIDE: -1},
    {STRIDE: 18},
    {STRIDE: 2**63 - 1},
    {ROWS: 0},
    {ROWS: 7},
    {ROWS: 2**31},
    {ROWS: 2**62, STRIDE: 0},
    {COLUMNS: 0},
    {COLUMNS: 30},
    {COLUMNS: 2**62},
]
OUTSIDE_AROUND: list[dict[int, int]] = [
    {OFFSET: 12},
    {OFFSET: SIZE - 70},
    {PARENT: -1},
    {PARENT: SIZE - 16},
    {PARENT: 2**63 - 1},
    {PARENT_STRIDE: -1},
    {PARENT_STRIDE: 42},
    {PARENT_STRIDE: 2**63 - 1},
    {ROW_SHIFT: -1},
    {ROW_SHIFT: 32},
    {COLUMN_SHIFT: -1},
    {COLUMN_SHIFT: 64},
]


def test_a_band_that_reaches_the_ends_is_taken() -> None:
    for changed in ({}, {OFFSET: SIZE - 71}, {OFFSET: 13, PARENT: 0}, {PARENT: SIZE - 17}, {PARENT_STRIDE: 41}):
        arrays = Arrays(changed)
        assert arrays.classify() == 0
        assert arrays.choose() == 0
        assert arrays.counts.sum() == 50
        arrays.check()
    assert Arrays({OFFSET: SIZE - 58}).choose() == 0


@pytest.mark.parametrize("changed", OUTSIDE)
def test_a_band_outside_the_arrays_is_refused(changed: dict[int, int]) -> None:
    arrays = Arrays(changed)
    with pytest.raises(ValueError, match=r"classify: .* do not fit"):
        arrays.classify()
    with pytest.raises(ValueError, match=r"choose: .* do not fit"):
        arrays.choose()
    arrays.check()


@pytest.mark.parametrize("changed", OUTSIDE_AROUND)
def test_a_band_whose_surroundings_lie_outside_is_refused(changed: dict[int, int]) -> None:
    arrays = Arrays(changed)
    with pytest.raises(ValueError, match="do not fit"):
        arrays.classify()
    arrays.check()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("bands", np.zeros(BAND_FIELDS + 1, np.int64)),
        ("steps", np.zeros(1, np.int64)),
        ("steps", np.ones(2, np.int64)),
        ("coefficients", np.zeros(SIZE - 1, np.int32)),
        ("relative", np.zeros(SIZE + 1)),
        ("classes", np.zeros(SIZE - 1, np.int8)),
    ],
)
def test_classes_that_do_not_fit_are_refused(name: str, value: NDArray[Any]) -> None:
    arrays = Arrays({})
    setattr(arrays, name, value)
    with pytest.raises(ValueError, match="do not fit"):
        arrays.classify()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("bands", np.zeros(BAND_FIELDS - 1, np.int64)),
        ("relative", np.zeros(SIZE + 1)),
        ("classes", np.zeros(SIZE - 1, np.int8)),
        ("chosen", np.zeros(SIZE - 1, np.int32)),
        ("rules", np.zeros(5, np.float32)),
        ("rules", np.full(6, -0.125, np.float32)),
        ("rules", np.full(6, 1.125, np.float32)),
        ("rules", np.full(6, np.nan, np.float32)),
        ("rates", np.zeros(2 * CLASSES * RATES - 1, np.float32)),
        ("counts", np.zeros(BITS.size - 1)),
        ("ways", np.zeros(639, np.int16)),
        ("above", np.zeros(19, np.float32)),
    ],
)
def test_choices_that_do_not_fit_are_refused(name: str, value: NDArray[Any]) -> None:
    arrays = Arrays({})
    setattr(arrays, name, value)
    with pytest.raises(ValueError, match="do not fit"):
        arrays.choose()


@given(
    changed=st.dictionaries(
        st.sampled_from(sorted(BAND)),
        st.one_of(st.integers(-5, 100), st.integers(-(2**63) + 1, 2**63 - 1)),
    ),
    classes=st.lists(st.integers(-128, 127), min_size=SIZE, max_size=SIZE),
    taps=st.lists(st.floats(width=32), min_size=5, max_size=5),
)
def test_no_band_and_no_class_leads_outside(changed: dict[int, int], classes: list[int], taps: list[float]) -> None:
    arrays = Arrays(changed, room=SIZE * 4)
    arrays.rules[1:] = taps
    for run in (arrays.classify, arrays.choose):
        with contextlib.suppress(ValueError):  # refused
            run()
        arrays.classes[:] = classes
    arrays.check()


@given(power=st.floats(0.3, 2.0), scale=st.floats(1e-3, 1e3), wanted=st.floats(1e-2, 1e2), guess=st.integers(1, 5000))
def test_the_longest_base_keeps_the_error(power: float, scale: float, wanted: float, guess: int) -> None:
    def error(base: int) -> float:
        assert 1 <= base <= MOST_BASE
        return float(scale * base**power)

    base = longest_base(error, wanted, guess)
    if base is None:
        assert error(1) > wanted or error(guess) > wanted
    else:
        assert error(base) <= wanted


def test_the_longest_base_is_close_to_the_error() -> None:
    found = longest_base(lambda base: 0.5 * base**0.8, 100.0, 128)
    assert found is not None
    assert 0.99 * 100.0 <= 0.5 * found**0.8 <= 100.0
