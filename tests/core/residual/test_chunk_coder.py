from __future__ import annotations

import itertools
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from lodestream.errors import CorruptStreamError, StreamError
from lodestream.quantization.lattice import offset_lattice
from lodestream.residual import chunk_coder
from lodestream.residual.chunk_coder import decode_chunk, encode_chunk
from lodestream.residual.number_line import PATTERNS, from_line
from lodestream.residual.offsets import code_offsets, places_of, values_at
from tests.reference import residual as reference

Values = NDArray[Any]

DTYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]


def assert_same_bits(a: NDArray[Any], b: NDArray[Any]) -> None:
    assert a.dtype == b.dtype
    assert a.shape == b.shape
    assert a.tobytes() == b.tobytes()


def normal(dtype: str, count: int = 5000) -> Values:
    return np.random.default_rng(0).normal(size=count).astype(dtype)


def on_lattice(values: Values, step: float) -> Values:
    """What a lattice of this step restores."""
    return np.asarray((np.rint(values.astype(np.float64) / step) * step).astype(values.dtype))


def assert_comes_back(original: Values, restored: Values) -> bytes:
    data = encode_chunk(original, restored)
    assert len(data) <= original.nbytes + 1
    assert_same_bits(decode_chunk(restored, data, 0), original)
    return data


@pytest.mark.parametrize("dtype", DTYPES)
@given(data=st.data())
def test_any_values_restore_any_others(dtype: str, data: st.DataObject) -> None:
    kind = np.dtype(dtype)
    if kind.kind in "iu":
        integers = st.integers(int(np.iinfo(kind).min), int(np.iinfo(kind).max))
        original, restored = (data.draw(arrays.arrays(kind, 30, elements=integers)) for _ in range(2))
    else:
        finite = st.floats(allow_nan=False, allow_infinity=False, width=32 if kind.itemsize == 4 else 64)
        # Patterns rather than values: every NaN is one of its own.
        original = data.draw(arrays.arrays(f"u{kind.itemsize}", 30)).view(kind)
        restored = data.draw(arrays.arrays(kind, 30, elements=finite))
    assert_comes_back(original, restored)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_what_is_no_usual_number_comes_back(dtype: str) -> None:
    info = np.finfo(dtype)
    zeros = [0.0, -0.0, info.tiny, -info.tiny, info.smallest_subnormal, -info.smallest_subnormal]
    original = np.array([*zeros, info.max, info.min, np.nan, -np.nan, np.inf, -np.inf] * 3, dtype)
    for restored in (np.zeros_like(original), np.full_like(original, -1e30), np.full_like(original, info.max)):
        assert_comes_back(original, restored)


def test_many_kinds_of_nan_come_back() -> None:
    original = (np.arange(100, dtype=np.uint32) + np.uint32(0x7FC00000)).view(np.float32)
    assert_comes_back(original, np.zeros(100, np.float32))


@pytest.mark.parametrize("dtype", ["int64", "uint64"])
def test_the_extremes_of_64_bits_come_back(dtype: str) -> None:
    limits = np.iinfo(dtype)
    original = np.array([limits.min, limits.max, 0, 1] * 10, dtype)
    assert_comes_back(original, original[::-1])


def test_a_difference_whose_magnitude_has_64_bits_comes_back() -> None:
    original, restored = np.arange(40), np.arange(40)
    original[7], restored[7] = 0, np.iinfo(np.int64).min
    assert_comes_back(original, restored)


@pytest.mark.parametrize("dtype", DTYPES)
def test_equal_values_need_nothing(dtype: str) -> None:
    values = np.arange(12).astype(dtype)
    assert encode_chunk(values, values.copy()) == b""
    assert_same_bits(decode_chunk(values, b"", 0), values)


def test_a_negative_zero_needs_something() -> None:
    assert encode_chunk(np.array([-0.0]), np.array([0.0]))


