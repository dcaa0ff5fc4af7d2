from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.container import read_index
from lodestream.container.model import Index
from lodestream.encoding import prepared
from lodestream.grid.layout import Layout
from lodestream.grid.support import needed_tiles
from lodestream.planning.planner import plan
from lodestream.planning.selection import selection_of
from lodestream.transform.lifting import CLAMP
from lodestream.transform.pyramid import allocate, forward, inverse
from tests.examples import examples

CLOSURES = [(False, False), (True, False), (False, True), (True, True)]


def index_of(container: bytes) -> Index:
    return read_index(lambda offset, length: container[offset : offset + length], len(container))


def received(container: bytes, target: ls.Target) -> ls.Decoder:
    """What a receiver has that got just what the plan says."""
    chosen = plan(index_of(container), target)
    decoder = ls.Decoder(selection_of(target))
    held = 0
    views = []
    for place in (*chosen.before, *chosen.ranges, *chosen.after):
        views += decoder.feed_at(place.offset, container[place.offset : place.end])
    states = {(v.number, v.level, v.bytes, str(v.rms), str(v.max_error)) for v in views}
    assert {(m.number, m.level, m.bytes, str(m.rms), str(m.max_error)) for m in chosen.marks} <= states
    assert (views[-1].number, views[-1].bytes) == (chosen.marks[-1].number, chosen.bytes)
    held = sum(place.length for place in chosen.ranges)
    assert decoder.bytes == chosen.bytes == held
    return decoder


def wave(rows: int, columns: int) -> NDArray[np.float64]:
    y, x = np.mgrid[:rows, :columns]
    rng = np.random.default_rng(rows + columns)
    return np.asarray(50 * np.sin(x / 30) * np.cos(y / 50) + rng.normal(size=(rows, columns)))


def cut(surface: ls.Surface, region: Any) -> list[NDArray[Any]]:
    place = slice(*region[0]), slice(*region[1])
    return [array[place] for array in (surface.points, *surface.attributes.values())]


REGIONS = [((0, 20), (0, 30)), ((100, 180), (250, 300)), ((299, 300), (0, 400)), ((0, 300), (0, 400))]


@functools.cache
def encoded(kind: str) -> tuple[ls.Surface, bytes]:
    """A surface that many windows are cut out of, and its container."""
    surface = surface_of(kind, 300, 400)
    return surface, ls.encode(surface)


def surface_of(kind: str, rows: int, columns: int) -> ls.Surface:
    heights = wave(rows, columns)
    y, x = np.mgrid[:rows, :columns].astype(float)
    return {
        "integers": lambda: ls.Surface(np.rint(heights).astype(np.int16)),
        "floats": lambda: ls.Surface(heights.astype(np.float32)),
        "closed": lambda: ls.Surface(np.rint(heights * 10).astype(np.int32), (True, True)),
        "xyz": lambda: ls.Surface(np.stack([x + np.sin(y), y, heights], axis=2)),
        "holes": lambda: ls.Surface(np.where((x - columns / 2) ** 2 + (y - rows / 2) ** 2 < 900, np.nan, heights)),
        "plane": lambda: ls.Surface(np.stack([x * 30 + 5e5, 4e6 - 30 * y, np.rint(heights)], axis=2)),
        "attributes": lambda: ls.Surface(
            np.rint(heights).astype(np.int16), attributes={"t": heights.astype(np.float32), "k": (x % 7).astype("u1")}
        ),
        "terraces": lambda: ls.Surface(np.floor(heights / 9).astype(np.int8)),
    }[kind]()


@pytest.mark.sweep(12)
@pytest.mark.parametrize("region", REGIONS)
@pytest.mark.parametrize("kind", ["integers", "floats", "closed", "xyz", "holes", "plane", "attributes", "terraces"])
@pytest.mark.long
def test_a_window_is_what_cutting_the_whole_gives(kind: str, region: Any) -> None:
    surface, container = encoded(kind)
    decoder = received(container, ls.Target(region=region))
    window = decoder.surface()
    for found, wanted in zip((window.points, *window.attributes.values()), cut(surface, region), strict=True):
        assert found.dtype == wanted.dtype
        assert np.array_equal(found, wanted, equal_nan=True)
    assert decoder.complete
    assert decoder.max_error == 0
    whole = ls.Decoder(selection_of(ls.Target(region=region)))
    whole.feed(container)
    assert np.array_equal(whole.surface().points, window.points, equal_nan=True)
    assert not any(math.isnan(view.rms) for view in decoder.layers)
    for view in decoder.layers[:-1:8]:  # to decode every layer proves no more
        assert view.points.shape == window.points.shape
    if region == REGIONS[0] and kind in ("integers", "floats", "holes"):
        assert decoder.bytes < 0.9 * len(container)


