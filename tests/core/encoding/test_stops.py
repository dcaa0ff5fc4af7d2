"""Layers end where clients stop, and what is told of the errors there is what a reader gets."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container.model import Index
from lodestream.encoding.allocation import PassOrder
from lodestream.encoding.effort import CHOICES
from lodestream.encoding.stops import _ERRORS, moved_ends, sought_ends

from ..surfaces import index_of, is_told, terrain


def order_of(passes: int, seed: int) -> PassOrder:
    """Passes of two channels, of which the errors that are left fall."""
    rng = np.random.default_rng(seed)
    sizes = np.cumsum(rng.random(passes) * 10 ** rng.uniform(0, 3, passes))
    left = np.cumprod(rng.uniform(0.3, 1.0, passes)).astype(np.float64)
    unit, number = rng.integers(0, 8, passes), np.zeros(passes, np.int8)
    return PassOrder(np.zeros((4, 2), np.int8), unit, number, sizes, 1 - left, rng.random(passes) < 0.5)


def measured_at(ends: list[int], order: PassOrder, seed: int) -> dict[int, float]:
    """Errors that are about those that gains foretell, and 0 in the end."""
    rng = np.random.default_rng(seed)
    left = np.sqrt(np.maximum(1 - order.gains, 0)) * rng.uniform(0.7, 1.4, order.gains.size)
    return {end: 0.0 if end == order.sizes.size else float(left[end - 1]) for end in ends}


cases = st.tuples(st.integers(2, 120), st.integers(0, 2**32))


def ends_in(passes: int, seed: int) -> list[int]:
    rng = np.random.default_rng(seed)
    return sorted({*rng.integers(1, passes + 1, 6).tolist(), passes})


@given(cases)
def test_ends_are_sought_between_those_that_were_measured(case: tuple[int, int]) -> None:
    order, ends = order_of(*case), ends_in(*case)
    measured = measured_at(ends, order, case[1])
    sought = sought_ends(order, measured, 1.0, 1)
    assert sought == sorted(set(sought)) == sought_ends(order, measured, 1.0, 1)
    assert len(sought) <= len(_ERRORS)
    for end in sought:
        assert end not in measured
        above = [other for other in ends if other < end]
        assert above, "a layer before the first one helps nobody"
        # The error that it is sought for is met after it, and not before it.
        after = min(other for other in ends if other > end)
        assert any(measured[after] <= error < measured[above[-1]] for error in _ERRORS)


@given(cases)
def test_moved_ends_are_about_as_many_and_meet_each_error_first(case: tuple[int, int]) -> None:
    order, ends = order_of(*case), ends_in(*case)
    measured = measured_at(ends, order, case[1])
    sought = sought_ends(order, measured, 1.0, 1)
    measured |= measured_at(sought, order, case[1] + 1)
    moved = moved_ends(order, ends, measured, 1.0, len(ends) + 1)
    assert moved == sorted(set(moved))
    assert len(ends) <= len(moved) <= len(ends) + 1
    assert (moved[0], moved[-1]) == (ends[0], ends[-1])
    assert set(moved) <= measured.keys()
    assert len(moved_ends(order, ends, measured, 1.0, len(ends))) == len(ends)
    meeting = [min(end for end in measured if measured[end] <= error) for error in _ERRORS]
    for stop in meeting:
        if stop not in moved:  # nothing beside it may give way, and one layer more would save too little or be too many
            place = sum(end < stop for end in moved)
            assert {*moved[place - 1 : place + 1]} <= {ends[0], ends[-1], *meeting}
            assert len(moved) > len(ends) or order.sizes[moved[place] - 1] - order.sizes[stop - 1] <= 128


def test_gains_of_other_channels_foretell_nothing() -> None:
    order = PassOrder(
        np.zeros((1, 2), np.int8),
        np.array([0, 1, 0, 1, 0, 1]),
        np.zeros(6, np.int8),
        np.arange(1.0, 7.0) * 100,
        np.array([0.9, 100.9, 100.99, 200.99, 200.999, 300.999]),
        np.ones(6, np.bool_),
    )
    # The error falls by about the root of ten with each pass of the first channel: it meets 1e-2 after the third pass.
    assert sought_ends(order, {1: 0.0201, 6: 0.0}, 1.0, 1)[0] == 3


def stops(index: Index) -> list[float]:
    """Bytes of the layer that first meets each error, over those on the curve between it and the one before."""
    found = []
    for error in _ERRORS:
        for before, layer in pairwise(index.layers):
            limit = error * index.header.extent
            if before.rms > limit >= layer.rms > 0:
                part = np.log(before.rms / limit) / np.log(before.rms / layer.rms)
                found.append(layer.end / (before.end * (layer.end / before.end) ** part))
    return found


def plates() -> ls.Surface:
    """Three sheets in space that do not touch."""
    columns, rows = np.meshgrid(np.arange(130.0), np.arange(120.0))
    sheets = [np.stack([columns + 200 * k, rows, terrain((120, 130), k)], axis=-1) for k in range(3)]
    return ls.Surface(blocks=[ls.Block(points) for points in sheets])


SURFACES = {
    "heights": ls.Surface(np.rint(20 * terrain((300, 280))).astype(np.int32)),
    "holes": ls.Surface(terrain((210, 190)).astype(np.float32), mask=terrain((210, 190), 3) > 0),
    "blocks": plates(),
    "attribute": ls.Surface(terrain((200, 180)), attributes={"speed": terrain((200, 180), 5)}),
    "for one error": ls.Surface(terrain((300, 280))),
}


@pytest.mark.parametrize("name", SURFACES)
def test_a_layer_ends_where_an_error_is_just_met(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    surface = SURFACES[name]
    rms = "0.001%" if name == "for one error" else None
    container = ls.encode(surface, rms=rms)
    found = stops(index_of(container))
    monkeypatch.setitem(CHOICES, "default", replace(CHOICES["default"], stop_turns=0))
    before = stops(index_of(ls.encode(surface, rms=rms)))
    mean, mean_before = (float(np.exp(np.log(of).mean())) for of in (found, before))
    assert mean < min(1.2 if rms else 1.08, mean_before)  # of one for one error single passes are longer
    # Errors told are those of what a reader shows.
    for view in ls.Decoder().feed(container)[:-1]:
        squares = np.concatenate([_squares(*pair) for pair in zip(view.surface().blocks, surface.blocks, strict=True)])
        assert is_told(view.rms, float(np.sqrt(squares.mean())))


def _squares(shown: ls.Block, block: ls.Block) -> NDArray[np.float64]:
    """Squared distances of the valid points."""
    delta = shown.points.astype(np.float64) - block.points
    squares: NDArray[np.float64] = (delta.reshape(*block.shape, -1) ** 2).sum(axis=2)
    return squares[slice(None) if block.mask is None else block.mask].ravel()
