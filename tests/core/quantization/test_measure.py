from __future__ import annotations

import math

import numpy as np
import pytest

from lodestream.quantization.measure import distances, extent_of


@pytest.mark.parametrize("scale", [1e-300, 1e-200, 1e-30, 1.0, 1e30, 1e200, 1e290])
@pytest.mark.parametrize("shape", [(300, 7), (300, 7, 2), (600, 4, 3), (5, 5, 6)])
def test_distances_are_those_of_the_definition_at_any_scale(shape: tuple[int, ...], scale: float) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=shape), rng.normal(size=shape)
    delta = (a - b)[..., None] if a.ndim == 2 else (a - b)[..., :3]
    lengths = np.sqrt((delta**2).sum(axis=2))
    rms, worst = distances(a * scale, b * scale, min(delta.shape[2], 3))
    assert rms == pytest.approx(math.sqrt((lengths**2).mean()) * scale, rel=1e-12)
    assert worst == pytest.approx(lengths.max() * scale, rel=1e-12)


def test_equal_points_are_at_no_distance_and_no_other_points_are() -> None:
    points = np.full((4, 4), 1e-300)
    assert distances(points, points.copy(), 1) == (0.0, 0.0)
    other = points.copy()
    other[1, 1] = np.nextafter(1e-300, 1)
    assert min(distances(points, other, 1)) > 0
    assert distances(np.array([[5e-324]]), np.array([[0.0]]), 1) == (5e-324, 5e-324)


@pytest.mark.parametrize("dtype", ["int64", "uint64", "uint8", "int8"])
def test_integers_are_subtracted_before_they_are_rounded(dtype: str) -> None:
    limits = np.iinfo(dtype)
    a = np.array([[limits.max, limits.min]], dtype)
    b = np.array([[limits.max - 1, limits.min]], dtype)
    assert distances(a, b, 1) == (math.sqrt(0.5), 1.0)
    assert distances(b, a, 1)[1] == 1.0
    assert distances(a, a[:, ::-1], 1)[1] == float(int(limits.max) - int(limits.min))


def test_the_extent_is_the_range_or_the_diagonal() -> None:
    assert extent_of(np.array([[1, -3], [2, 4]], np.int8), 1) == 7.0
    assert extent_of(np.array([[-128, 127]], np.int8), 1) == 255.0
    box = np.array([[[0, 0, 0, 9e9], [3, 4, 12, 0]]], np.float32)
    assert extent_of(box, 3) == 13.0
    assert extent_of(box.astype(np.float64) * 1e200, 3) == pytest.approx(1.3e201)
    assert extent_of(np.array([[1e308, -1e308]]), 1) == math.inf
