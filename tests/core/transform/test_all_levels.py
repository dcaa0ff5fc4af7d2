"""All levels undone in one call are the levels undone one step after another."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lodestream import kernels
from lodestream.grid.layout import Layout
from lodestream.transform import all_levels
from lodestream.transform.predictors import INTERFACES
from lodestream.transform.pyramid import allocate, inverse


@settings(max_examples=150, deadline=None)
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
    start = data.draw(st.none() | st.integers(0, level))
    whole = data.draw(st.none() | st.integers(0, layout.levels))
    bare = data.draw(st.sets(st.integers(0, layout.levels)))
    predictors = rng.integers(-127, 128, (layout.levels, INTERFACES + 1, 2)).astype(np.int8)
    coefficients = rng.integers(-(1 << bits) + 1, 1 << bits, layout.shape(0, level))
    found, expected = allocate(coefficients.shape), allocate(coefficients.shape)
    found[...] = expected[...] = coefficients
    assert all_levels.fits(layout, level)
    inverse([found], layout, predictors, level, whole, start=start, bare=bare)
    with patch.object(all_levels, "_AT_ONCE", 0):
        assert not all_levels.fits(layout, level)
        inverse([expected], layout, predictors, level, whole, start=start, bare=bare)
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize(
    ("field", "value"), [(0, 4), (0, -1), (2, 6), (2, 0), (3, 10), (4, 0), (5, 9), (6, 128), (8, 5)]
)
def test_steps_that_do_not_fit_are_refused(field: int, value: int) -> None:
    layout = Layout.single((5, 9), (False, False), (6, 6))
    table = all_levels._steps(layout).table.copy()
    table[-1, field] = value
    with pytest.raises(ValueError, match="do not fit"):
        kernels.inverse(table, allocate((5, 9)), np.empty(5000, np.int32))
