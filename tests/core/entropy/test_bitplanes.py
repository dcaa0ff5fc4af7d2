from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.decoding.batches import Coded
from lodestream.decoding.segments import SegmentQueue
from lodestream.entropy import bitplanes
from lodestream.entropy.band_fields import COLUMNS, ROWS
from lodestream.entropy.bitplanes import pass_count, pass_gains, reconstruction_point
from lodestream.entropy.tiles import TileTable, gather
from lodestream.grid.layout import Layout
from lodestream.transform.predictors import COEFFICIENT_BITS

from .coding import decode_runs, encode_runs, header_for, passes_of, planes_of

Ints = NDArray[np.int32]


def coefficients(shape: tuple[int, int], bits: int, density: float, seed: int) -> Ints:
    """Coefficients of all sizes up to so many bits, many of them 0, in clusters."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(0, bits + 1, shape)
    values = rng.integers(0, 2**28, shape) >> (28 - sizes)
    values[np.repeat(np.repeat(rng.random(shape) >= density, 3, 0), 3, 1)[: shape[0], : shape[1]]] = 0
    return np.asarray(values * rng.choice([-1, 1], shape), np.int32)


def random_runs(
    rng: np.random.Generator, layout: Layout, channels: list[Ints]
) -> tuple[list[tuple[int, int, int, int]], list[list[int]]]:
    """All passes in runs of random lengths, in an order in which what contexts may see comes first."""
    counts = [passes_of(layout, c) for c in channels]
    left = {
        (tile, c): counts[c][tile] for tile in range(len(layout.tiles)) for c in range(len(channels)) if counts[c][tile]
    }
    runs = []
    for threshold in sorted(
        # A plane of a parent must be known whole before a child's: thresholds are even, or runs of a pass each follow.
        {2 * int(n) for n in rng.integers(0, COEFFICIENT_BITS, rng.integers(0, 8))} | {0},
        reverse=True,
    ):
        for (tile, channel), known in sorted(left.items()):
            if known > threshold:
                runs.append((tile, channel, known - 1, known - threshold))
                left[tile, channel] = threshold
    return runs, [[0] * len(channels) for _ in layout.tiles]


@given(
    shape=st.tuples(st.integers(1, 60), st.integers(1, 60)),
    closed=st.tuples(st.booleans(), st.booleans()),
    tile=st.tuples(st.integers(1, 5), st.integers(1, 5)),
    count=st.integers(1, 3),
    bits=st.integers(0, COEFFICIENT_BITS),
    density=st.sampled_from([0.01, 0.2, 1.0]),
    large=st.integers(0, 3),
    seed=st.integers(0, 2**32),
)
def test_any_coefficients_come_back_in_runs_split_anyhow(
    shape: tuple[int, int],
    closed: tuple[bool, bool],
    tile: tuple[int, int],
    count: int,
    bits: int,
    density: float,
    large: int,
    seed: int,
) -> None:
    layout = Layout.single(shape, closed, tile)
    channels = [coefficients(shape, bits, density, seed + n) for n in range(count)]
    runs, end = random_runs(np.random.default_rng(seed), layout, channels)
    coded = encode_runs(layout, channels, runs, large)
    assert all(segment.data for segment in coded)
    for decoded, expected in zip(decode_runs(layout, count, coded, end, large), channels, strict=True):
        np.testing.assert_array_equal(decoded, expected)


@pytest.mark.parametrize("large", [0, 1])
@pytest.mark.parametrize("fill", [2**28 - 1, -(2**28 - 1), 1, -1, 0])
def test_the_largest_and_smallest_coefficients_come_back(fill: int, large: int) -> None:
    layout = Layout.single((40, 33), (False, False), (4, 4))
    values = np.full((40, 33), fill, np.int32)
    runs, end = random_runs(np.random.default_rng(0), layout, [values])
    coded = encode_runs(layout, [values], runs, large)
    np.testing.assert_array_equal(decode_runs(layout, 1, coded, end, large)[0], values)
    assert bool(coded) == bool(fill)


@pytest.mark.parametrize("large", [0, 1])
def test_noise_that_cannot_be_compressed_stays_within_its_buffer(large: int) -> None:
    layout = Layout.single((150, 150), (False, False), (7, 7))
    values = np.random.default_rng(1).integers(-(2**28) + 1, 2**28, (150, 150), np.int32)
    runs = [(tile, 0, count - 1, count) for tile, count in enumerate(passes_of(layout, values))]
    coded = encode_runs(layout, [values], runs, large)
    assert sum(len(segment.data) for segment in coded) < 1.02 * 150 * 150 * 29 / 8
    np.testing.assert_array_equal(decode_runs(layout, 1, coded, [[0]] * len(layout.tiles), large)[0], values)


@pytest.mark.parametrize("large", [0, 1])
def test_unknown_bits_are_replaced_by_the_reconstruction_point(large: int) -> None:
    layout = Layout.single((33, 33), (False, True), (3, 3))
    values = coefficients((33, 33), 12, 1.0, 7)
    tops = planes_of(layout, values)
    for plane in (0, 1, 4, 11):
        runs = [
            (tile, 0, pass_count(top) - 1, pass_count(top) - 2 * plane) for tile, top in enumerate(tops) if top > plane
        ]
        known = decode_runs(layout, 1, encode_runs(layout, [values], runs, large), [[2 * plane]] * len(tops), large)[0]
        high = np.abs(values) >> plane
        middle = np.where(high > 0, (high << plane) + reconstruction_point(plane), 0)
        np.testing.assert_array_equal(known, np.sign(values) * middle)
        assert reconstruction_point(plane) <= (1 << plane) // 2
        assert np.abs(known - values).max() < 2**plane


@pytest.mark.parametrize("large", [0, 1])
@pytest.mark.parametrize("cut", [9, 10])
def test_passes_known_beyond_a_state_do_not_show_in_it(cut: int, large: int) -> None:
    layout = Layout.single((20, 20), (False, False), (3, 3))
    values = coefficients((20, 20), 10, 1.0, 8)
    counts = passes_of(layout, values)
    coarse = [(tile, 0, count - 1, count - cut) for tile, count in enumerate(counts) if count > cut]
    fine = [(tile, 0, min(count, cut) - 1, min(count, cut)) for tile, count in enumerate(counts) if count]
    coded = encode_runs(layout, [values], coarse + fine, large)
    state = [[min(count, cut)] for count in counts]
    before = decode_runs(layout, 1, coded[: len(coarse)], state, large)[0]
    np.testing.assert_array_equal(decode_runs(layout, 1, coded, state, large)[0], before)


@pytest.mark.parametrize("large", [0, 1])
def test_bytes_cut_off_at_the_end_are_zeros_and_other_bytes_do_no_harm(large: int) -> None:
    layout = Layout.single((30, 30), (False, False), (4, 4))
    values = coefficients((30, 30), 9, 0.5, 9)
    runs = [(tile, 0, count - 1, count) for tile, count in enumerate(passes_of(layout, values)) if count]
    coded = encode_runs(layout, [values], runs, large)
    end = [[0]] * len(layout.tiles)
    padded = [Coded(s.tile, s.channel, s.first, s.passes, bytes(s.data) + bytes(9), 0) for s in coded]
    np.testing.assert_array_equal(decode_runs(layout, 1, padded, end, large)[0], values)
    for seed, data in enumerate([b"", b"\xff", b"\xff" * 3000, b"\x00" * 3000, bytes(range(256)) * 9]):
        other = [Coded(s.tile, s.channel, s.first, s.passes, data, seed) for s in coded]
        decoded = decode_runs(layout, 1, other, end, large)[0]
        assert np.abs(decoded.astype(np.int64)).max() < 2**COEFFICIENT_BITS


@pytest.mark.parametrize("large", [0, 1])
def test_gains_are_the_squared_errors_of_what_is_known(large: int) -> None:
    layout = Layout.single((25, 18), (False, False), (3, 3))
    table, values = TileTable.of(layout), coefficients((25, 18), 10, 0.7, 10)
    counts = passes_of(layout, values)
    reader = SegmentQueue(header_for(layout, 1, large))
    reader.add(encode_runs(layout, [values], [(tile, 0, n - 1, n) for tile, n in enumerate(counts) if n], large))
    (tiles,) = reader.channels(reader.length)
    for tile, count in enumerate(counts):
        if not count:
            continue
        rows = table.of_tile(tile)
        weights = np.arange(1.0, len(rows) + 1)
        errors = pass_gains(rows, weights, count, gather(table, [values]), tiles.early)
        for remaining in range(count + 1):
            known = np.zeros(layout.grids[0].shape, np.int32)
            tiles.spread(tile, remaining, [known])
            squares = (values.astype(np.int64) - known) ** 2
            bands = layout.tiles[tile].bands
            expected = [
                w * squares[slice(*b.rows), slice(*b.columns)].sum() for w, b in zip(weights, bands, strict=True)
            ]
            assert errors[remaining] == pytest.approx(float(sum(expected)))


@pytest.mark.parametrize("at_once", [1, 5, 23, 60, 1000])
def test_gains_of_a_large_tile_are_those_of_its_parts(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    layout = Layout.single((25, 18), (False, False), (3, 3))
    table, true = TileTable.of(layout), gather(TileTable.of(layout), [coefficients((25, 18), 10, 0.7, 10)])
    early = np.random.default_rng(2).integers(0, 5, table.size, np.uint8)
    rows = table.of_tile(len(layout.tiles) - 1)
    weights = np.arange(1.0, len(rows) + 1)
    whole = pass_gains(rows, weights, 19, true, early)
    kernel, sizes = kernels.pass_gains, []

    def counted(bands: Any, *arguments: Any) -> int:
        sizes.append(int((bands[:, ROWS] * bands[:, COLUMNS]).sum()))
        return kernel(bands, *arguments)

    monkeypatch.setattr(bitplanes, "_COEFFICIENTS_PER_CALL", at_once)
    monkeypatch.setattr(kernels, "pass_gains", counted)
    np.testing.assert_allclose(pass_gains(rows, weights, 19, true, early), whole, rtol=1e-12)
    assert max(sizes) <= at_once
    assert sum(sizes) == (rows[:, ROWS] * rows[:, COLUMNS]).sum()