@pytest.mark.parametrize(("dtype", "step"), [("float32", 2.0**-18), ("float32", 1e-5), ("float64", 2.0**-18)])
def test_noise_costs_little_more_than_its_bits(dtype: str, step: float) -> None:
    values = normal(dtype, 60000)
    spacing = np.spacing(np.abs(values)).astype(np.float64)
    bits = float(np.log2(np.maximum(step / spacing, 1.0)).sum())
    assert len(assert_comes_back(values, on_lattice(values, step))) < 1.01 * bits / 8 + 0.06 * values.size


def planes(original: Values, restored: Values) -> int:
    """Bytes of what a general compressor makes of the differences, the least significant bytes first."""
    kind = f"u{original.dtype.itemsize}"
    delta = (original.view(kind) - restored.view(kind)).reshape(-1, 1).view(np.uint8)
    return len(zlib.compress(np.ascontiguousarray(delta.T).tobytes(), 9))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_noise_costs_less_than_a_general_compressor_needs(dtype: str) -> None:
    values = normal(dtype, 20000)
    restored = on_lattice(values, 2.0**-17)
    assert len(encode_chunk(values, restored)) < 0.95 * planes(values, restored)


def test_zeros_at_the_end_of_all_patterns_cost_nothing() -> None:
    single, restored = normal("float32"), on_lattice(normal("float32"), 1e-5)
    double = assert_comes_back(single.astype(np.float64), on_lattice(single.astype(np.float64), 1e-5))
    assert len(double) < 1.02 * len(encode_chunk(single, restored)) + 20


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_decimals_cost_what_their_places_do(dtype: str) -> None:
    values = np.round(np.random.default_rng(3).random(10000) * (100 if dtype == "float64" else 10), 6).astype(dtype)
    assert len(assert_comes_back(values, on_lattice(values, 64e-6))) < 10000 * 6.3 / 8


def test_values_that_repeat_cost_next_to_nothing() -> None:
    values = np.tile(normal("float32", 500), 40)
    assert len(assert_comes_back(values, on_lattice(values, 1e-4))) < 500 * 4 + values.size * 0.02


def test_a_few_holes_in_an_attribute_cost_little() -> None:
    values = normal("float32", 20000)
    restored = on_lattice(values, 1e-5)
    usual = len(encode_chunk(values, restored))
    values[300:400] = np.nan
    assert len(assert_comes_back(values, restored)) < usual + 40


def test_arrays_need_not_be_contiguous() -> None:
    values = normal("float64", 300)
    assert_comes_back(values[::3], values[1::3])


