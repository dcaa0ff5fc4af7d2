from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream import InputError, OptionError
from lodestream.container import describe
from lodestream.container.model import Header
from lodestream.decoding.measurer import Measured
from lodestream.encoding import phases
from lodestream.encoding.layers import MeasuredLayer, State, kept_layers

from ..surfaces import SAMPLES, contained, encoded, errors, index_of, is_told, terrain, torus

DTYPES = ["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]
CLOSURES = [(False, False), (False, True), (True, False), (True, True)]
SHAPES = [
    (1, 2),
    (2, 1),
    (2, 2),
    (1, 9),
    (3, 3),
    (5, 4),
    (4, 6, 2),
    (7, 1, 3),
    (6, 5, 3),
    (5, 5, 4),
    (3, 8, 6),
    (17, 12),
]


def assert_comes_back(points: NDArray[Any], closed: tuple[bool, bool] = (False, False)) -> bytes:
    container = ls.encode(ls.Surface(points, closed))
    surface = ls.decode(container)
    assert surface.closed == closed
    assert surface.points.dtype == points.dtype.newbyteorder("=")
    assert surface.points.shape == points.shape
    assert surface.points.tobytes() == points.astype(surface.points.dtype).tobytes()
    return container


def kinds(shape: tuple[int, ...], dtype: str) -> dict[str, NDArray[Any]]:
    """Smooth, random over the whole range of the type, constant, and as far apart as can be."""
    kind, rng = np.dtype(dtype), np.random.default_rng(len(shape))
    count = int(np.prod(shape))
    if kind.kind == "f":
        low, high = (-3.4e38, 3.4e38) if dtype == "float32" else (-1e300, 1e300)
        random = rng.normal(size=count) * 10 ** rng.uniform(-30, 30, count)
    else:
        low, high = np.iinfo(kind).min, np.iinfo(kind).max
        random = np.frombuffer(rng.bytes(count * kind.itemsize), kind)
    edges = np.array([low, high], kind)
    return {
        "smooth": np.arange(count).reshape(shape).astype(dtype),
        "random": random.reshape(shape).astype(dtype),
        "constant": np.full(shape, 77, dtype),
        "extremes": edges[np.indices(shape).sum(axis=0) % 2],
    }


@pytest.mark.sweep(4)
@pytest.mark.parametrize("dtype", DTYPES)
def test_every_type_shape_and_closure_comes_back_bit_for_bit(dtype: str) -> None:
    for number, shape in enumerate(SHAPES):
        for turn, points in enumerate(kinds(shape, dtype).values()):
            assert_comes_back(points, CLOSURES[(number + turn) % 4])


@pytest.mark.parametrize("closed", CLOSURES)
@pytest.mark.long
def test_every_pair_of_small_sizes_comes_back(closed: tuple[bool, bool]) -> None:
    for rows, columns in itertools.product(range(1, 8), repeat=2):
        if rows * columns > 1:
            assert_comes_back(terrain((rows, columns)), closed)


@pytest.mark.parametrize("scale", [1e-310, 1e-200, 1e-30, 1e-5, 1.0, 1e5, 1e30, 1e200])
def test_every_scale_comes_back_with_errors_that_are_told(scale: float) -> None:
    for points in (terrain((20, 20)) * scale, torus(12, 10, "float64") * scale):
        index = index_of(assert_comes_back(points))
        told = [layer.rms / scale for layer in index.layers[:-1]]
        assert all(0 < rms < 1e3 for rms in told)


def test_signed_zeros_subnormals_and_spikes_come_back() -> None:
    for dtype in ("float32", "float64"):
        info = np.finfo(dtype)
        odd = np.array([0.0, -0.0, info.smallest_subnormal, -info.tiny, info.eps, 1.0, 0.1], dtype)
        assert_comes_back(np.random.default_rng(0).choice(odd, (11, 13)))
        assert_comes_back(np.full((5, 5), -0.0, dtype))
        spike = np.zeros((90, 90), dtype)
        spike[0, 1] = np.pi
        assert_comes_back(spike)


@given(
    rows=st.integers(1, 24),
    columns=st.integers(2, 24),
    channels=st.sampled_from([0, 2, 3, 4]),
    closed=st.sampled_from(CLOSURES),
    dtype=st.sampled_from(DTYPES),
    bits=st.integers(0, 63),
    seed=st.integers(0, 2**32),
)
def test_any_surface_comes_back(
    rows: int, columns: int, channels: int, closed: tuple[bool, bool], dtype: str, bits: int, seed: int
) -> None:
    shape = (rows, columns, channels) if channels else (rows, columns)
    integers = np.random.default_rng(seed).integers(-(2**bits), 2**bits, shape)
    assert_comes_back(
        integers.astype(dtype) / np.dtype(dtype).type(8) if dtype[0] == "f" else integers.astype(dtype), closed
    )


def test_several_tiles_and_either_byte_order_come_back() -> None:
    heights = np.rint(terrain((420, 400))).astype(">i2")
    container = assert_comes_back(heights)
    assert len(index_of(container).header.layout.tiles) > 12
    assert ls.encode(heights) == ls.encode(heights.astype("<i2")) == ls.encode(ls.Surface(heights.astype("=i2")))
    assert_comes_back(np.cumsum(np.random.default_rng(0).normal(size=(26000, 1)), axis=0))
    assert_comes_back(torus(3, 9000))


def test_the_same_surface_makes_the_same_container() -> None:
    for name in SAMPLES:
        assert encoded(name) == contained(name)[0]


@given(
    dtype=st.sampled_from(["float32", "float64", "int16", "uint8", "int64"]),
    closed=st.sampled_from(CLOSURES),
    channels=st.sampled_from([0, 2, 3]),
    exponent=st.floats(-3.5, 1),
    scale=st.sampled_from([1e-30, 1e-3, 1.0, 1e30]),
    seed=st.integers(0, 2**32),
)
def test_with_a_precision_the_largest_error_is_never_above_it(
    dtype: str, closed: tuple[bool, bool], channels: int, exponent: float, scale: float, seed: int
) -> None:
    shape = (9, 11, channels) if channels else (9, 11)
    points = np.random.default_rng(seed).uniform(-100, 100, shape) * (scale if dtype[0] == "f" else 1)
    points = np.abs(points).astype(dtype)
    precision = 100 * 10**exponent * (scale if dtype[0] == "f" else 1)
    container = ls.encode(ls.Surface(points, closed), precision)
    kept = ls.decode(container).points
    assert errors(points, kept)[1] <= precision
    last = index_of(container).layers[-1]
    assert last.max_error <= precision
    assert index_of(container).header.exact == (kept.tobytes() == points.tobytes())


def test_a_precision_is_a_number_a_text_or_a_tolerance() -> None:
    points = terrain((20, 20))
    extent = float(np.ptp(points))
    relative = ls.encode(points, "0.1%")
    assert ls.encode(points, ls.Tolerance(1e-3, relative=True)) == relative
    assert ls.encode(points, extent * 1e-3) == relative
    assert len(relative) < len(ls.encode(points))
    assert ls.decode(ls.encode(np.ones((4, 4)), "0.1%")).points.tolist() == np.ones((4, 4)).tolist()
    with pytest.raises(OptionError, match="is not an error bound: write 0 or more"):
        ls.encode(points, "fine")
    for refused in (0.0, 1e-15):
        with pytest.raises(InputError, match="expected a precision"):
            ls.encode(points, refused)


@pytest.mark.parametrize("name", SAMPLES)
def test_errors_never_rise_from_layer_to_layer_and_end_at_nothing(name: str) -> None:
    _, index = contained(name)
    rms = [layer.rms for layer in index.layers]
    assert rms == sorted(rms, reverse=True)
    assert 1 <= len(index.layers) <= 24
    if index.header.exact:
        assert (index.levels[-1].rms, index.levels[-1].max_error) == (0.0, 0.0)
        assert index.residual is not None or rms[-1] == 0.0
    else:
        assert name == "precision"


def test_a_layer_that_would_raise_the_error_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    points = terrain((40, 33), 1)
    told = [layer.rms for layer in index_of(ls.encode(points, 0.5)).layers]
    assert len(told) > 5

    def layers_when(raised: int, wrong: float) -> list[float]:
        """What is told if the layer of this number had an error of ``wrong``."""

        def kept(header: Header, states: list[State], found: list[Measured]) -> list[MeasuredLayer]:
            errors, cells = found[raised]
            changed = [*found[:raised], (errors._replace(rms=wrong), cells), *found[raised + 1 :]]
            return kept_layers(header, states, changed)

        monkeypatch.setattr(phases, "kept_layers", kept)
        return [layer.rms for layer in index_of(ls.encode(points, 0.5)).layers]

    assert layers_when(3, told[2] * 1.5) == told[:3] + told[4:]
    # The complete surface is always there, whatever its error.
    last = len(told) - 1
    assert layers_when(last, told[-3] * 1.01) == pytest.approx([*told[:-3], told[-3] * 1.01], rel=1e-5)


@pytest.mark.parametrize(
    "points",
    [
        np.rint(10 * terrain((300, 280))).astype(np.int32),
        terrain((280, 300), 1).astype(np.float32),
        np.rint(2**14 * torus(300, 200)) / 2**14 + np.random.default_rng(0).normal(0, 1e-3, (300, 200, 3)),
        np.cumsum(np.cumsum(np.random.default_rng(1).integers(-9, 10, (257, 200)), axis=0), axis=1).astype(np.int16),
    ],
    ids=["metres", "float32", "xyz", "walk"],
)
def test_stops_come_often(points: NDArray[Any]) -> None:
    """Above 4 kB a layer ends at most 16 % after the last one, unless one has moved, or adds a single pass."""
    index = index_of(ls.encode(points))
    ends = [layer.end for layer in index.layers]
    assert ends[-1] > 30_000
    added = [[segment.passes for segment in index.segments if segment.layer == n] for n in range(len(ends))]
    steps = [(n, ends[n] / ends[n - 1]) for n in range(1, len(ends)) if ends[n - 1] > 4096]
    longer = [growth for n, growth in steps if growth > 1.16 and added[n] != [1]]
    assert len(longer) <= 3
    assert all(growth < 1.25 for growth in longer)
    assert np.mean([growth for _, growth in steps]) > 1.08


@pytest.mark.parametrize("name", SAMPLES)
def test_framing_costs_little(name: str) -> None:
    """Header and tables: 700 bytes and 1 % of any prefix for one channel."""
    _, index = contained(name)
    if index.header.channels == 1:
        for layer in index.layers:
            coded = sum(segment.range.length for segment in index.segments if segment.layer <= layer.number)
            assert layer.end - coded <= 700 + 0.01 * layer.end
        assert index.header.length <= 96
    assert index.header.length <= 256


@pytest.mark.parametrize("kind", ["small", "precision", "for one error", "noise"])
def test_progress_rises_to_one(kind: str) -> None:
    told: list[float] = []
    if kind == "small":
        ls.encode(terrain((40, 40)), progress=told.append)
    elif kind == "precision":
        ls.encode(terrain((70, 70)), 20.0, progress=told.append)
    elif kind == "for one error":
        ls.encode(terrain((70, 70)), rms=1.0, progress=told.append)
    else:
        ls.encode(np.random.default_rng(1).random((70, 70)), progress=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert all(0 <= fraction <= 1 for fraction in told)


def test_metadata_come_back_as_they_were() -> None:
    metadata = {
        "name": "é",
        "geotransform": [0.5, 1.0, 0.0, 2.0, 0.0, -1.0],
        "a": {"b": [1, None, True]},
        "raw": b"\x00",
    }
    container = ls.encode(ls.Surface(np.ones((3, 3)), metadata=metadata))
    assert ls.decode(container).metadata == metadata
    assert describe(index_of(container))["metadata"] == metadata
    for refused in (object(), 2**70, {1, 2}):
        with pytest.raises(InputError, match="MessagePack"):
            ls.encode(ls.Surface(np.ones((3, 3)), metadata={"a": refused}))


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((1, 1)),
        np.zeros(9),
        np.zeros((3, 3, 1)),
        np.zeros((0, 3)),
        np.array([["a", "b"]]),
        np.zeros((2, 2), bool),
        np.full((4, 4), np.nan),
        np.array([[np.nan, np.inf]]),
        np.array([[1.7e308, -1.7e308]]),
    ],
)
def test_what_is_no_surface_is_refused(points: NDArray[Any]) -> None:
    with pytest.raises(InputError, match="expected"):
        ls.encode(points)


@pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "i4", "i8", "u8", "f4", "f8"])
@pytest.mark.parametrize("shape", [(1, 2), (16, 24), (90, 110)])
def test_noise_is_stored_rather_than_coded_at_any_price(dtype: str, shape: tuple[int, int]) -> None:
    size = np.dtype(dtype).itemsize * shape[0] * shape[1]
    values = np.frombuffer(np.random.default_rng(5).bytes(size), dtype).reshape(shape).copy()
    if values.dtype.kind == "f":
        values[~np.isfinite(values) | (np.abs(values) > 1e30)] = 1
    assert len(assert_comes_back(values)) <= 1.01 * size + 1024


def test_a_precision_leaves_attributes_as_they_are() -> None:
    rng = np.random.default_rng(6)
    points = np.concatenate([torus(20, 31), rng.normal(size=(20, 31, 2))], axis=-1)
    container = ls.encode(points, "0.1%")
    decoder = ls.Decoder()
    decoder.feed(container)
    decoded = decoder.surface().points
    assert decoded[..., 3:].tobytes() == points[..., 3:].tobytes()
    assert decoder.rms > 0
    assert is_told(decoder.rms, errors(decoded, points)[0])
    assert index_of(container).levels[-1].rms == decoder.rms
    assert not index_of(container).header.exact


