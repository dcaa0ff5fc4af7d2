from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream.fill import fill_holes, settle_holes
from lodestream.layout import Layout
from lodestream.transform import allocate, forward

from .test_mask import blobs

DTYPES = ["int8", "int16", "int32", "int64", "uint8", "uint64", "float32", "float64"]


def hills(shape: tuple[int, int]) -> NDArray[np.float64]:
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    return np.asarray(np.sin(rows / 17.0) + np.cos(columns / 23.0 + rows / 40.0))


@given(
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    closed=st.tuples(st.booleans(), st.booleans()),
    dtype=st.sampled_from(DTYPES),
    channels=st.integers(0, 3),
    share=st.floats(0, 1),
    seed=st.integers(0, 2**32),
)
def test_valid_points_stay_and_holes_lie_within_their_range(
    shape: tuple[int, int], closed: tuple[bool, bool], dtype: str, channels: int, share: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    values = rng.integers(0, 100, shape if channels == 0 else (*shape, channels)).astype(dtype)
    mask = rng.random(shape) < share
    before = values.copy()
    filled = fill_holes(values, mask, closed)
    assert np.array_equal(values, before)
    assert (filled.shape, filled.dtype) == (values.shape, values.dtype)
    assert np.array_equal(filled[mask], values[mask])
    planes = (filled[..., np.newaxis], values[..., np.newaxis]) if channels == 0 else (filled, values)
    for got, given_ in zip(np.moveaxis(planes[0], -1, 0), np.moveaxis(planes[1], -1, 0), strict=True):
        valid = given_[mask]
        assert got.min() >= (valid.min() if valid.size else 0)
        assert got.max() <= (valid.max() if valid.size else 0)


@pytest.mark.parametrize("nothing", [np.nan, np.inf, -1e300])
def test_what_stands_under_a_hole_does_not_matter(nothing: float) -> None:
    values, mask = hills((60, 80)), blobs((60, 80), 1)
    expected = fill_holes(values, mask, (False, False))
    values[~mask] = nothing
    assert np.array_equal(fill_holes(values, mask, (False, False)), expected)


def test_a_smooth_surface_is_nearly_what_it_was() -> None:
    values, mask = hills((200, 300)), np.ones((200, 300), np.bool_)
    mask[80:110, 120:160] = False
    filled = fill_holes(values, mask, (False, False))
    assert np.abs(filled - values).max() < 0.1


def test_a_plane_is_continued() -> None:
    values = np.add.outer(np.arange(100.0), 2 * np.arange(120.0))
    mask = np.ones(values.shape, np.bool_)
    mask[30:60, 40:90] = False
    assert np.abs(fill_holes(values, mask, (False, False)) - values).max() < 0.05


def test_closed_axes_are_filled_across_the_seam() -> None:
    angles = 2 * np.pi * np.arange(128) / 128
    values = np.add.outer(np.sin(angles + 1), np.cos(angles))
    mask = np.ones(values.shape, np.bool_)
    mask[-6:] = mask[:6] = False
    mask[:, -6:] = mask[:, :6] = False
    closed = np.abs(fill_holes(values, mask, (True, True)) - values).max()
    assert closed < 0.1 < np.abs(fill_holes(values, mask, (False, False)) - values).max()


@pytest.mark.parametrize("scale", [1e-300, 1e-30, 1e30, 1e300])
def test_scales_do_not_matter(scale: float) -> None:
    mask = blobs((40, 50), 3)
    filled = fill_holes(hills((40, 50)) * scale / 2, mask, (False, True)) / scale
    assert filled == pytest.approx(fill_holes(hills((40, 50)) / 2, mask, (False, True)), rel=1e-9, abs=1e-12)


def bits(coordinates: NDArray[Any], layout: Layout) -> float:
    """About what the coefficients take."""
    work = allocate(layout.grids[0].shape)
    work[...] = coordinates
    forward([work], layout)
    return float(np.log2(1.0 + np.abs(work)).sum())


@pytest.mark.parametrize("closed", [(False, False), (True, False)])
def test_settled_holes_take_fewer_bits(closed: tuple[bool, bool]) -> None:
    shape = (160, 240)
    rough = np.cumsum(np.cumsum(np.random.default_rng(5).normal(size=shape), 0), 1)
    values, mask = np.rint(10 * rough).astype(np.int32), blobs(shape, 6)
    layout = Layout.single(shape, closed, (7, 7))
    filled = fill_holes(values, mask, closed)
    settled = settle_holes(filled, mask, layout)
    assert np.array_equal(settled[mask], values[mask])
    assert settled.dtype == np.int32
    assert values[mask].min() <= settled.min() <= settled.max() <= values[mask].max()
    assert bits(settled, layout) < 0.97 * bits(filled, layout)


def test_there_is_nothing_to_settle_without_holes() -> None:
    values = np.arange(12, dtype=np.int32).reshape(3, 4)
    for mask in (np.ones((3, 4), np.bool_), np.zeros((3, 4), np.bool_)):
        assert np.array_equal(settle_holes(values, mask, Layout.single((3, 4), (False, False), (7, 7))), values)
