"""Errors of states, however the surface is divided: those of the whole surface, and those of their definition."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.decoding import measurer
from lodestream.decoding.measurer import Comparison, Measurer, comparisons, distances_of
from lodestream.decoding.piecewise import PiecewiseDecoder
from lodestream.decoding.region import Region
from lodestream.decoding.values import Values, values_of
from lodestream.entropy.dequantize import UNANNOUNCED
from lodestream.parallel import VARIABLE
from tests.examples import examples
from tests.unchanged.cases import random_case

from ..surfaces import index_of

State = NDArray[np.int8]


def decoder_of(container: bytes) -> PiecewiseDecoder:
    return PiecewiseDecoder(lambda offset, length: container[offset : offset + length], index_of(container))


def compared(decoder: PiecewiseDecoder, region: Region, values: Mapping[int, Values]) -> list[Comparison]:
    """What comes back in the end of a region, as that which was given."""
    header, arrays = decoder.header, {block: own.arrays for block, own in values.items()}
    masks = [None if mask is None else region.of_block(mask) for mask in header.masks]
    points = {block: np.nan_to_num(own[0], posinf=0, neginf=0) for block, own in arrays.items()}
    return comparisons(region, header.arrangement, header.geometric, points, arrays, masks)


def measurer_of(decoder: PiecewiseDecoder, region: Region) -> Measurer:
    tiles = decoder.segments.channels(region)
    values = decoder.segments.values_from(region, tiles)
    return Measurer(decoder.header, region, tiles, compared(decoder, region, values))


def states_of(decoder: PiecewiseDecoder, seed: int, count: int = 5) -> list[State]:
    """Each has more of some levels than the one before, or less; the last one has all."""
    rng, layout = np.random.default_rng(seed), decoder.header.layout
    state = np.full((len(layout.tiles), decoder.header.channels), UNANNOUNCED, np.int8)
    states = []
    for _ in range(count):
        first = layout.tiles_of(int(rng.integers(0, layout.levels + 1))).start
        changed = rng.random(state.shape) < 0.6
        changed[:first] = False
        state = np.where(changed, rng.choice([0, 0, 0, 1, 4, 7, UNANNOUNCED], state.shape), state).astype(np.int8)
        states.append(state)
    return [*states, np.zeros_like(state)]


@examples(20)
@given(
    seed=st.integers(0, 5000),
    memory=st.sampled_from([1, 1 << 18, 1 << 30]),
    side=st.sampled_from([100, 256, 1024]),
    whole=st.sampled_from([1, 1000, 1 << 20]),
    threads=st.sampled_from(["1", "3"]),
)
def test_errors_are_the_same_however_the_surface_is_divided(
    seed: int, memory: int, side: int, whole: int, threads: str
) -> None:
    case = random_case(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ls.FormatWarning)
        try:
            container = ls.encode(case.surface, **case.options)
        except ls.InputError:
            return
    decoder = decoder_of(container)
    states = states_of(decoder, seed)
    everything = measurer_of(decoder, Region.whole(decoder.header.layout, decoder.header.levels))
    expected = [everything.exact_errors(state) for state in states]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, threads)
        patch.setattr(measurer, "_WINDOW_SIDE", side)
        patch.setattr(measurer, "_WHOLE_POINTS", whole)
        regions = [region for together in decoder.pieces(memory) for region in together]
        figures = [measurer_of(decoder, region).figures(states) for region in regions]
        found = [distances_of(decoder.header, figures, number) for number in range(len(states))]
        again = everything.errors(states)
    for (errors, cells), other, of_all in zip(expected, found, again, strict=True):
        for measured in (other, of_all):
            if measured is None:  # squares beyond float64
                assert decoder.header.dtypes[0].kind == "f"
                continue
            assert measured[0] == errors
            if decoder.header.arrangement is None:
                np.testing.assert_array_equal(measured[1], cells)


def errors_by_definition(shown: NDArray[Any], wanted: NDArray[Any]) -> tuple[float, float]:
    """Of points, shape (point, channel)."""
    squares = ((shown.astype(np.float64) - wanted.astype(np.float64)) ** 2).sum(axis=1)
    return math.sqrt(squares.mean()), math.sqrt(squares.max())


@pytest.mark.sweep(5)
@pytest.mark.parametrize("seed", [0, 1, 2, 4, *range(120, 132, 2)])
def test_errors_are_those_of_their_definition(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(5, 300, 2).tolist()
    points = np.rint(rng.normal(size=(rows, columns, 3 if seed % 4 else 1)).cumsum(axis=0) * 64).astype(np.float32) / 16
    mask, speed = rng.random((rows, columns)) < 0.9, rng.integers(0, 1000, (rows, columns, 2)).astype(np.int32)
    points = points if points.shape[2] > 1 else points[..., 0]
    if seed % 3:
        speed[~mask] = 0
    surface = ls.Surface(points, mask=mask if seed % 3 else None, attributes={"speed": speed})
    decoder = decoder_of(ls.encode(surface))
    header = decoder.header
    region = Region.whole(header.layout, header.levels)
    tiles = decoder.segments.channels(region)
    valid = mask if seed % 3 else np.ones_like(mask)
    states = states_of(decoder, seed)
    for state, (errors, _) in zip(states, measurer_of(decoder, region).errors(states), strict=True):
        arrays = values_of(header, region, tiles, state)[0].arrays
        given_points = surface.blocks[0].points.reshape(rows, columns, -1)
        if header.geometric < given_points.shape[2]:  # x and y follow a rule
            given_points = given_points[..., 2:]
        pairs = [(arrays[0], given_points)] if header.geometric > 1 else []
        pairs += [
            (shown[..., [k]], wanted[..., [k]])
            for shown, wanted in ((arrays[0], given_points), (arrays[1], speed))
            for k in range(shown.shape[2])
        ]
        expected = [errors_by_definition(shown[valid], wanted[valid]) for shown, wanted in pairs]
        assert (errors.rms, errors.maximum) == pytest.approx(expected[0], rel=1e-12)
        channels = expected[1:] if header.geometric > 1 else expected
        np.testing.assert_allclose(errors.channels, channels, rtol=1e-12)


@pytest.mark.parametrize("attribute", [False, True])
def test_differences_whose_squares_vanish_are_not_none(attribute: bool) -> None:
    """Float64 holds differences of 1e-200, and not their squares."""
    rng = np.random.default_rng(3)
    tiny = np.rint(rng.normal(size=(300, 280)).cumsum(axis=0) * 50) * 2.0**-700
    heights = np.rint(rng.normal(size=tiny.shape)).astype(np.int16) if attribute else tiny
    decoder = decoder_of(ls.encode(ls.Surface(heights, attributes={"tiny": tiny} if attribute else {})))
    measuring = measurer_of(decoder, Region.whole(decoder.header.layout, decoder.header.levels))
    states = states_of(decoder, 5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measurer, "_WHOLE_POINTS", 1)
        patch.setattr(measurer, "_WINDOW_SIDE", 100)
        measured = measuring.errors(states)
    for (errors, _), state in zip(measured, states, strict=True):
        assert errors == measuring.exact_errors(state)[0]
    first = measured[0][0]
    rms, maximum = first.channels[1] if attribute else first[:2]
    assert 0 < rms < maximum < 1e-190


def test_windows_copy_the_channels_that_are_compared_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, (rows, columns), components = np.random.default_rng(3), (300, 280), 16
    heights = rng.normal(size=(rows, columns)).cumsum(axis=0).astype(np.float32)
    kinds = rng.integers(-9, 9, (rows, columns, components)).astype(np.int8)
    decoder = decoder_of(ls.encode(ls.Surface(heights, attributes={"kinds": kinds})))
    monkeypatch.setattr(measurer, "_WINDOW_SIDE", 100)
    monkeypatch.setattr(measurer, "_WHOLE_POINTS", 1)
    measuring = measurer_of(decoder, Region.whole(decoder.header.layout, decoder.header.levels))
    parts, compared = measuring._parts(), measuring._compared
    assert len(parts) > 1
    assert len(compared) == 1 + components
    copied = sum(measurer._cut(own, part).originals[0].points.size for part in parts for own in compared)
    assert copied == rows * columns * (1 + components), "each channel is copied once"
