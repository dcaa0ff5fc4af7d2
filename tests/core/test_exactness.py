from __future__ import annotations

import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from lodestream.errors import CorruptStreamError
from lodestream.exactness import difference, restore

DTYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]


def assert_same_bits(a: NDArray[Any], b: NDArray[Any]) -> None:
    assert a.dtype == b.dtype
    assert a.shape == b.shape
    assert a.tobytes() == b.tobytes()


@pytest.mark.parametrize("dtype", DTYPES)
@given(data=st.data())
def test_any_values_restore_any_others(dtype: str, data: st.DataObject) -> None:
    kind = np.dtype(dtype)
    elements = (
        st.integers(int(np.iinfo(kind).min), int(np.iinfo(kind).max))
        if kind.kind in "iu"
        else st.floats(allow_nan=False, allow_infinity=False, width=32 if kind.itemsize == 4 else 64)
    )
    original, picture = (data.draw(arrays.arrays(kind, (3, 5), elements=elements)) for _ in range(2))
    payload = difference(original, picture)
    assert_same_bits(restore(picture, payload, 0) if payload else picture, original)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_signed_zeros_subnormals_and_extremes_come_back(dtype: str) -> None:
    info = np.finfo(dtype)
    extremes = [0.0, -0.0, info.tiny, -info.tiny, info.smallest_subnormal, -info.smallest_subnormal, info.max, info.min]
    original = np.array([extremes, extremes[::-1]], dtype)
    for picture in (np.zeros_like(original), original[::-1].copy(), np.full_like(original, -1e30)):
        assert_same_bits(restore(picture, difference(original, picture), 0), original)


@pytest.mark.parametrize("dtype", ["int64", "uint64"])
def test_the_extremes_of_64_bits_come_back(dtype: str) -> None:
    limits = np.iinfo(dtype)
    original = np.array([[limits.min, limits.max, 0, 1]], dtype)
    assert_same_bits(restore(original[:, ::-1], difference(original, original[:, ::-1]), 0), original)


@pytest.mark.parametrize("dtype", DTYPES)
def test_equal_values_need_nothing(dtype: str) -> None:
    values = np.arange(12).reshape(3, 4).astype(dtype)
    assert difference(values, values.copy()) == b""


def test_a_negative_zero_needs_something() -> None:
    assert difference(np.array([[-0.0]]), np.array([[0.0]]))


def test_near_values_take_fewer_bytes_than_far_ones() -> None:
    original = np.random.default_rng(0).normal(size=(100, 100)).astype(np.float32)
    near = np.nextafter(original, np.float32(0))
    far = original + np.float32(1)
    assert len(difference(original, near)) < 0.1 * original.nbytes < len(difference(original, far))


def test_arrays_need_not_be_contiguous() -> None:
    values = np.random.default_rng(1).normal(size=(6, 8, 3))
    original, picture = values[::2, ::-1], values[1::2] + 1
    assert_same_bits(restore(picture, difference(original, picture), 0), np.ascontiguousarray(original))


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"not compressed",
        zlib.compress(bytes(47)),
        zlib.compress(bytes(49)),
        zlib.compress(bytes(48))[:-6],
        zlib.compress(bytes(50_000_000)),
    ],
)
def test_a_payload_that_does_not_fit_is_corrupt(payload: bytes) -> None:
    with pytest.raises(CorruptStreamError, match="exactness") as caught:
        restore(np.zeros((2, 3)), payload, 77)
    assert caught.value.offset == 77
