"""Points at the same place."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lodestream.mesh.places import equal_places


@given(st.integers(0, 200), st.integers(0, 1000), st.booleans())
def test_places_are_the_unique_rows_in_order(count: int, seed: int, whole: bool) -> None:
    points = np.random.default_rng(seed).integers(-2, 3, (count, 3)).astype(np.int64 if whole else np.float64)
    points = points if whole else np.where(points == 0, -0.0, points) * 0.1
    places, numbers = equal_places(points)
    expected, inverse = np.unique(points, axis=0, return_inverse=True)
    np.testing.assert_array_equal(places, expected)
    np.testing.assert_array_equal(numbers, inverse.reshape(-1))
    np.testing.assert_array_equal(places[numbers], points)