def blocks(shape: tuple[int, int], step: float, seed: int) -> Values:
    """Terrain on a lattice, each 8 x 8 of it off by as much."""
    rng = np.random.default_rng(seed)
    steps = np.rint(np.cumsum(rng.normal(size=shape), 1) * 5)
    offsets = np.repeat(np.repeat(rng.random((-(-shape[0] // 8), -(-shape[1] // 8))), 8, 0), 8, 1)
    return (steps * step + offsets[: shape[0], : shape[1]] * step + 20).astype(np.float32)


@pytest.mark.parametrize("step", [0.02, 0.3048, 7.0])
def test_offsets_that_repeat_cost_little(step: float) -> None:
    values = blocks((128, 128), step, 1)
    lattice = offset_lattice(values)
    assert lattice is not None
    assert lattice.step == pytest.approx(step, rel=1e-6)
    restored = lattice.values(lattice.coordinates(values), values.dtype).ravel()
    data = encode_chunk(values.ravel(), restored, lattice.step)
    assert_same_bits(decode_chunk(restored, data, 0), values.ravel())
    assert len(data) < 0.35 * len(encode_chunk(values.ravel(), restored))
    for cut in range(9, len(data), 97):
        assert decode_chunk(restored, data[:cut], 0).shape == restored.shape
    with pytest.raises(CorruptStreamError, match="at most"):
        decode_chunk(restored, data + bytes(9), 0)


def test_offsets_of_damaged_chunks_are_those_of_the_reference() -> None:
    rng, step = np.random.default_rng(3), 0.02
    offsets = np.repeat(rng.normal(size=16) * 100 * (np.arange(16) % 4 > 0), 64)
    original = (np.rint(9 * rng.normal(size=offsets.size)) * step + offsets).astype(np.float32)
    restored = (np.rint(original.astype(np.float64) / step) * step).astype(np.float32)
    chunk = encode_chunk(original, restored, step)
    assert chunk[0] & 3 == 3
    assert np.count_nonzero(original == 0), "the place of 0 is sought"
    for changed in range(9, len(chunk), 3):
        damaged = bytearray(chunk)
        damaged[changed] ^= 85
        try:
            values = reference.restore(bytes(damaged), restored)
        except StreamError:
            continue  # the damaged string ends sooner
        assert values.tobytes() == decode_chunk(restored, bytes(damaged), 0).tobytes()


def test_a_step_without_offsets_changes_nothing() -> None:
    values = normal("float32")
    restored = on_lattice(values, 1e-4)
    assert encode_chunk(values, restored, 1e-4) == encode_chunk(values, restored)


@given(
    data=st.binary(max_size=200),
    rule=st.sampled_from([0, 1, 2, 3, 1 | 29 << 2, 2 | 6 << 2, 3 | 20 << 2]),
    dtype=st.sampled_from(DTYPES),
)
def test_any_bytes_are_values_or_refused(data: bytes, rule: int, dtype: str) -> None:
    restored = normal("float64", 40).astype(dtype)
    payload = bytes([rule]) + data
    try:
        values = decode_chunk(restored, payload, 1000)
    except CorruptStreamError as error:
        values, offset = restored, error.offset
    else:
        offset = 1000
    assert values.shape == restored.shape
    assert values.dtype == restored.dtype
    assert offset is not None
    assert 1000 <= offset <= 1000 + len(payload)


def test_the_values_themselves_take_no_argument() -> None:
    values = normal("float32", 40)
    data = encode_chunk(values, on_lattice(values, 1e-4))
    for argument in (1, 63):
        with pytest.raises(CorruptStreamError, match="rule of residual") as error:
            decode_chunk(values, bytes([argument << 2]) + data[1:], 7)
        assert error.value.offset == 7


def test_every_prefix_is_refused() -> None:
    values = normal("float32", 500)
    restored = on_lattice(values, 1e-4)
    data = encode_chunk(values, restored)
    for cut in range(1, len(data)):
        with pytest.raises(CorruptStreamError):
            decode_chunk(restored, data[:cut], 0)
    with pytest.raises(CorruptStreamError, match="lower bits"):
        decode_chunk(restored, data + b"\0", 0)


def samples() -> list[tuple[Values, Values]]:
    """Originals and what a lattice restores of them."""
    wide = (normal("float64", 300) * 1e9).astype(np.int64)
    floats = [normal(dtype, 300) for dtype in ("float32", "float64")]
    heights = blocks((16, 16), 0.02, 2).ravel()
    return [
        (wide, wide // 1000 * 1000),
        (heights, on_lattice(heights, 0.02)),
        *((values, on_lattice(values, 1e-4)) for values in floats),
    ]


def test_the_reference_reads_the_same() -> None:
    rules = set()
    for values, restored in samples():
        chunk = encode_chunk(values, restored, 0.02)
        assert reference.restore(chunk, restored).tobytes() == values.tobytes()
        assert decode_chunk(restored, chunk, 0).tobytes() == values.tobytes()
        rules.add(chunk[0] & 3)
    assert rules == {1, 3}


@given(
    places=st.lists(st.integers(-(2**63), 2**63 - 1) | st.integers(-(2**32), 2**32), min_size=1, max_size=20),
    argument=st.integers(0, 63),
    dtype=st.sampled_from(["i1", "u2", "i4", "u8", "f4", "f8"]),
)
def test_any_place_has_the_value_that_the_reference_gives_it(places: list[int], argument: int, dtype: str) -> None:
    kind, given_places = np.dtype(dtype), np.array(places, np.int64)
    argument %= 8 * kind.itemsize
    expected = reference._values(given_places, kind, 1, argument)
    assert from_line(PATTERNS, argument, given_places, kind).tobytes() == expected.tobytes()


def test_a_chunk_of_one_byte_more_than_plain_values_is_refused() -> None:
    """Whatever it holds: the encoder stores plain values where nothing is shorter."""
    rng, lengths = np.random.default_rng(1), set[int]()
    for size, most in itertools.product(range(1, 60), (1, 2, 4, 8, 16, 32)):
        restored = rng.integers(-60, 60, size).astype(np.int8)
        original = (restored + rng.integers(-most, most + 1, size)).astype(np.int8)
        (data,) = chunk_coder._with_differences(PATTERNS, 0, original, restored, np.zeros(0, np.uint8))
        lengths.add(len(data) - size)
        if len(data) > size + 1:
            with pytest.raises(CorruptStreamError, match=f"at most {1 + size} bytes of residual"):
                decode_chunk(restored, data, 0)
        else:
            np.testing.assert_array_equal(decode_chunk(restored, data, 0), original)
    assert {1, 2} <= lengths


def test_offsets_end_where_the_last_value_does() -> None:
    """Bytes that are looked at may be there, as zeros; one more is refused."""
    step = 0.01
    restored = (np.arange(400) // 7 * step).astype(np.float32)
    original = (restored.astype(np.float64) + np.where(np.arange(400) < 200, 0.003, 0.004)).astype(np.float32)
    (data,) = chunk_coder._with_offsets(original, restored, step)
    places = np.zeros(400, np.int64)
    coded = np.frombuffer(data[9:], np.uint8).copy()
    looked_at = code_offsets(True, restored, step, data[0] >> 2, places, coded)
    whole = data[: 9 + looked_at].ljust(9 + looked_at, b"\0")
    assert decode_chunk(restored, whole, 0).tobytes() == original.tobytes()
    with pytest.raises(CorruptStreamError, match=f"at most {9 + looked_at} bytes"):
        decode_chunk(restored, whole + b"\0", 0)


def test_places_beyond_the_last_float32_have_the_last_pattern() -> None:
    patterns = np.array([0, 1, 0x7FFFFFFF, 0x80000000, 0x80000001, 0xFFFFFFFE, 0xFFFFFFFF], np.uint32)
    places = places_of(patterns.view(np.float32))
    assert places.tolist() == [0, 1, 2**31 - 1, -1, -2, -(2**31) + 1, -(2**31)]
    np.testing.assert_array_equal(values_at(places).view(np.uint32), patterns)
    beyond = np.array([2**31, 2**40, -(2**31) - 1, -(2**40)], np.int64)
    assert values_at(beyond).view(np.uint32).tolist() == [0x7FFFFFFF] * 2 + [0xFFFFFFFF] * 2


@pytest.mark.parametrize("size", [2, 3, 4])
def test_the_length_of_what_is_coded_may_take_four_bytes(size: int) -> None:
    """Also where fewer would do, as other writers may have it."""
    values = normal("float32", 500)
    restored = on_lattice(values, 1e-4)
    (data,) = chunk_coder._with_differences(PATTERNS, 0, values, restored, np.zeros(0, np.uint32))
    length, end = chunk_coder._read_length(data, 3)
    assert 128 <= length < 1 << 14
    groups = [length >> shift & 127 for shift in range(0, 7 * size, 7)]
    longer = bytes([group | 128 for group in groups[:-1]] + groups[-1:])
    data = data[:3] + longer + data[end:]
    assert reference.restore(data, restored).tobytes() == values.tobytes()
    assert_same_bits(decode_chunk(restored, data, 0), values)
    for number in (127, 128, 2**14 - 1, 2**14, 2**21 - 1, 2**21, 2**28 - 1):
        written = chunk_coder._written_length(number)
        assert chunk_coder._read_length(written, 0) == (number, len(written))
