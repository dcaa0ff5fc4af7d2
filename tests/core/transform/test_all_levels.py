"""All levels undone in one call are the levels undone one step after another."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lodestream import Decoder, kernels
from lodestream.grid.layout import Layout
from lodestream.transform import all_levels
from lodestream.transform.predictors import INTERFACES
from lodestream.transform.pyramid import allocate, grids, inverse
from tests.examples import examples

GOLDEN = Path(__file__).parents[2] / "golden"


def _layout(path: Path) -> Layout:
    decoder = Decoder()
    decoder.feed(path.read_bytes())
    assert decoder.header is not None
    return decoder.header.layout


@examples(150)
@given(
    shape=st.tuples(st.integers(1, 150), st.integers(2, 150)),
    closed=st.tuples(st.booleans(), st.booleans()),
    bits=st.integers(1, 29),
    seed=st.integers(0, 2**32),
    data=st.data(),
)
def test_any_levels_of_any_plane(
    shape: tuple[int, int], closed: tuple[bool, bool], bits: int, seed: int, data: st.DataObject
) -> None:
    rng = np.random.default_rng(seed)
    layout = Layout.single(shape, closed, (6, 6))
    level = data.draw(st.integers(0, layout.levels))
    whole = data.draw(st.none() | st.integers(0, layout.levels))
    bare = data.draw(st.sets(st.integers(0, layout.levels)))
    predictors = rng.integers(-127, 128, (layout.levels, INTERFACES + 1, 2)).astype(np.int8)
    coefficients = rng.integers(-(1 << bits) + 1, 1 << bits, layout.shape(0, level))
    found, expected = allocate(coefficients.shape), allocate(coefficients.shape)
    found[...] = expected[...] = coefficients
    assert all_levels.memory_of([found], layout, level) is not None
    inverse([found], layout, predictors, level, whole, bare=bare)
    with patch.object(all_levels, "_POINTS_PER_CALL", 0):
        assert all_levels.memory_of([expected], layout, level) is None
        inverse([expected], layout, predictors, level, whole, bare=bare)
    np.testing.assert_array_equal(found, expected)


ARRANGED = sorted(path.name for path in GOLDEN.glob("*.lode") if len(_layout(path).grids) > 1)


@pytest.mark.parametrize("name", ARRANGED)
def test_grids_that_share_sides(name: str) -> None:
    layout = _layout(GOLDEN / name)
    rng = np.random.default_rng(len(name))
    predictors = rng.integers(-127, 128, (layout.levels, INTERFACES + 1, 2)).astype(np.int8)
    few = len(layout.grids) * layout.levels <= all_levels._MAX_GRID_LEVELS
    for level, whole, coordinate in product(range(layout.levels + 1), (None, 0, 2, layout.levels), (True, False)):
        bits = int(rng.integers(1, 30))
        found = grids(layout, level)
        for array in found:
            array[...] = rng.integers(-(1 << bits) + 1, 1 << bits, array.shape)
        expected = [array.copy() for array in found]
        assert (all_levels.memory_of(found, layout, level) is not None) == few
        inverse(found, layout, predictors, level, whole, coordinate)
        with patch.object(all_levels, "_POINTS_PER_CALL", 0):
            inverse(expected, layout, predictors, level, whole, coordinate)
        for grid, one, other in zip(layout.grids, found, expected, strict=True):
            if coordinate or not grid.interface:
                np.testing.assert_array_equal(one, other)


def test_arrays_apart_take_one_step_after_another() -> None:
    layout = _layout(GOLDEN / ARRANGED[0])
    apart = [allocate(layout.shape(k, layout.levels)) for k in range(len(layout.grids))]
    assert all_levels.memory_of(apart, layout, layout.levels) is None
    turned = np.zeros((2, 3), np.int32, order="F")
    assert all_levels.memory_of([turned], Layout.single((2, 3), (False, False), (6, 6)), 0) is None


@pytest.mark.parametrize(
    ("field", "value"),
    [(0, 6), (0, -1), (1, 1), (1, -1), (3, 6), (3, 0), (4, 10), (5, 0), (6, 9), (7, 128), (9, 5)],
)
def test_steps_that_do_not_fit_are_refused(field: int, value: int) -> None:
    layout = Layout.single((5, 9), (False, False), (6, 6))
    table = all_levels._steps(layout, True).table.copy()
    table[-1, field] = value
    with pytest.raises(ValueError, match="do not fit"):
        kernels.inverse(table, np.array([0, 5, 9, 9]), np.zeros(45, np.int32), np.empty(5000, np.int32))


@pytest.mark.parametrize(
    "plane",
    [
        *((1, 5, 9, 9), (-1, 5, 9, 9), (0, 6, 9, 9), (0, 5, 10, 9), (0, 5, 9, 10), (0, 5, 9, 8), (46, 1, 1, 1)),
        *((0, 2**62, 9, 9), (0, 5, 2**62, 2**62), (0, 5, 9, 2**62), (0, 0, 9, 9)),
    ],
)
def test_planes_outside_of_the_memory_are_refused(plane: tuple[int, ...]) -> None:
    layout = Layout.single((5, 9), (False, False), (6, 6))
    table = all_levels._steps(layout, True).table
    with pytest.raises(ValueError, match="do not fit"):
        kernels.inverse(table, np.array(plane), np.zeros(45, np.int32), np.empty(5000, np.int32))


def _turned(kind: int, **fields: int) -> None:
    """One step that takes three points of the first column of a plane to the first row of another."""
    step = np.zeros(kernels.INVERSE_STEP, np.int64)
    told = {"kind": kind, "plane": 0, "axis": 1, "columns": 3, "midpoints": 1, "run": 2, "source": 1, "by": 1}
    for name, value in {**told, **fields}.items():
        step[getattr(all_levels, f"_{name.upper()}")] = value
    planes = np.array([0, 3, 3, 3, 9, 3, 1, 1])
    kernels.inverse(step, planes, np.arange(12, dtype=np.int32), np.empty(200, np.int32))


@pytest.mark.parametrize("midpoints", [0, -1, 2, 4, -(2**63), 2**63 - 1])
def test_more_or_fewer_details_than_a_line_has_are_refused(midpoints: int) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        _turned(kernels.INVERSE_DETAILS, midpoints=midpoints)


@pytest.mark.parametrize("kind", [kernels.INVERSE_NODES, kernels.INVERSE_DETAILS])
@pytest.mark.parametrize(
    "fields",
    [
        *({"plane": 2}, {"source": 2}, {"source": -1}, {"axis": 2}, {"line": 3}, {"line": -1}, {"columns": 0}),
        *({"columns": 4}, {"from": 1}, {"from": 3}, {"from": -1}, {"by": 2}, {"by": -1}, {"by": -2}),
    ],
)
def test_points_of_another_plane_that_do_not_fit_are_refused(kind: int, fields: dict[str, int]) -> None:
    _turned(kind)
    with pytest.raises(ValueError, match="do not fit"):
        _turned(kind, **fields)
