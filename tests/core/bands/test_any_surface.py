"""Any small surface by bands: the bytes of one piece, and from them the same values, windows and errors."""

from __future__ import annotations

import io
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.bands import made
from lodestream.bands.front import goes_by_bands
from lodestream.container.reader import read_index
from lodestream.decoding.inspection import inspect
from lodestream.decoding.piecewise import PiecewiseDecoder
from lodestream.encoding.prepared import prepare
from lodestream.quality import Quality
from lodestream.scratch import IN_MEMORY

from .test_building import built

#: What a container does not keep is another matter, see test_losses.
pytestmark = pytest.mark.filterwarnings("ignore:values of attributes at:lodestream.FormatWarning")

lengths = st.integers(1, 40) | st.integers(1, 300)
DTYPES = ["int8", "uint16", "int32", "int64", "uint64", "float32", "float64"]


def _values(dtype: str, shape: tuple[int, ...], kind: str, rng: np.random.Generator) -> NDArray[Any]:
    """Smooth ones, or any of which integers go to the ends of their range."""
    if kind == "ends":
        if dtype[0] == "f":
            return (rng.normal(size=shape) * 10.0 ** rng.integers(-30, 30, shape)).astype(dtype)
        limits = np.iinfo(dtype)
        ends = rng.choice(np.array([limits.min, limits.min + 1, 0, limits.max - 1, limits.max], dtype), shape)
        return np.where(rng.random(shape) < 0.3, ends, rng.integers(limits.min, limits.max, shape, dtype, True))
    waves = 60 + 50 * np.sin(np.arange(shape[0]) / 9)[:, None] * np.cos(np.arange(shape[1]) / 7)
    found = (waves.reshape(*shape[:2], *[1] * (len(shape) - 2)) + rng.normal(size=shape)).astype(dtype)
    if kind == "far":  # neighbours that float64 cannot tell apart, where integers are that wide
        found += np.array(np.iinfo(dtype).max - 120 if dtype[0] != "f" else 2**20, dtype)
    return found


def _surface(
    dtype: str, shape: tuple[int, int], channels: int, closed: tuple[bool, bool], kind: str, more: str, seed: int
) -> ls.Surface:
    rng = np.random.default_rng(seed)
    points = _values(dtype, shape if channels == 1 else (*shape, channels), kind, rng)
    mask, attributes = None, {}
    if "holes" in more:
        mask = rng.random(shape) < 0.9
        mask[rng.integers(0, shape[0]) :, : rng.integers(0, shape[1]) // 2] = False
        mask[0, -1] = True
    if "attributes" in more:
        attributes = {
            "id": _values("int64", shape, "ends", rng),
            "count": _values("uint64", (*shape, 2), "smooth", rng),
            "speed": _values("float32", shape, "smooth", rng),
        }
    return ls.Surface(points, closed, mask=mask, attributes=attributes)


@settings(max_examples=20, deadline=None)
@given(
    dtype=st.sampled_from(DTYPES),
    shape=st.tuples(lengths, lengths),
    channels=st.sampled_from([1, 1, 3]),
    closed=st.tuples(st.booleans(), st.booleans()),
    kind=st.sampled_from(["smooth", "far", "ends"]),
    more=st.sampled_from(["", "", "holes", "attributes", "holes and attributes"]),
    precision=st.sampled_from([None, "1e-3d", 0.5]),
    points=st.integers(1, 30_000),
    core=st.integers(1, 2000),
    threads=st.integers(1, 3),
    seed=st.integers(0, 2**32 - 1),
)
@example("int64", (300, 70), 1, (True, True), "ends", "holes", None, 1, 9, 2, 0)
@example("uint64", (298, 66), 1, (True, False), "far", "attributes", 0.5, 1, 9, 1, 1)
@example("int16", (286, 9), 3, (True, True), "smooth", "", "1e-3d", 1, 9, 1, 2)
@example("float64", (299, 33), 3, (True, True), "smooth", "holes and attributes", None, 1, 9, 1, 3)
@example("uint64", (260, 300), 3, (False, False), "ends", "holes", None, 3000, 9, 1, 4)
def test_bands_of_any_surface(
    dtype: str,
    shape: tuple[int, int],
    channels: int,
    closed: tuple[bool, bool],
    kind: str,
    more: str,
    precision: Any,
    points: int,
    core: int,
    threads: int,
    seed: int,
) -> None:
    assume(shape[0] * shape[1] > 2)
    surface = _surface(dtype, shape, channels, closed, kind, more, seed)
    assert goes_by_bands(surface, Quality.of(precision), 1, strict=True)
    try:
        whole = ls.encode(surface, precision)
    except ls.InputError:
        assume(False)  # this precision is too small for the values
    with ThreadPoolExecutor(threads) as executor, mock.patch.multiple(made, _FEWEST=1, _MOST=points):
        own = executor if seed % 2 else None
        assert ls.encode(surface, precision, memory=1 << 20, executor=own) == whole
    containers = {whole}
    if prepare(surface, Quality.of(precision)).arrangement is None:
        # Of noise the shortest of several streams is kept, and this is the first.
        containers.add(built(surface, points, core, threads, precision=precision))
        assert len(containers) == 1 or kind == "ends"
    for container in containers:
        _is_known_by_bands(container, np.random.default_rng(seed))


def _is_known_by_bands(container: bytes, rng: np.random.Generator) -> None:
    """Decoding by bands, a window and an inspection say of a container what decoding in memory does."""

    def read(offset: int, length: int) -> bytes:
        return container[offset : offset + length]

    expected = ls.decode(container)
    decoder = PiecewiseDecoder(read, read_index(read, len(container)))
    if decoder.header.plane is not None or decoder.header.arrangement is not None:
        return  # see test_several_blocks for what has several grids
    found = decoder.surface(IN_MEMORY, 1, lambda fraction: None)
    assert found.closed == expected.closed
    assert found.points.tobytes() == expected.points.tobytes()
    for name, values in expected.attributes.items():
        assert found.attributes[name].tobytes() == values.tobytes()
    region = tuple(tuple(sorted((int(rng.integers(0, n)), int(rng.integers(0, n) + 1)))) for n in expected.shape)
    (top, bottom), (left, right) = region
    if (bottom - top) * (right - left) > 1:
        place = slice(top, bottom), slice(left, right)
        mask = None if expected.mask is None else expected.mask[place]
        if mask is None or mask.any():
            whole = ls.Decoder()
            whole.feed(container)
            window = whole.layers[-1].window(((top, bottom), (left, right)))
            assert window.points.tobytes() == np.ascontiguousarray(expected.points[place]).tobytes()
    inspect(io.BytesIO(container), max_vertices=1 << 20, memory=1)
