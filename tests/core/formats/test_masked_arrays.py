"""Masked arrays of numpy: what is masked is a hole, or NaN in an attribute; nothing masked is taken for a value."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

import lodestream as ls

HIDDEN = np.zeros((5, 6), bool)
HIDDEN[1:3, 2:5] = True


@pytest.mark.parametrize("dtype", ["int16", "float32", "float64"])
def test_masked_heights_are_holes(dtype: str) -> None:
    heights = np.ma.masked_array(np.arange(30).reshape(5, 6).astype(dtype), HIDDEN)
    back = ls.decode(ls.encode(heights))
    assert back.mask is not None
    assert np.array_equal(back.mask, ~HIDDEN)
    assert np.array_equal(back.points[back.mask], heights.data[~HIDDEN])


def test_a_point_is_a_hole_where_any_coordinate_is_masked() -> None:
    points = np.ma.masked_array(np.random.default_rng(1).normal(size=(5, 6, 3)))
    points[1, 2, 0] = points[1, 3, 1] = points[4, 4, 2] = np.ma.masked
    mask = np.ones((5, 6), bool)
    mask[0, 0] = False
    surface = ls.Surface(points, mask=mask)
    assert surface.mask is not None
    assert sorted(map(tuple, np.argwhere(~surface.mask).tolist())) == [(0, 0), (1, 2), (1, 3), (4, 4)]


def test_nothing_masked_is_no_mask() -> None:
    assert ls.Surface(np.ma.masked_array(np.zeros((3, 4)), False)).mask is None
    with pytest.raises(ls.InputError, match="at least one valid point"):
        ls.Surface(np.ma.masked_array(np.zeros((3, 4)), True))


def test_masked_attributes_are_nan_or_refused() -> None:
    heights = np.ma.masked_array(np.arange(30.0).reshape(5, 6), HIDDEN)
    speed = np.ma.masked_array(np.ones((5, 6, 2), np.float32), np.repeat(HIDDEN[::-1, :, None], 2, axis=2))
    kind = np.ma.masked_array(np.ones((5, 6), np.uint8), HIDDEN)
    surface = ls.Surface(heights, attributes={"speed": speed, "kind": kind})
    assert np.array_equal(np.isnan(surface.attributes["speed"]), speed.mask)
    assert surface.attributes["kind"].dtype == np.uint8
    with pytest.raises(ls.InputError, match="'kind' at all valid points, got masked ones of uint8"):
        ls.Surface(heights, attributes={"kind": np.ma.masked_array(kind.data, HIDDEN[::-1])})
    assert not np.isnan(speed.data).any()


def test_masked_channels_beyond_the_third() -> None:
    points = np.ma.masked_array(np.ones((5, 6, 4)))
    points[2, 2, 3] = np.ma.masked
    surface = ls.Surface(points)
    assert surface.mask is None
    assert np.isnan(surface.points[2, 2, 3])
    assert not np.isnan(points.data).any()


def test_what_is_under_a_mask_is_nobodys_value() -> None:
    """An infinity that a hole is kept for is a value; one that is masked is not."""
    points = np.ma.masked_array(np.random.default_rng(1).normal(size=(5, 6, 3)))
    points.data[1, 2] = points.data[3, 3] = np.inf
    points[1, 2] = np.ma.masked
    back = ls.decode(ls.encode(points))
    assert np.isnan(back.points[1, 2]).all()
    assert np.isinf(back.points[3, 3]).all()
    assert np.isinf(points.data[1, 2]).all()


def test_a_plain_array_does_not_load_numpys_masked_ones() -> None:
    code = "import sys, numpy; from lodestream import Surface; Surface(numpy.eye(3)); print('numpy.ma' in sys.modules)"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
