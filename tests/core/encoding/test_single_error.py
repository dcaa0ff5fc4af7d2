"""Streams made for one root mean square error: the error is kept and told, whatever the surface."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container import read_index
from lodestream.container.fields import FieldWriter
from lodestream.container.headers import parse_header, serialize_header
from lodestream.errors import CorruptStreamError, OptionError
from tests.examples import examples


def waves(rows: int, columns: int) -> NDArray[np.float64]:
    y, x = np.mgrid[:rows, :columns] / 8.0
    return np.asarray(np.sin(0.3 * x) * np.cos(0.2 * y) + 0.1 * np.sin(0.9 * x + 0.4 * y))


def _rms(original: NDArray[np.generic], found: NDArray[np.generic]) -> float:
    difference = original.astype(np.float64) - found.astype(np.float64)
    squares = difference**2 if difference.ndim == 2 else (difference[..., :3] ** 2).sum(axis=2)
    return math.sqrt(squares.mean())


def _extent(points: NDArray[np.generic]) -> float:
    flat = points.reshape(len(points) * points.shape[1], -1)[:, :3].astype(np.float64)
    return float(np.linalg.norm(flat.max(axis=0) - flat.min(axis=0)))


def _ragged(rng: np.random.Generator, shape: tuple[int, int], channels: int, dtype: str, scale: float) -> NDArray:  # type: ignore[type-arg]
    rough = np.stack([np.cumsum(rng.normal(size=shape), axis=1) for _ in range(max(channels, 1))], axis=-1)
    points = scale * (rough if channels else rough[..., 0])
    if np.dtype(dtype).kind == "i":
        return np.rint(np.clip(100 * points / scale, -30000, 30000)).astype(dtype)
    return points.astype(dtype)


@examples(18)
@given(
    shape=st.tuples(st.integers(1, 40), st.integers(2, 40)),
    channels=st.sampled_from([0, 0, 2, 3, 5]),
    closed=st.tuples(st.booleans(), st.booleans()),
    dtype=st.sampled_from(["float64", "float32", "int16"]),
    scale=st.sampled_from([1e-30, 1.0, 1e30]),
    rms=st.floats(1e-6, 0.5),
    seed=st.integers(0, 99),
)
def test_the_error_is_kept_and_told(
    shape: tuple[int, int],
    channels: int,
    closed: tuple[bool, bool],
    dtype: str,
    scale: float,
    rms: float,
    seed: int,
) -> None:
    points = _ragged(np.random.default_rng(seed), shape, channels, dtype, scale)
    container = ls.encode(ls.Surface(points, closed), rms=ls.Tolerance(rms, relative=True))
    decoder = ls.Decoder()
    decoder.feed(container)
    decoder.finish()
    found = decoder.surface().points
    wanted, told = rms * _extent(points), decoder.layers[-1].rms
    assert found.dtype == points.dtype
    assert found.shape == points.shape
    assert told <= wanted * (1 + 1e-12)
    assert told == pytest.approx(_rms(points, found), rel=1e-6, abs=1e-12 * _extent(points))
    if channels == 5:
        assert found[..., 3:].tobytes() == points[..., 3:].tobytes()
    errors = [layer.rms for layer in decoder.layers]
    assert errors == sorted(errors, reverse=True)


def test_it_takes_fewer_bytes_than_what_else_meets_the_error() -> None:
    points = waves(129, 170).astype(np.float64) + 0.02 * np.random.default_rng(5).normal(size=(129, 170))
    wanted = 2e-3 * _extent(points)
    made = ls.encode(points, rms="0.2%")
    index = read_index(lambda offset, length: made[offset : offset + length], len(made))
    exact = ls.encode(points)
    layers = read_index(lambda offset, length: exact[offset : offset + length], len(exact)).layers
    assert index.surface_end < 0.95 * next(layer.end for layer in layers if layer.rms <= wanted)
    assert index.surface_end < 0.95 * len(ls.encode(points, precision=math.sqrt(3) * wanted))
    assert index.header.quantiser is not None
    assert 0.99 * wanted < index.layers[-1].rms <= wanted


def test_windows_are_those_of_the_whole() -> None:
    points = waves(300, 310) + 0.05 * np.random.default_rng(6).normal(size=(300, 310))
    container = ls.encode(points, rms="0.5%")
    whole = ls.decode(container).points
    region = ((130, 190), (7, 60))
    decoder = ls.Decoder()
    decoder.feed(container)
    window = decoder.view().window(region)
    assert np.array_equal(window.points, whole[130:190, 7:60])


@pytest.mark.parametrize("wanted", [0, "0%", 1e-9])
def test_no_error_at_all_is_an_exact_stream(wanted: float | str) -> None:
    points = waves(30, 20).astype(np.float32)
    container = ls.encode(points, rms=wanted)
    assert ls.decode(container).points.tobytes() == points.tobytes()


def test_whole_numbers_stay_whole_where_that_is_shorter() -> None:
    terraces = np.repeat(np.repeat(np.arange(64, dtype=np.uint8).reshape(8, 8), 20, axis=0), 20, axis=1)
    container = ls.encode(terraces, rms=0.4)
    assert len(container) <= len(ls.encode(terraces))


def test_a_constant_is_a_constant() -> None:
    assert (ls.decode(ls.encode(np.full((4, 7), 2.5), rms="0.1%")).points == 2.5).all()


def test_either_a_precision_or_an_error() -> None:
    with pytest.raises(OptionError, match="not both"):
        ls.encode(waves(9, 9), 0.1, rms=0.1)


@pytest.mark.parametrize(
    ("base", "refused"), [(0, False), (1, False), (2**24 - 1, False), (2**24, True), (2**40, True)]
)
def test_steps_that_are_too_long_are_refused(base: int, refused: bool) -> None:
    made = ls.encode(waves(33, 40), rms="1%")
    header = read_index(lambda offset, length: made[offset : offset + length], len(made)).header
    assert header.quantiser is not None
    payload = serialize_header(header)[10:-4]
    place, own = 10, FieldWriter()  # after two codecs, flags, type, channels, layers, tile, chunk, large
    own.varint(header.quantiser.base)
    assert payload[place : place + len(own.data)] == own.data
    other = FieldWriter()
    other.varint(base)
    changed = memoryview(payload[:place] + other.data + payload[place + len(own.data) :])
    if refused:
        with pytest.raises(CorruptStreamError):
            parse_header(changed, 0, 0)
    else:
        quantiser = parse_header(changed, 0, 0).quantiser
        assert (0 if quantiser is None else quantiser.base) == base


@pytest.mark.parametrize("shape", [(641, 1153), (321, 385), (449, 449)])
def test_a_brief_stream_of_heights_takes_few_bytes_beside_its_segments(shape: tuple[int, int]) -> None:
    """At most 120 before the index, and 250 of metadata and index."""
    rows, columns = np.meshgrid(*(np.linspace(0, 9, n) for n in shape), indexing="ij")
    ridges = 400 * np.abs(np.sin(rows + np.cos(columns))) + 90 * np.sin(3 * columns - rows) * np.cos(2 * rows)
    ridges += 60 * np.sin(17 * rows + 5 * columns) + 40 * np.sin(23 * columns - 9 * rows)
    points = np.rint(1200 + ridges + np.random.default_rng(6).normal(size=shape)).astype(np.int16)
    made = ls.encode(points, rms="1%")
    index = read_index(lambda offset, length: made[offset : offset + length], len(made))
    segments = sum(segment.range.length for segment in index.segments)
    assert 500 < segments < 6000
    assert index.metadata.offset - segments <= 120
    assert index.metadata.length + index.index.length <= 250
