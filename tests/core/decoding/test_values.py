"""Values of a level made by bands are those of the whole level, in every state, for any number of threads."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.decoding import pieces, values
from lodestream.decoding.region import Region
from lodestream.decoding.segments import SegmentQueue
from lodestream.parallel import VARIABLE
from tests.examples import examples

if TYPE_CHECKING:
    from lodestream.container.model import Header

CLOSURES = [(False, False), (True, False), (False, True), (True, True)]


def arrived(points: Any, closed: tuple[bool, bool]) -> tuple[Header, SegmentQueue]:
    decoder = ls.Decoder()
    decoder.feed(ls.encode(ls.Surface(points, closed=closed)))
    assert decoder.header is not None
    return decoder.header, decoder._queue


@examples(15)
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
    header, queue = arrived(walk.astype(np.int32), closed)
    state = np.zeros((len(header.layout.tiles), header.channels), np.int8)
    if known == "levels":
        state[header.layout.tiles_of(int(rng.integers(header.levels + 1))).start :] = 57
    elif known == "anything":
        state[:] = np.where(rng.integers(0, 2, state.shape), rng.integers(0, 58, state.shape), 0)
    region = Region.whole(header.layout, int(rng.integers(header.levels + 1)))
    with pytest.MonkeyPatch.context() as context:
        context.setenv(VARIABLE, count)
        with patch.multiple(pieces, _ONE_CALL_VALUES=2**40, _SHARED_VALUES=2**40):
            expected = queue.values(queue.length, state, region)
        bands = patch.multiple(pieces, _ONE_CALL_VALUES=0, _BAND_ROWS=most, _SHARED_VALUES=1 + most)
        with bands, patch.object(values, "_KEPT_NUMBERS", 64 * most):
            found = queue.values(queue.length, state, region)
    assert list(found) == list(expected) == [0]
    for array, other in zip(found[0].arrays, expected[0].arrays, strict=True):
        assert array.dtype == other.dtype
        np.testing.assert_array_equal(array, other)


def test_channels_that_are_not_chosen_are_zero() -> None:
    heights = np.arange(60, dtype=np.float32).reshape(6, 10)
    decoder = ls.Decoder()
    decoder.feed(ls.encode(ls.Surface(heights, attributes={"one": heights + 1, "other": heights + 2})))
    header, queue = decoder.header, decoder._queue
    assert header is not None
    state = np.zeros((len(header.layout.tiles), header.channels), np.int8)
    chosen = np.array([True, False, True])
    region = Region.whole(header.layout, header.levels)
    arrays = queue.values(queue.length, state, region, chosen=chosen)[0].arrays
    assert [bool(array.any()) for array in arrays] == chosen.tolist()
    np.testing.assert_array_equal(arrays[0][..., 0], heights)
