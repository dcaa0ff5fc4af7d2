"""Windows across the seam of a closed axis: values, what is sent, errors, metadata and refusals."""

from __future__ import annotations

import functools
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container import read_index
from lodestream.coordinates.height_fields import coordinates
from lodestream.grid.layout import Layout
from lodestream.grid.support import needed_tiles
from lodestream.grid.window import aligned, check_region, contains, hull, meets, places, samples, spans, taken
from lodestream.planning.planner import plan
from lodestream.planning.selection import selection_of
from lodestream.planning.window_errors import read_window_errors
from lodestream.transform.lifting import CLAMP
from lodestream.transform.pyramid import allocate, forward, inverse
from tests.examples import examples

SHAPES = [(24, 36), (23, 37), (40, 301), (130, 260)]
KINDS = ["integers", "floats", "holes", "points", "attributes", "rules", "level order"]


def wrapped(array: NDArray[Any], region: Any) -> NDArray[Any]:
    """The window as numpy takes it."""
    rows = np.take(array, np.arange(*region[0]), axis=0, mode="wrap")
    return np.take(rows, np.arange(*region[1]), axis=1, mode="wrap")


def surface_of(kind: str, shape: tuple[int, int], closed: tuple[bool, bool]) -> ls.Surface:
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(float)
    noise = np.random.default_rng(shape[1]).normal(size=shape)
    heights = 50 * np.cos(columns * 2 * np.pi / shape[1]) * np.cos(rows * 2 * np.pi / shape[0]) + noise
    if kind == "points":
        turn = columns * 2 * np.pi / shape[1]
        return ls.Surface(np.stack([9 * np.cos(turn), 9 * np.sin(turn), heights], axis=2).astype("f4"), closed)
    if kind == "rules":
        return ls.Surface(np.stack([columns * 0.5, 7 - rows, np.rint(heights)], axis=2), closed)
    if kind == "holes":
        return ls.Surface(np.where(noise < -0.8, np.nan, heights), closed)
    if kind == "attributes":
        attributes = {"t": heights.astype("f4"), "k": (columns % 7).astype("u1")}
        return ls.Surface(np.rint(heights).astype("i2"), closed, attributes=attributes)
    return ls.Surface(np.rint(heights * 10).astype("i4") if kind == "integers" else heights.astype("f4"), closed)


@functools.cache
def encoded(kind: str, shape: tuple[int, int], closed: tuple[bool, bool]) -> tuple[ls.Surface, bytes]:
    surface = surface_of(kind, shape, closed)
    return surface, ls.encode(surface)


@st.composite
def windows(draw: st.DrawFn, shape: tuple[int, int], closed: tuple[bool, bool]) -> Any:
    region = []
    for length, wraps in zip(shape, closed, strict=True):
        start = draw(st.integers(0, length - 1))
        region.append((start, draw(st.integers(start + 1, start + length if wraps else length))))
    return region[0], region[1]


