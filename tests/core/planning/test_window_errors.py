"""Errors of windows: what a container tells of the cells of a surface bounds what is measured in any window."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import lodestream as ls
from lodestream.container import Index, sections
from lodestream.decoding.inspection import inspect
from lodestream.planning.window_errors import (
    KIND,
    WindowErrors,
    layer_codes,
    no_errors,
    parse_window_errors,
    read_window_errors,
    serialize_window_errors,
)
from tests.examples import examples

from ..container.forgery import payload_of, with_index
from ..surfaces import errors, index_of, terrain

LARGE = terrain((530, 400), 5).astype(np.float32)


def windows_of(container: bytes) -> tuple[Index, WindowErrors]:
    index = index_of(container)
    found = read_window_errors(index, lambda offset, length: container[offset : offset + length])
    assert found is not None
    return index, found


@pytest.fixture(scope="module")
def large() -> bytes:
    return ls.encode(LARGE)


def test_bounds_hold_for_every_window_and_are_near(large: bytes) -> None:
    index, found = windows_of(large)
    assert found.codes.shape == (6, len(index.layers), 2)
    place = index.optional[0].range
    assert place.length < 0.005 * len(large)
    rng = np.random.default_rng(2)
    views = ls.Decoder().feed(large)
    for layer in range(0, len(index.layers), 5):
        points = views[layer].points
        for _ in range(20):
            (top, bottom), (left, right) = (sorted(rng.choice(n + 1, 2, replace=False).tolist()) for n in LARGE.shape)
            region = (top, bottom), (left, right)
            rms, worst = errors(LARGE[top:bottom, left:right], points[top:bottom, left:right])
            bound = found.bounds(region, layer)
            assert rms <= bound[0]
            assert worst <= bound[1]
        for region in (((0, 256), (0, 256)), ((512, 530), (256, 400))):
            (top, bottom), (left, right) = region
            rms, worst = errors(LARGE[top:bottom, left:right], points[top:bottom, left:right])
            bound = found.bounds(region, layer)
            assert bound[0] < 1.1 * rms or not rms
            assert bound[1] < 1.1 * worst or not worst


def test_holes_do_not_count() -> None:
    mask = np.ones(LARGE.shape, np.bool_)
    mask[100:400, 10:300] = False
    container = ls.encode(ls.Surface(LARGE, mask=mask))
    index, found = windows_of(container)
    views = ls.Decoder().feed(container)
    for layer in (3, 10, len(index.layers) - 1):
        for region in (((0, 530), (0, 400)), ((50, 300), (100, 350))):
            rows, columns = (slice(*span) for span in region)
            valid = mask[rows, columns]
            rms, worst = errors(LARGE[rows, columns][valid][None], views[layer].points[rows, columns][valid][None])
            assert rms <= found.bounds(region, layer)[0]
            assert worst <= found.bounds(region, layer)[1]
    assert found.bounds(((150, 200), (20, 90)), 0) == (0.0, 0.0)


def test_regions_and_layers_that_are_not_there_are_refused(large: bytes) -> None:
    _, found = windows_of(large)
    for region in (((0, 531), (0, 5)), ((5, 5), (0, 5)), ((-1, 4), (0, 5))):
        with pytest.raises(ls.OptionError):
            found.bounds(region, 0)
    for layer in (-1, found.codes.shape[1]):
        with pytest.raises(ls.OptionError, match="expected a layer of 0 to"):
            found.bounds(((0, 5), (0, 5)), layer)


def test_small_surfaces_and_those_of_several_blocks_have_none() -> None:
    heights = terrain((40, 300))
    for surface in (ls.Surface(heights[:, :256]), ls.Surface(blocks=[ls.Block(heights), ls.Block(heights)])):
        assert read_window_errors(index_of(ls.encode(surface)), lambda offset, length: b"") is None


def test_a_section_of_another_length_or_with_a_flipped_bit_is_refused(large: bytes) -> None:
    index, _ = windows_of(large)
    place = index.optional[0].range
    payload = payload_of(large, place.offset, place.end)
    parse_window_errors(memoryview(payload), 0, index.header)
    rng = np.random.default_rng(3)
    for bit in rng.choice(8 * len(payload), 200, replace=False):
        damaged = bytearray(payload)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ls.CorruptStreamError, match="expected errors of"):
            parse_window_errors(memoryview(bytes(damaged)), 0, index.header)
    for other in (payload[:-1], payload + b"\0", payload[:1], b""):
        with pytest.raises(ls.CorruptStreamError):
            parse_window_errors(memoryview(other), 0, index.header)
    huge = replace(index.header, blocks=(((2**31 - 1, 2**31 - 1), (False, False)),), layer_count=2**50)
    with pytest.raises(ls.CorruptStreamError):
        parse_window_errors(memoryview(payload), 0, huge)


def test_many_cells_of_few_bytes_are_checked_alike(large: bytes) -> None:
    header = replace(index_of(large).header, blocks=(((9, 40), (False, False)),), layer_count=3)
    rng = np.random.default_rng(4)
    codes = rng.integers(0, 256, (360, 3, 2), np.uint8)
    rows = [row.tobytes() + sections.check_of(row.tobytes()).to_bytes(2, "little") for row in codes]
    payload = b"\0" + b"".join(rows)
    assert np.array_equal(parse_window_errors(memoryview(payload), 0, header).codes, codes)
    for bit in range(8, 8 * len(payload), 59):
        damaged = bytearray(payload)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(ls.CorruptStreamError, match=f"errors of cell {(bit // 8 - 1) // 8} that"):
            parse_window_errors(memoryview(bytes(damaged)), 0, header)


def test_bounds_that_are_too_small_are_refused_where_the_surface_is_exact(large: bytes) -> None:
    index, found = windows_of(large)
    assert inspect(io.BytesIO(large), max_vertices=1_000_000).errors_checked

    def forged(codes: np.ndarray) -> bytes:
        payload = serialize_window_errors([codes[:, layer] for layer in range(codes.shape[1])])
        place = index.optional[0].range
        section = sections.section(KIND, payload)
        assert len(section) == place.length
        return large[: place.offset] + section + large[place.end :]

    assert forged(found.codes) == large
    larger, smaller = found.codes.copy(), found.codes.copy()
    larger[2, 4] -= 8
    smaller[2, 4, 1] += 1
    inspect(io.BytesIO(forged(larger)), max_vertices=1_000_000)
    with pytest.raises(ls.CorruptStreamError, match="bounds of the errors of windows in layer 4"):
        inspect(io.BytesIO(forged(smaller)), max_vertices=1_000_000)
    for optional in ((), (replace(index.optional[0], kind=129),)):
        with pytest.raises(ls.CorruptStreamError):
            inspect(io.BytesIO(with_index(large, replace(index, optional=optional))), max_vertices=1_000_000)


@examples(30)
@given(
    st.lists(st.floats(0, 3.9), min_size=1, max_size=40), st.sampled_from([1e-110, 1.0, 1857.0, 1e110]), st.booleans()
)
def test_codes_are_bounds_and_near(errors: list[float], extent: float, tiny: bool) -> None:
    scale = 1e-9 if tiny else 1.0
    header = replace(index_of(ls.encode(LARGE[:9, :9])).header, extent=extent)
    header = replace(header, blocks=(((1, 256 * len(errors)), (False, False)),))
    worst = np.array(errors) * extent * scale
    figures = np.stack([256 * worst**2 / 4, worst**2], axis=-1)[None]
    codes = layer_codes(figures, header)
    assert codes is not None
    bounds = WindowErrors(header, (8, 8), codes[:, None])
    for number, wanted in enumerate(np.sqrt(figures[0, :, 1])):
        bound = bounds.bounds(((0, 1), (256 * number, 256 * number + 256)), 0)
        assert wanted <= bound[1] <= max(wanted * 1.1, 2e-9 * extent)
        assert wanted / 2 <= bound[0] * (1 + 1e-12)


def test_errors_beyond_all_codes_are_not_told() -> None:
    header = index_of(ls.encode(LARGE[:300, :300])).header
    figures = np.full((3, 2, 2), (5 * header.extent) ** 2)
    assert layer_codes(figures, header) is None
    assert layer_codes(figures * 0, header) is not None
    np.testing.assert_array_equal(layer_codes(figures * 0, header), no_errors(header))