def test_reconstructions_of_the_widest_lattices_have_the_errors_that_are_told() -> None:
    """Their coefficients and nodes reach what reconstructions in eighths of a step are kept within."""
    rng = np.random.default_rng(8)
    points = rng.choice([-(2**23), 0, 1, 2**23 - 1], (70, 90), p=[0.45, 0.05, 0.05, 0.45])
    assert index_of(assert_comes_back(points)).header.lattices[0].step == 1
    decoder = ls.Decoder()
    decoder.feed(ls.encode(points))
    assert len(decoder.layers) > 5
    assert max(segment.top for segment in index_of(ls.encode(points)).segments) == 26
    for view in decoder.layers:
        assert all(map(is_told, (view.rms, view.max_error), errors(view.points, points)))


@pytest.mark.parametrize("precision", [None, 0.5])
def test_a_level_surface_of_many_points(precision: float | None) -> None:
    points = np.full((64, 70), 7.5)
    container = ls.encode(points, precision)
    assert np.array_equal(ls.decode(container).points, points)
    assert len(container) < 400


@pytest.mark.parametrize("memory", [None, "1MiB"])
def test_holes_have_a_nodata_value_that_attributes_cannot_hold(memory: str | None) -> None:
    heights = np.rint(20 * terrain((90, 70))).astype(np.int16)
    mask = heights > 5
    heights[~mask] = -99
    attributes: dict[str, NDArray[Any]] = {
        "kind": (heights % 7).astype(np.uint8),
        "wind": terrain((90, 70), 1).astype(np.float32),
    }
    surface = ls.Surface(heights, mask=mask, attributes=attributes, metadata={"nodata": -99})
    with pytest.warns(ls.FormatWarning, match="values of attributes at"), ThreadPoolExecutor(1) as executor:
        container = ls.encode(surface, memory=memory, executor=executor if memory else None)
    decoded = ls.decode(container)  # which compares the digest
    assert np.array_equal(decoded.points, heights)
    assert not decoded.attributes["kind"][~mask].any()


