"""Values by bands are those of the whole level, in every state, for any number of threads."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lodestream as ls
from lodestream.decoding import channels
from lodestream.decoding.channels import has_bands, values_of_grid
from lodestream.decoding.reconstruction import Reconstruction, to_values
from lodestream.parallel import VARIABLE

if TYPE_CHECKING:
    from lodestream.container.model import Header

CLOSURES = [(False, False), (True, False), (False, True), (True, True)]


def arrived(points: Any, closed: tuple[bool, bool]) -> tuple[Header, Reconstruction]:
    decoder = ls.Decoder()
    decoder.feed(ls.encode(ls.Surface(points, closed=closed)))
    assert decoder.header is not None
    return decoder.header, decoder._reconstruction


@settings(max_examples=30, deadline=None)
@given(
    shape=st.tuples(st.integers(2, 150), st.integers(1, 60)),
    closed=st.sampled_from(CLOSURES),
    components=st.sampled_from([0, 3]),
    known=st.sampled_from(["all", "levels", "anything"]),
    most=st.integers(1, 200),
    count=st.sampled_from(["1", "3"]),
    seed=st.integers(0, 2**32),
)
def test_any_bands_of_any_state(
    shape: tuple[int, int],
    closed: tuple[bool, bool],
    components: int,
    known: str,
    most: int,
    count: str,
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    walk = rng.integers(-99, 100, (*shape, components) if components else shape).cumsum(0).cumsum(1)
    header, reconstruction = arrived(walk.astype(np.int32), closed)
    state = np.zeros((len(header.layout.tiles), header.channels), np.int8)
    if known == "levels":
        state[header.layout.tiles_of(int(rng.integers(header.levels + 1))).start :] = 57
    elif known == "anything":
        state[:] = np.where(rng.integers(0, 2, state.shape), rng.integers(0, 58, state.shape), 0)
    length, level = reconstruction.length, int(rng.integers(header.levels + 1))
    expected = to_values(header, reconstruction.reconstructions(length, state, level), level)
    with pytest.MonkeyPatch.context() as context:
        context.setenv(VARIABLE, count)
        with patch.multiple(channels, _SMALL=0, _ROWS=most, _SHARED=1 + most, _KEPT=64 * most):
            found = reconstruction._whole(length, state, level, None)
            assert len(found) == len(expected)
    for ours, whole in zip(found, expected, strict=True):
        for array, other in zip(ours.arrays, whole.arrays, strict=True):
            assert array.dtype == other.dtype
            np.testing.assert_array_equal(array, other)


def test_channels_that_are_not_chosen_are_zero() -> None:
    heights = np.arange(60, dtype=np.float32).reshape(6, 10)
    decoder = ls.Decoder()
    decoder.feed(ls.encode(ls.Surface(heights, attributes={"one": heights + 1, "other": heights + 2})))
    header, tiles = decoder.header, decoder._reconstruction._prepare()
    assert header is not None
    decoder._reconstruction._decode(decoder._reconstruction.length)
    state = np.zeros((len(header.layout.tiles), header.channels), np.int8)
    chosen = np.array([True, False, True])
    arrays = values_of_grid(header, tiles, state, header.levels, chosen)
    assert [bool(array.any()) for array in arrays] == chosen.tolist()
    np.testing.assert_array_equal(arrays[0][..., 0], heights)


@patch.object(channels, "_SMALL", 0)
def test_rows_that_wrap_have_no_bands() -> None:
    rng = np.random.default_rng(3)
    header, _ = arrived(rng.integers(0, 9, (24, 30)), (True, False))
    assert not has_bands(header, header.levels)
    header, _ = arrived(rng.integers(0, 9, (24, 30)), (False, True))
    assert has_bands(header, header.levels)
    assert not has_bands(header, 0)


def test_what_stays_in_the_cache_has_no_bands() -> None:
    header, _ = arrived(np.arange(60).reshape(6, 10), (False, False))
    assert not has_bands(header, header.levels)
    with patch.object(channels, "_SMALL", 59):
        assert has_bands(header, header.levels)
