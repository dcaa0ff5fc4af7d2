"""The codec of zarr, through zarr."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from zarr.registry import register_codec

import lodestream as ls
from lodestream.interop import zarr_codec
from lodestream.interop.zarr_codec import NAME, LodestreamCodec
from tests.core.surfaces import terrain

register_codec(
    NAME, LodestreamCodec
)  # as the entry point does; that one is tested in tests/client/test_entry_points.py


def made(path: Path, values: Any, chunks: tuple[int, ...], **options: Any) -> Any:
    array = zarr.create_array(
        path,
        shape=values.shape,
        chunks=chunks,
        dtype=values.dtype,
        serializer=LodestreamCodec(**options),
        compressors=None,
    )
    array[...] = values
    return array


def stored(path: Path) -> Any:
    """All values of an array that is opened anew."""
    return zarr.open_array(path)[:]


@pytest.mark.parametrize("dtype", ls.surface.DTYPES)
def test_every_type_comes_back_bit_for_bit(dtype: str, tmp_path: Path) -> None:
    values = np.abs(terrain((100, 90)) / 8).astype(dtype)
    array = made(tmp_path / "a.zarr", values, (64, 48))
    assert array.metadata.to_dict()["codecs"] == ({"name": NAME, "configuration": {}},)
    again = stored(tmp_path / "a.zarr")
    assert again.dtype == values.dtype
    assert again.tobytes() == values.tobytes()
    if dtype == "int16":
        assert array.nbytes_stored() < values.nbytes / 2


def test_nan_of_any_bits_infinities_and_chunks_of_holes_come_back(tmp_path: Path) -> None:
    values = terrain((64, 96)).astype("f4")
    values[3, 4], values[5, 6], values[7, 8] = np.nan, np.inf, -0.0
    values[:32, 32:64] = np.nan
    values.view("u4")[40, 70] = 0xFFC01234  # a NaN with bits of its own
    made(tmp_path / "a.zarr", values, (32, 32))
    assert stored(tmp_path / "a.zarr").tobytes() == values.tobytes()


def test_leading_axes_of_length_one_big_endian_values_and_small_chunks(tmp_path: Path) -> None:
    values = np.stack([terrain((20, 30), seed) for seed in range(3)]).astype(">f8")
    made(tmp_path / "a.zarr", values, (1, 16, 16))
    assert np.array_equal(stored(tmp_path / "a.zarr"), values)
    one = np.arange(6.0).reshape(2, 3)
    made(tmp_path / "b.zarr", one, (1, 1))
    assert np.array_equal(stored(tmp_path / "b.zarr"), one)


def test_a_precision_is_kept_in_the_metadata_and_holds(tmp_path: Path) -> None:
    values = terrain((128, 128))
    exact = made(tmp_path / "a.zarr", values, (64, 64))
    rough = made(tmp_path / "b.zarr", values, (64, 64), precision=0.5)
    assert rough.metadata.to_dict()["codecs"][0]["configuration"] == {"precision": "0.5"}
    again = stored(tmp_path / "b.zarr")
    assert 0 < np.abs(again - values).max() <= 0.5
    assert rough.nbytes_stored() < exact.nbytes_stored() / 2


@pytest.mark.parametrize(
    ("values", "precision"),
    [
        (np.linspace(-1, 1, 64).reshape(8, 8) * 1.7e308, None),
        ((np.linspace(-1, 1, 64).reshape(8, 8) * 3e38).astype("f4"), 0.5),
        ((np.arange(64).reshape(8, 8) * 1_000_003**2 % 2**31).astype("i4"), 0.5),
    ],
)
def test_chunks_that_no_container_holds_come_back_exactly(values: Any, precision: Any, tmp_path: Path) -> None:
    made(tmp_path / "a.zarr", values, (8, 8), precision=precision)
    assert stored(tmp_path / "a.zarr").tobytes() == values.tobytes()


@pytest.mark.parametrize(
    ("shape", "chunks", "dtype"), [((8, 8, 8), (2, 4, 4), "f4"), ((9,), (3,), "f4"), ((8, 8), (4, 4), "complex64")]
)
def test_other_chunks_and_types_are_refused(shape: Any, chunks: Any, dtype: str, tmp_path: Path) -> None:
    with pytest.raises(ls.OptionError):
        made(tmp_path / "a.zarr", np.zeros(shape, dtype), chunks)


@pytest.mark.parametrize(
    "data",
    [
        {"name": "zstd"},
        {"name": NAME, "configuration": {"level": 3}},
        {"name": NAME, "configuration": {"precision": "much"}},
    ],
)
def test_configurations_that_are_not_known_are_refused(data: Any) -> None:
    with pytest.raises(ls.OptionError):
        LodestreamCodec.from_dict(data)


def damaged() -> list[tuple[bytes, str]]:
    other = ls.encode(np.zeros((3, 3), "f4"))
    small = zarr_codec._PLAIN + zlib.compress(b"\0" * 3)
    large = zarr_codec._PLAIN + zlib.compress(b"\0" * (1 << 20))
    whole = zarr_codec._PLAIN + zlib.compress(bytes(range(128)))
    return [
        (b"", "expected a chunk of kind"),
        (b"Xabc", "expected a chunk of kind"),
        (b"C" + other, "expected int16 of shape"),
        (b"C" + other[:30], "cut short"),
        (b"Zabc", "compressed by zlib"),
        (small, "expected 128 bytes"),
        (large, "expected 128 bytes"),
        (whole[:-4], "expected 128 bytes"),
        (whole + b"more", "expected 128 bytes"),
    ]


@pytest.mark.parametrize(("data", "words"), damaged())
def test_damaged_chunks_are_refused(data: bytes, words: str) -> None:
    with pytest.raises((ls.StreamError, ls.LodestreamError), match=words):
        zarr_codec._decoded(data, (8, 8), np.dtype("i2"))


def test_how_long_a_chunk_becomes_is_not_known_before() -> None:
    with pytest.raises(NotImplementedError):
        LodestreamCodec().compute_encoded_size(128, None)  # type: ignore[arg-type]