def test_values_that_are_too_large_are_refused_beside_missing_ones_too() -> None:
    speed = np.random.default_rng(1).choice([-1.7e308, 1.7e308], (30, 20))
    with pytest.raises(InputError, match=r"at most 1e\+300 in magnitude, got 1\.7e\+308"):
        ls.encode(ls.Surface(terrain((30, 20)), attributes={"speed": speed}))
    speed[3:9, 4:12] = np.nan
    with pytest.raises(InputError, match=r"at most 1e\+300 in magnitude, got 1\.7e\+308"):
        ls.encode(ls.Surface(terrain((30, 20)), attributes={"speed": speed}))


def test_surfaces_of_many_shapes_are_encoded_side_by_side() -> None:
    # More layouts than are remembered: each asks for tables that the others have made the process forget.
    surfaces = [np.rint(300 * terrain((40 + 7 * number, 33 + 5 * number))).astype(np.int16) for number in range(8)]
    expected = [ls.encode(surface) for surface in surfaces]
    with ThreadPoolExecutor(len(surfaces)) as executor:
        assert list(executor.map(ls.encode, 3 * surfaces)) == 3 * expected


def test_axes_that_are_too_long_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lodestream.encoding.request.LONGEST_AXIS", 10)
    ls.encode(np.zeros((10, 4)))
    with pytest.raises(ls.TooLargeError, match="at most 10 rows and columns of a block, got 11"):
        ls.encode(np.zeros((4, 11)))
