from __future__ import annotations

import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from lodestream.entropy.mask import decode_mask, encode_mask
from lodestream.errors import CorruptStreamError
from tests.reference import masks as reference

Mask = NDArray[np.bool_]


def blobs(shape: tuple[int, int], seed: int) -> Mask:
    """A few discs of holes."""
    rng = np.random.default_rng(seed)
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    mask = np.ones(shape, np.bool_)
    for _ in range(12):
        row, column, radius = rng.integers(shape[0]), rng.integers(shape[1]), rng.integers(2, 30)
        mask &= (rows - row) ** 2 + (columns - column) ** 2 > radius**2
    return mask


@given(arrays.arrays(np.bool_, st.tuples(st.integers(1, 40), st.integers(1, 70))))
def test_every_mask_comes_back(mask: Mask) -> None:
    assert np.array_equal(decode_mask(encode_mask(mask), mask.shape, 0), mask)


@given(shape=st.tuples(st.integers(1, 200), st.integers(1, 200)), seed=st.integers(0, 2**32))
def test_masks_of_blobs_come_back(shape: tuple[int, int], seed: int) -> None:
    mask = blobs(shape, seed)
    assert np.array_equal(decode_mask(encode_mask(mask), shape, 0), mask)


@given(mask=arrays.arrays(np.bool_, st.tuples(st.integers(1, 9), st.integers(1, 70))), at_once=st.integers(1, 7))
def test_calls_that_end_within_a_row_change_nothing(mask: Mask, at_once: int) -> None:
    data = encode_mask(mask)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lodestream.entropy.mask._GROUPS_PER_CALL", at_once)
        assert encode_mask(mask) == data
        assert np.array_equal(decode_mask(data, mask.shape, 0), mask)


def test_a_mask_takes_less_than_half_of_what_a_general_compressor_takes() -> None:
    mask = blobs((300, 400), 1)
    assert len(encode_mask(mask)) < 0.5 * len(zlib.compress(np.packbits(mask).tobytes(), 9))


def test_noise_costs_little_more_than_a_bit_a_point() -> None:
    mask = np.random.default_rng(0).random((200, 300)) < 0.5
    assert len(encode_mask(mask)) < 1.04 * mask.size / 8


@pytest.mark.parametrize("value", [False, True])
def test_a_uniform_mask_costs_next_to_nothing(value: bool) -> None:
    assert len(encode_mask(np.full((1000, 1000), value))) < 20


@given(data=st.binary(max_size=60), shape=st.tuples(st.integers(1, 50), st.integers(1, 50)))
def test_any_bytes_are_a_mask_or_too_many(data: bytes, shape: tuple[int, int]) -> None:
    offset: int | None = None
    try:
        mask = decode_mask(data, shape, 100)
    except CorruptStreamError as error:
        offset = error.offset
        mask = decode_mask(data[: (offset or 0) - 100], shape, 100)
    assert offset is None or 104 <= offset < 100 + len(data)
    assert mask.shape == shape


def test_missing_bytes_count_as_zeros() -> None:
    data = encode_mask(blobs((60, 60), 2))
    for cut in range(len(data)):
        mask = decode_mask(data[:cut], (60, 60), 0)
        assert np.array_equal(decode_mask(data[:cut] + bytes(min(cut, 1)), (60, 60), 0), mask)


def test_bytes_left_over_are_named() -> None:
    data = encode_mask(blobs((60, 60), 3))
    with pytest.raises(CorruptStreamError, match="expected a mask of at most") as caught:
        decode_mask(data + bytes(9), (60, 60), 1000)
    assert caught.value.offset is not None
    assert 1000 + len(data) <= caught.value.offset <= 1004 + len(data)


def test_the_reference_reads_the_same() -> None:
    for seed in range(8):
        mask = blobs((24 + seed, 50 - 3 * seed), seed)
        assert np.array_equal(reference.decode_mask(encode_mask(mask), *mask.shape), mask)