#: Of a surface that is as small as it may be for several of the largest tiles.
FEWER = [((0, 20), (0, 30)), ((30, 60), (200, 259)), ((79, 80), (0, 270)), ((0, 80), (0, 270))]

SIZES = [((4, 4), (4, 4)), ((1, 7), (9, 7)), ((3, 6), (7, 1)), ((8, 8), (5, 3))]


@pytest.mark.sweep(6)
@pytest.mark.parametrize(("tile", "chunk"), SIZES, ids=repr)
@pytest.mark.parametrize("kind", ["integers", "floats", "holes"])
@pytest.mark.long
def test_tiles_and_chunks_of_any_size_are_read(
    kind: str, tile: tuple[int, int], chunk: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(prepared, "tile_exponents", lambda *_: tile)
    monkeypatch.setattr(prepared, "chunk_exponents", lambda *_: [chunk])
    surface = surface_of(kind, 80, 270)
    container = ls.encode(surface)
    header = index_of(container).header
    assert (header.tile, header.chunk) == (tile, chunk)
    assert np.array_equal(ls.decode(container).points, surface.points, equal_nan=True)
    for region in FEWER:
        window = received(container, ls.Target(region=region)).surface()
        assert np.array_equal(window.points, cut(surface, region)[0], equal_nan=True)


@pytest.mark.parametrize("shape", [(3, 9000), (9000, 3)])
def test_several_narrow_blocks_are_read(shape: tuple[int, int]) -> None:
    rows, columns = np.indices(shape).astype(float)
    points = np.stack([columns, rows, np.sin(columns / 50)], axis=2)
    shift = np.array([0, 0, 9])
    blocks = [ls.Block(points), ls.Block(points + shift), ls.Block(np.swapaxes(points, 0, 1) - shift)]
    container = ls.encode(ls.Surface(blocks=blocks))
    for block, found in zip(blocks, ls.decode(container).blocks, strict=True):
        np.testing.assert_array_equal(found.points, block.points)


@examples(40)
@given(
    st.tuples(st.integers(1, 90), st.integers(1, 90)),
    st.sampled_from(CLOSURES),
    st.tuples(st.floats(0, 1), st.floats(0, 1), st.floats(0, 1), st.floats(0, 1)),
    st.integers(0, 2**32),
)
def test_what_is_not_needed_has_no_part_in_a_window(
    shape: tuple[int, int], closed: tuple[bool, bool], corners: tuple[float, ...], seed: int
) -> None:
    if shape[0] * shape[1] < 2:
        return
    layout = Layout.single(shape, closed, (3, 3))
    rows, columns = (
        sorted((int(a * n), min(int(b * n), n - 1))) for a, b, n in zip(corners[:2], corners[2:], shape, strict=True)
    )
    region = (rows[0], rows[1] + 1), (columns[0], columns[1] + 1)
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
    place = slice(*region[0]), slice(*region[1])
    np.testing.assert_array_equal(values[place], original[place])


def test_only_the_attributes_that_are_wanted_are_sent() -> None:
    heights = wave(60, 70)
    surface = ls.Surface(heights, attributes={"a": heights * 2, "b": (heights > 0).astype(np.uint8)})
    container = ls.encode(surface)
    sizes = {}
    for names in ((), ("a",), ("b",), ("a", "b")):
        decoder = received(container, ls.Target(attributes=names))
        found = decoder.surface()
        assert tuple(found.attributes) == names
        assert found.points.tobytes() == heights.tobytes()
        assert all(found.attributes[name].tobytes() == surface.attributes[name].tobytes() for name in names)
        assert decoder.layers[0].rms > 0
        sizes[names] = decoder.bytes
    assert sizes[()] < sizes["b",] < sizes["a",] < sizes["a", "b"]


@pytest.mark.parametrize(
    "target",
    [
        ls.Target(region=((0, 61), (0, 10))),
        ls.Target(region=((0, 10), (70, 71))),
        ls.Target(attributes=("nothing",)),
    ],
)
def test_what_is_not_there_is_refused(target: ls.Target) -> None:
    container = ls.encode(wave(60, 70))
    with pytest.raises(ls.OptionError, match="expected"):
        plan(index_of(container), target)
    with pytest.raises(ls.OptionError, match="expected"):
        ls.Decoder(selection_of(target)).feed(container)


@pytest.mark.parametrize("region", [((5, 5), (0, 3)), ((-1, 4), (0, 3)), ((4, 2), (0, 3))])
def test_an_empty_region_is_refused(region: Any) -> None:
    with pytest.raises(ls.OptionError, match="at least one row and column"):
        ls.Target(region=region)
