"""The choice of indices against plain computations of the same, and the search for a base."""

from __future__ import annotations

import contextlib
import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import kernels, rate_distortion
from lodestream.band_fields import (
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
from lodestream.kernels import CLASSES, INDICES
from lodestream.layout import Grid, Layout
from lodestream.quantiser import MOST_BASE, Quantiser
from lodestream.rate_distortion import IndexChooser, longest_base
from lodestream.tiles import TileTable
from lodestream.trellis import ODD, TRANSITIONS

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


@settings(max_examples=50)
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


def in_blocks(values: NDArray[Any]) -> list[Any]:
    """Values in the order in which a band is coded: blocks of 8 x 8 in raster order."""
    rows, columns = values.shape
    blocks = (values[i : i + 8, j : j + 8] for i in range(0, rows, 8) for j in range(0, columns, 8))
    return [value for block in blocks for value in block.ravel().tolist()]


def rows_of_blocks(values: NDArray[Any]) -> list[slice]:
    """In each of which the trellis begins anew."""
    return [slice(top, top + 8) for top in range(0, len(values), 8)]


def cost_of(size: float, group: int, odd: int, k: int) -> float:
    """Squared error and bits of an index without its sign."""
    rate = float(BITS[odd, group, min(k, INDICES - 1)]) + (1.0 if k else 0.0)
    if k >= INDICES - 1:
        rate += 2 * math.log2(k - INDICES + 3)
    return (size - (k - 0.5 * odd if k else 0.0)) ** 2 + WORTH * rate


def least_cost(sizes: list[float], groups: list[int]) -> float:
    """Of all ways through the trellis."""
    costs = {0: 0.0}
    for size, group in zip(sizes, groups, strict=True):
        after: dict[int, float] = {}
        for state, cost in costs.items():
            odd = int(ODD[state])
            for k in {0, int(size), int(size) + 1, int(size + 0.5) + 1}:
                total = cost + cost_of(size, group, odd, k)
                to = int(TRANSITIONS[state, k & 1])
                after[to] = min(after.get(to, math.inf), total)
        costs = after
    return min(costs.values())


def choose(values: NDArray[np.float64], classes: NDArray[np.int8]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Indices of a band, and how often each was chosen."""
    rows, columns = values.shape
    band = np.zeros((1, BAND_FIELDS), np.int64)
    band[0, [STRIDE, ROWS, COLUMNS]] = columns, rows, columns
    chosen, counts = np.zeros(values.shape, np.int32), np.zeros(BITS.shape)
    room = np.empty(4 * values.size, np.int32), np.empty(values.size, np.uint8)
    kernels.choose(band, values, classes, BITS, WORTH, chosen, counts, *room)
    return chosen, counts


def check(values: NDArray[np.float64], classes: NDArray[np.int8]) -> float:
    """The cost of what is chosen, which is counted and has the signs of the values."""
    chosen, counts = choose(values, classes)
    total, expected = 0.0, np.zeros(BITS.shape)
    for rows in rows_of_blocks(values):
        state = 0
        arrays = np.abs(values[rows]), classes[rows], chosen[rows]
        for size, group, index in zip(*map(in_blocks, arrays), strict=True):
            odd, k = int(ODD[state]), abs(index)
            total += cost_of(size, group, odd, k)
            expected[odd, group, min(k, INDICES - 1)] += 1
            state = int(TRANSITIONS[state, k & 1])
    assert np.array_equal(counts, expected)
    assert (np.sign(chosen) * np.where(values >= 0, 1, -1) >= 0).all()
    return total


@settings(max_examples=35)
@given(
    sizes=st.lists(st.floats(-6, 6), min_size=1, max_size=5),
    classes=st.lists(st.integers(0, CLASSES - 1), min_size=5, max_size=5),
)
def test_the_cheapest_of_all_indices_are_found(sizes: list[float], classes: list[int]) -> None:
    groups = classes[: len(sizes)]

    def cost(indices: tuple[int, ...]) -> float:
        state, total = 0, 0.0
        for size, group, k in zip(sizes, groups, indices, strict=True):
            total += cost_of(abs(size), group, int(ODD[state]), k)
            state = int(TRANSITIONS[state, k & 1])
        return total

    nearest = [sorted({0, int(abs(size)), int(abs(size)) + 1, int(abs(size) + 0.5) + 1}) for size in sizes]
    best = min(cost(way) for way in itertools.product(*nearest))
    assert check(np.array([sizes]), np.array([groups], np.int8)) == pytest.approx(best, abs=1e-9)
    assert least_cost([abs(size) for size in sizes], groups) == pytest.approx(best, abs=1e-9)


@settings(max_examples=40)
@given(
    shape=st.tuples(st.integers(1, 19), st.integers(1, 19)),
    scale=st.floats(-4, 12).map(lambda power: 2.0**power),
    seed=st.integers(0, 2**32),
)
def test_the_cheapest_way_through_a_band_is_found(shape: tuple[int, int], scale: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    values, classes = rng.laplace(0, scale, shape), rng.integers(0, CLASSES, shape).astype(np.int8)
    rows = rows_of_blocks(values)
    best = sum(least_cost(in_blocks(np.abs(values[row])), in_blocks(classes[row])) for row in rows)
    # Bits of large indices are taken from a table of logarithms.
    assert check(values, classes) == pytest.approx(best, rel=1e-12, abs=1e-6 * values.size)


@pytest.mark.parametrize("value", [2.0**31, -(2.0**31), 1e300, -np.inf, np.nan])
def test_what_no_index_reaches_gets_the_largest(value: float) -> None:
    chosen, counts = choose(np.array([[value]]), np.array([[3]], np.int8))
    assert abs(int(chosen[0, 0])) in (2**31 - 2, 2**31 - 1)
    assert counts[0, 3, -1] == counts.sum() == 1


@settings(max_examples=10)
@given(layout=layouts, base=st.integers(1, 500), at_once=st.integers(1, 300), seed=st.integers(0, 2**32))
def test_indices_do_not_depend_on_how_bands_are_cut_into_calls(
    layout: Layout, base: int, at_once: int, seed: int
) -> None:
    table = TileTable.of(layout)
    flat = coefficients_of(table, np.random.default_rng(seed))
    whole = IndexChooser(table, flat)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rate_distortion, "_AT_ONCE", at_once)
        cut = IndexChooser(table, flat)
    for turn in range(2):
        expected = whole.indices(Quantiser(base + turn))
        assert np.array_equal(cut.indices(Quantiser(base + turn)), expected)
        error = np.zeros(table.size)
        for band, step in zip(table.bands, table.steps(Quantiser(base + turn)), strict=True):
            own = _places(band)
            error[own] = np.abs(flat[own] / step - expected[own])
        assert error.max() < 2.5


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

    def __init__(self, changed: dict[int, int], size: int = SIZE, room: int = 50) -> None:
        self.bands = np.zeros((1, BAND_FIELDS), np.int64)
        for field, value in (BAND | changed).items():
            self.bands[0, field] = value
        self.steps = np.array([3])
        self.coefficients = np.random.default_rng(size).integers(-99, 99, size).astype(np.int32)
        kinds = {"relative": (size, "f8"), "classes": (size, "i1"), "chosen": (size, "i4")}
        kinds |= {"counts": (BITS.size, "f8"), "indices": (4 * room, "i4"), "ways": (room, "u1")}
        self.written = {name: guarded(*kind) for name, kind in kinds.items()}

    def __getattr__(self, name: str) -> NDArray[Any]:
        return self.written[name][0]

    def classify(self) -> int:
        return kernels.classify(self.bands, self.steps, self.coefficients, self.relative, self.classes)

    def choose(self) -> int:
        rest = self.chosen, self.counts, self.indices, self.ways
        return kernels.choose(self.bands, self.relative, self.classes, BITS, WORTH, *rest)

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
        ("counts", np.zeros(BITS.size - 1)),
        ("indices", np.zeros(199, np.int32)),
        ("ways", np.zeros(49, np.uint8)),
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
)
def test_no_band_and_no_class_leads_outside(changed: dict[int, int], classes: list[int]) -> None:
    arrays = Arrays(changed, room=SIZE * 4)
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