@examples(25)
@given(st.data())
@pytest.mark.long
def test_every_prefix_shows_the_window_as_numpy_takes_it(data: st.DataObject) -> None:
    kind, shape = data.draw(st.sampled_from(KINDS)), data.draw(st.sampled_from(SHAPES))
    closed = data.draw(st.sampled_from([(False, True), (True, True), (True, False)]))
    surface, container = encoded("integers" if kind == "level order" else kind, shape, closed)
    region = data.draw(windows(shape, closed))
    if all(stop - start == 1 for start, stop in region):
        return  # a surface has two points
    if kind == "holes" and not np.isfinite(wrapped(surface.points, region)).any():
        return
    target = ls.Target(region=region, order="level" if kind == "level order" else "quality")
    index = read_index(lambda offset, length: container[offset : offset + length], len(container))
    chosen = plan(index, target)
    decoder, whole = ls.Decoder(selection_of(target)), ls.Decoder()
    whole.feed(container)
    for place in (*chosen.before, *chosen.ranges, *chosen.after):
        decoder.feed_at(place.offset, container[place.offset : place.end])
    assert decoder.complete
    assert decoder.max_error == 0
    # Only what the window needs was sent, and it is enough.
    assert decoder.bytes == chosen.bytes <= whole.bytes
    window = decoder.surface()
    assert window.closed == tuple(
        wraps and stop - start == n for wraps, (start, stop), n in zip(closed, region, shape, strict=True)
    )
    for found, wanted in zip(
        (window.points, *window.attributes.values()), (surface.points, *surface.attributes.values()), strict=True
    ):
        assert found.dtype == wanted.dtype
        assert np.array_equal(found, wrapped(wanted, region), equal_nan=True)
    step = max(1, len(whole.layers) // 6)
    for number in range(0, len(whole.layers), step):
        view = whole.layers[number]
        cut = view.window(region).points
        if view.complete:
            assert np.array_equal(cut, wrapped(surface.points, region), equal_nan=True)
        else:
            # What is known in the window may be known there sooner, and then is not rounded on the way.
            assert cut.shape[:2] == (region[0][1] - region[0][0], region[1][1] - region[1][0])
    followed = ls.Decoder(ls.Selection(region=region))
    followed.feed(container)
    for view in followed.layers[::step]:
        full = next((own for own in whole.layers if own.number == view.number), None)
        if full is not None and not view.complete:
            assert np.array_equal(view.points, wrapped(full.points, region), equal_nan=True)


@pytest.mark.parametrize("kind", ["integers", "floats", "holes", "attributes"])
@pytest.mark.long
def test_windows_across_the_seam_are_sent_alone_and_their_errors_hold(kind: str) -> None:
    shape, closed = (130, 1024), (False, True)
    surface, container = encoded(kind, shape, closed)
    index = read_index(lambda offset, length: container[offset : offset + length], len(container))
    errors = read_window_errors(index, lambda offset, length: container[offset : offset + length])
    sizes = {}
    for columns in ((1000, 1048), (24, 72), (0, 1024)):
        region = (40, 80), columns
        chosen = plan(index, ls.Target(region=region))
        sizes[columns] = chosen.bytes
        decoder = ls.Decoder(ls.Selection(region=region))
        decoder.feed(container)
        original = wrapped(surface.points, region).astype(float)
        for view in decoder.layers[:-1:3]:
            if not view.complete and not np.isnan(view.rms):
                off = np.abs(view.points.astype(float) - original)
                off = off[np.isfinite(off)]
                assert off.max() <= view.max_error * (1 + 1e-6)
                assert np.sqrt(np.mean(off**2)) <= view.rms * (1 + 1e-6)
                if errors is not None and view.number < index.header.layer_count:
                    rms, worst = errors.bounds(region, view.number)
                    assert off.max() <= worst * (1 + 1e-6)
                    assert np.sqrt(np.mean(off**2)) <= rms * (1 + 1e-6)
    assert sizes[1000, 1048] < 0.75 * sizes[0, 1024]
    first = ls.Target(first=((40, 80), (1000, 1048)))
    assert plan(index, first).bytes == plan(index, ls.Target()).bytes


@examples(40)
@given(
    st.tuples(st.integers(1, 90), st.integers(1, 90)),
    st.sampled_from([(False, True), (True, False), (True, True)]),
    st.data(),
    st.integers(0, 2**32),
)
def test_what_is_not_needed_has_no_part_in_a_window_across_the_seam(
    shape: tuple[int, int], closed: tuple[bool, bool], data: st.DataObject, seed: int
) -> None:
    if shape[0] * shape[1] < 2:
        return
    layout, region = Layout.single(shape, closed, (3, 3)), data.draw(windows(shape, closed))
    rng = np.random.default_rng(seed)
    values = allocate(shape)
    values[...] = rng.integers(-(2**20), 2**20, shape)
    original = values.copy()
    predictors = forward([values], layout)
    needed = needed_tiles(layout, region, layout.levels)
    for number, tile in enumerate(layout.tiles):
        for band in tile.bands:
            if not needed[number]:
                values[slice(*band.rows), slice(*band.columns)] = rng.integers(-CLAMP // 64, CLAMP // 64)
    inverse([values], layout, predictors, layout.levels)
    np.testing.assert_array_equal(wrapped(values, region), wrapped(original, region))


@given(st.integers(1, 40), st.integers(1, 12), st.data())
def test_spans_of_an_axis_are_what_they_say(length: int, size: int, data: st.DataObject) -> None:
    shape, closed = (length, 1), (True, False)
    region = data.draw(windows(shape, closed))
    other = data.draw(windows(shape, closed))
    inside = places(region[0], length)
    assert [*inside] == [k % length for k in range(*region[0])]
    assert [k for part in spans(region[0], length) for k in range(*part)] == [*inside]
    assert {*np.flatnonzero(samples(region[0], length))} == {*inside}
    around, whole = aligned(region, shape, (size, 1)), hull(region, shape)
    check_region(around, shape, closed)
    assert {*places(around[0], length) // size} == {*inside // size}
    assert {*np.flatnonzero(samples(around[0], length))} == {k for k in range(length) if k // size in {*inside // size}}
    assert {*range(*whole[0])} >= {*inside}
    for start in range(0, length, size):
        cell = start, min(start + size, length)
        assert meets(region[0], cell, length) == bool({*range(*cell)} & {*inside})
    if contains(region, other, shape):
        assert {*places(other[0], length)} <= {*inside}
    else:
        # A run of places that is in another one, in its order.
        assert not {*places(other[0], length)} <= {*inside} or len(other[0]) > 1
    array = np.arange(length)[:, None] * 10
    assert [*taken(array, region, shape)[:, 0] // 10] == [*inside]


def test_regions_that_a_surface_does_not_have_are_refused() -> None:
    shape = (20, 36)
    for region, closed in product(
        [((0, 5), (36, 40)), ((0, 5), (30, 67)), ((0, 5), (5, 5)), ((10, 21), (0, 9)), ((0, 5), (-3, 4))],
        [(False, True), (False, False)],
    ):
        with pytest.raises(ls.OptionError, match=r"expected (rows|columns) within 0:(20|36)"):
            check_region(region, shape, closed)
    with pytest.raises(ls.OptionError, match="expected columns within 0:36, at least one, got 30:40"):
        check_region(((0, 5), (30, 40)), shape, (True, False))
    with pytest.raises(ls.OptionError, match="or across the seam up to 30:66, at least one, got 30:67"):
        check_region(((0, 5), (30, 67)), shape, (False, True))


@pytest.mark.parametrize(
    "metadata",
    [
        {"geotransform": [-5.0, 10.0, 0.0, 90.0, 0.0, -9.0]},
        {"axes": {"x": [0, 10], "y": [85.5, -9]}},
        {"axes": {"x": [*map(float, range(0, 360, 10)), "values"], "y": [85.5, -9]}},
    ],
)
def test_coordinates_of_a_window_go_on_across_the_seam(metadata: dict[str, Any]) -> None:
    surface = ls.Surface(surface_of("integers", (20, 36), (False, True)).points, (False, True), metadata=metadata)
    decoder = ls.Decoder(ls.Target(region=((3, 9), (34, 40))))
    decoder.feed(ls.encode(surface))
    window = decoder.surface()
    x, y = coordinates(window)
    assert x[0].tolist() == [340, 350, 360, 370, 380, 390]
    assert y[:, 0].tolist() == [85.5 - 9 * row for row in range(3, 9)]


def test_the_step_over_the_seam_is_that_of_a_list_with_the_first_number_again() -> None:
    lines = np.cumsum(np.tile([4.0, 16.0], 18))
    metadata = {"axes": {"x": [0.0, *lines.tolist(), "values"], "y": [85.5, -9]}}
    surface = ls.Surface(surface_of("integers", (20, 36), (False, True)).points, (False, True), metadata=metadata)
    region = (3, 9), (34, 40)
    whole = ls.Decoder()
    whole.feed(ls.encode(surface))
    decoder = ls.Decoder(ls.Target(region=region))
    decoder.feed(ls.encode(surface))
    assert coordinates(decoder.surface())[0][0].tolist() == [340, 344, 360, 364, 380, 384]
    assert coordinates(whole.view().window(region))[0][0].tolist() == [340, 344, 360, 364, 380, 384]
    assert whole.header is not None
    level = whole.surface(whole.header.levels - 2)
    assert level.metadata["axes"]["x"] == [*range(0, 361, 40), "values"]
    again = ls.Decoder(ls.Target(region=((0, 5), (7, 11))))
    again.feed(ls.encode(level))
    assert coordinates(again.surface())[0][0].tolist() == [280, 320, 360, 400]


def test_a_window_of_a_window_across_the_seam() -> None:
    surface, container = encoded("integers", (24, 36), (False, True))
    decoder = ls.Decoder(ls.Target(region=((2, 20), (30, 50))))
    decoder.feed(container)
    view = decoder.view()
    for columns in ((30, 50), (34, 40), (2, 9), (35, 37)):
        part = (5, 9), columns
        assert np.array_equal(view.window(part).points, wrapped(surface.points, part))
    with pytest.raises(ls.OptionError, match="inside the one received"):
        view.window(((5, 9), (10, 20)))
