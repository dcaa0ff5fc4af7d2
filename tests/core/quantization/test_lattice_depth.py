from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lodestream.quantization.lattice_depth import default_divisions

SMOOTH = np.add.outer(np.sin(np.arange(200) / 30.0), np.cos(np.arange(300) / 50.0))
NOISE = np.random.default_rng(0).normal(size=(200, 300))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_smooth_surfaces_are_divided_finely(dtype: str, scale: float) -> None:
    assert default_divisions([(SMOOTH * scale).astype(dtype)]) == 2**24 - 8


@pytest.mark.parametrize("noise", [1e-4, 1e-2, 1.0])
def test_noise_is_not(noise: float) -> None:
    assert default_divisions([(SMOOTH + noise * NOISE).astype(np.float32)]) == 2**20


@pytest.mark.parametrize(
    "values", [np.zeros((5, 5)), np.zeros((1, 1)), np.arange(12).reshape(3, 4), np.array([[1e300, -1e300]])]
)
def test_what_has_no_extent_is_divided_as_usual(values: NDArray[np.float64]) -> None:
    assert default_divisions([values]) in (2**20, 2**24 - 8)


def test_all_channels_count() -> None:
    smooth, noisy = SMOOTH.astype(np.float32), (SMOOTH + 0.01 * NOISE).astype(np.float32)
    assert default_divisions([smooth, smooth, smooth]) == 2**24 - 8
    assert default_divisions([noisy, noisy, noisy]) == 2**20
