"""Windows of coarser levels: values in every state, what is sent, errors, metadata and refusals."""

from __future__ import annotations

import functools
import math
import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

import lodestream as ls
from lodestream.coordinates.height_fields import coordinates
from lodestream.decoding.level_grids import level_nodes
from lodestream.decoding.view import View
from lodestream.grid.layout import Layout
from lodestream.grid.support import needed_tiles
from lodestream.grid.window import among, check_region, places, spanning
from lodestream.planning.planner import plan
from lodestream.planning.window_errors import read_window_errors
from lodestream.target import Region
from lodestream.transform.lifting import CLAMP
from lodestream.transform.pyramid import allocate, forward, inverse
from tests.examples import examples

from ..decoding.comparison import surfaces
from ..decoding.test_every_state import small_tiles
from ..grid.layouts import tubes
from ..surfaces import index_of, terrain

Places = tuple[NDArray[np.int64], NDArray[np.int64]]


@st.composite
def regions(draw: st.DrawFn, shape: tuple[int, int], closed: tuple[bool, bool]) -> Region:
    spans = []
    for length, wraps in zip(shape, closed, strict=True):
        start = draw(st.integers(0, length - 1))
        spans.append((start, draw(st.integers(start + 1, start + length if wraps else length))))
    return spans[0], spans[1]


def encoded(surface: ls.Surface, tiles: tuple[int, int] | None) -> bytes:
    with small_tiles(tiles), warnings.catch_warnings():
        warnings.simplefilter("ignore", ls.FormatWarning)  # what attributes have at holes is left out
        return ls.encode(surface)


def standing(header: Any, region: Region, level: int) -> Places:
    """The rows and columns of a level's grid that stand in a region, in its order; from the definition."""
    found = []
    for nodes, span, length in zip(level_nodes(header, level)[0], region, header.shape, strict=True):
        place = {int(node): number for number, node in enumerate(nodes)}
        found.append(np.array([place[at % length] for at in range(*span) if at % length in place], np.int64))
    return found[0], found[1]


def assert_cut(window: ls.Surface, whole: ls.Surface, inside: Places) -> None:
    """A window is what its rows and columns of the level's grid are, bit for bit."""
    block, other = window.blocks[0], whole.blocks[0]
    for found, wanted in zip(
        (block.points, *block.attributes.values()), (other.points, *other.attributes.values()), strict=True
    ):
        assert found.dtype == wanted.dtype
        assert found.tobytes() == wanted[np.ix_(*inside)].tobytes()
    valid, wanted_valid = (np.ones(b.shape, np.bool_) if b.mask is None else b.mask for b in (block, other))
    assert np.array_equal(valid, wanted_valid[np.ix_(*inside)])


def is_shown(whole: ls.Surface, inside: Places) -> bool:
    """Whether rows and columns of a surface are one: two points, one of them valid."""
    mask = whole.blocks[0].mask
    return inside[0].size * inside[1].size > 1 and (mask is None or bool(mask[np.ix_(*inside)].any()))


def check_window(view: View, region: Region, level: int, inside: Places) -> None:
    whole = view.surface(level)
    if inside[0].size * inside[1].size < 2:
        with pytest.raises(ls.OptionError, match="points of level"):
            view.window(region, level)
    elif not is_shown(whole, inside):
        with pytest.raises(ls.InputError):
            view.window(region, level)
    else:
        window = view.window(region, level)
        assert_cut(window, whole, inside)
        if len(window.blocks[0].points.shape) == 2 and whole.metadata:  # heights lie where they lie in the level
            for found, wanted in zip(coordinates(window), coordinates(whole), strict=True):
                if all(np.all(np.diff(line) > 0) for line in inside):  # else they go on across the seam
                    np.testing.assert_allclose(found, wanted[np.ix_(*inside)], rtol=1e-12)


@examples(20)
@given(
    surface=surfaces()
    | tubes().map(
        lambda blocks: ls.Surface(
            blocks=[ls.Block(block.coordinates.astype("f8"), block.closed, mask=block.mask) for block in blocks]
        )
    ),
    data=st.data(),
)
@pytest.mark.long
def test_the_window_of_a_level_is_cut_out_of_it_in_every_state(surface: ls.Surface, data: st.DataObject) -> None:
    container = encoded(surface, data.draw(st.sampled_from([None, (4, 4), (3, 5)])))
    decoder = ls.Decoder()
    views = decoder.feed(container)
    header = decoder.header
    assert header is not None
    if len(header.blocks) > 1:
        with pytest.raises(ls.OptionError, match="one block"):
            views[-1].window(((0, 1), (0, 1)), 0)
        return
    region = data.draw(regions(*header.blocks[0]))
    # At full resolution what is known in the window may be known sooner: `test_seam_windows` looks at that.
    level = data.draw(st.integers(0, header.levels))
    inside = standing(header, region, level)
    for view in views[-1:] if level == header.levels else views:
        check_window(view, region, level, inside)


@examples(20)
@given(surface=surfaces(), data=st.data())
@pytest.mark.long
def test_what_is_sent_for_the_window_of_a_level_is_enough(surface: ls.Surface, data: st.DataObject) -> None:
    container = encoded(surface, data.draw(st.sampled_from([None, (4, 4), (3, 5)])))
    index = index_of(container)
    header = index.header
    assume(len(header.blocks) == 1)
    region, level = data.draw(regions(*header.blocks[0])), data.draw(st.integers(0, header.levels))
    inside = standing(header, region, level)
    order: ls.Order = data.draw(st.sampled_from(["quality", "level"]))
    target = ls.Target(region=region, level=level, order=order)
    if inside[0].size * inside[1].size < 2:
        with pytest.raises(ls.OptionError, match="points of level"):
            plan(index, target)
        return
    chosen = plan(index, target)
    decoder, whole = ls.Decoder(target), ls.Decoder(ls.Target(level=level, order=order))
    shown = [view for place in chosen.slices for view in feed(decoder, container, place)]
    for place in plan(index, whole_target := ls.Target(level=level, order=order)).slices:
        feed(whole, container, place)
    assert chosen.ended == ("complete" if level == header.levels else "level")
    assert decoder.bytes == chosen.bytes <= plan(index, whole_target).bytes
    assert shown[-1].number == chosen.marks[-1].number
    states = {view.bytes: view for view in shown}
    assert {mark.bytes for mark in chosen.marks} <= states.keys()
    if level < header.levels:
        finer = header.layout.tiles_of(level).stop
        for place in chosen.ranges:
            assert place.end <= (index.residual.offset if index.residual else index.surface_end)
            for segment in index.segments:
                if segment.tile >= finer:
                    assert segment.range.end <= place.offset or place.end <= segment.range.offset
    if not is_shown(whole.surface(level), inside):
        return
    assert_cut(decoder.surface(), whole.surface(level), inside)
    with pytest.raises(ls.OptionError, match=f"level of 0 to {level}, got {level + 1}"):
        decoder.surface(level + 1)
    coarser = data.draw(st.integers(0, level))
    check_window_of_window(decoder.view(), whole, region, coarser)
    # In every state on the way the window is that of the whole surface in that state.
    views = ls.Decoder().feed(container)
    if order == "quality":
        for mark in chosen.marks[:-1]:
            own, view = states[mark.bytes], views[mark.number]
            assert (own.number, own.level, own.rms, own.max_error) == (
                mark.number,
                mark.level,
                mark.rms,
                mark.max_error,
            )
            assert_cut(own.surface(), view.surface(level), inside)
    followed = ls.Decoder(ls.Selection(region, level=level))
    for own, view in zip(followed.feed(container), views, strict=True):
        assert_cut(own.surface(), view.surface(level), inside)


def check_window_of_window(view: View, whole: ls.Decoder, region: Region, level: int) -> None:
    """A coarser level of a window that was received."""
    assert whole.header is not None
    inside = standing(whole.header, region, level)
    if inside[0].size * inside[1].size and is_shown(whole.surface(level), inside):
        assert_cut(view.window(region, level), whole.surface(level), inside)
        assert_cut(view.surface(level), whole.surface(level), inside)


def feed(decoder: ls.Decoder, container: bytes, place: Any) -> list[View]:
    return decoder.feed_at(place.offset, container[place.offset : place.end])


@functools.cache
def heights() -> tuple[NDArray[np.float32], bytes]:
    original = terrain((400, 600), 4).astype(np.float32)
    return original, ls.encode(original)


REGION = ((60, 140), (310, 420))


@pytest.mark.parametrize("order", ["quality", "level"])
def test_fewer_bytes_than_of_the_level_or_of_the_window_and_its_own_errors(order: ls.Order) -> None:
    original, container = heights()
    index = index_of(container)
    level = index.header.levels - 2
    chosen = plan(index, ls.Target(region=REGION, level=level, order=order))
    assert chosen.bytes < 0.8 * plan(index, ls.Target(level=level)).bytes
    assert chosen.bytes < 0.5 * plan(index, ls.Target(region=REGION)).bytes
    # The errors are bounds of those that the surface of this level has inside.
    whole = ls.Decoder(ls.Target(level=level))
    for place in plan(index, ls.Target(level=level)).slices:
        feed(whole, container, place)
    rows, columns = (slice(*span) for span in REGION)
    off = np.abs(whole.surface().points.astype(float) - original)[rows, columns]
    last = index.levels[level]
    assert (
        math.sqrt(np.mean(off**2))
        <= chosen.rms
        <= min(last.rms * math.sqrt(original.size / off.size), last.max_error) * 1.001
    )
    assert off.max() <= chosen.max_error <= last.max_error
    assert chosen.rms > last.rms  # that of the whole surface is no bound of that of a part
    decoder = ls.Decoder(ls.Target(region=REGION, level=level))
    for place in chosen.slices:
        feed(decoder, container, place)
    assert (decoder.rms, decoder.max_error, decoder.view().bound) == (chosen.rms, chosen.max_error, True)
    assert not decoder.complete
    # Bounds of cells could end no stream sooner, and are not sent.
    windows = read_window_errors(index, lambda offset, length: container[offset : offset + length])
    assert windows is not None
    assert plan(index, ls.Target(region=REGION, level=level, order=order), windows=windows) == chosen


def test_no_layer_with_finer_data_is_told_as_a_state() -> None:
    _, container = heights()
    index = index_of(container)
    level = index.header.levels - 3
    for target in (ls.Target(region=REGION, level=level), ls.Target(attributes=(), level=level)):
        marks = plan(index, target).marks
        assert len(marks) > 1
        for mark in marks[:-1]:
            assert index.layers[mark.number].level <= level


@examples(40)
@given(
    st.tuples(st.integers(1, 90), st.integers(1, 90)),
    st.tuples(st.booleans(), st.booleans()),
    st.data(),
    st.integers(0, 2**32),
)
def test_what_is_not_needed_has_no_part_in_the_window_of_a_level(
    shape: tuple[int, int], closed: tuple[bool, bool], data: st.DataObject, seed: int
) -> None:
    assume(shape[0] * shape[1] > 1)
    layout = Layout.single(shape, closed, (3, 3))
    level = data.draw(st.integers(0, layout.levels))
    region = data.draw(regions(layout.shape(0, level), closed))
    rng = np.random.default_rng(seed)
    values = allocate(shape)
    values[...] = rng.integers(-(2**20), 2**20, shape)
    predictors = forward([values], layout)
    other = values.copy()
    needed = needed_tiles(layout, region, level)
    assert not needed[layout.tiles_of(level).stop :].any()
    for number, tile in enumerate(layout.tiles):
        for band in tile.bands:
            if not needed[number]:
                other[slice(*band.rows), slice(*band.columns)] = rng.integers(-CLAMP // 64, CLAMP // 64)
    cuts = []
    for array in (values, other):
        room = allocate(shape)
        room[...] = array
        inverse([room], layout, predictors, level)
        grid = room[tuple(slice(length) for length in layout.shape(0, level))]
        cuts.append(grid[np.ix_(*(places(*of) for of in zip(region, grid.shape, strict=True)))])
    np.testing.assert_array_equal(cuts[0], cuts[1])


@given(st.integers(1, 60), st.data())
def test_the_points_of_a_level_that_stand_in_a_window(length: int, data: st.DataObject) -> None:
    shape = (length, 1)
    nodes = np.array(sorted(data.draw(st.sets(st.integers(0, length - 1), min_size=1))), np.int64)
    region = data.draw(regions(shape, (True, False)))
    wanted = [int(np.flatnonzero(nodes == at % length)[0]) for at in range(*region[0]) if at % length in nodes]
    found = among(region, shape, (nodes, np.zeros(1, np.int64)))
    assert (found is None) == (not wanted)
    if found is not None:
        assert places(found[0], len(nodes)).tolist() == wanted
        around = spanning(found, shape, (nodes, np.zeros(1, np.int64)))
        check_region(around, shape, (True, False))
        assert among(around, shape, (nodes, np.zeros(1, np.int64))) == found
        assert 0 <= found[0][0] < len(nodes)


@pytest.mark.parametrize(
    "metadata",
    [
        {},
        {"geotransform": [-5.0, 10.0, 0.0, 90.0, 0.0, -9.0]},
        {"axes": {"x": [0, 10], "y": [85.5, -9]}},
        {"axes": {"x": [*map(float, range(0, 390, 10)), "values"], "y": [85.5, -9]}},
    ],
)
def test_coordinates_are_those_of_the_level(metadata: dict[str, Any]) -> None:
    original = ls.Surface(np.rint(terrain((21, 39))).astype("i4"), (False, True), metadata=metadata)
    decoder = ls.Decoder()
    decoder.feed(ls.encode(original))
    assert decoder.header is not None
    view, level = decoder.view(), decoder.header.levels - 2
    rows, columns = level_nodes(decoder.header, level)[0]
    assert 39 - columns[-1] != columns[1], "the axis has a gap"
    x, y = coordinates(original)
    turn = 390 if metadata else 39  # 39 columns of 10 degrees, or of one step
    for span in ((9, 25), (30, 50), (0, 39)):
        window = view.window(((3, 18), span), level)
        inside = [at for at in range(*span) if at % 39 in columns]
        down = [at for at in rows if 3 <= at < 18]
        found = coordinates(window)
        wanted = x[np.ix_(down, [at % 39 for at in inside])] + [at // 39 * turn for at in inside]
        np.testing.assert_allclose(found[0], wanted, rtol=1e-12)
        np.testing.assert_allclose(found[1], y[np.ix_(down, [at % 39 for at in inside])], rtol=1e-12)
        assert window.closed == (False, len(inside) == len(columns))


@pytest.mark.parametrize("below", [0, 2])
def test_a_turned_geotransform_goes_along_with_a_window(below: int) -> None:
    transform = [5e5, 30.0, 4.0, 4e6, 3.0, -20.0]
    original = ls.Surface(np.rint(terrain((21, 39))).astype("i4"), metadata={"geotransform": transform})
    decoder = ls.Decoder()
    decoder.feed(ls.encode(original))
    assert decoder.header is not None
    level = decoder.header.levels - below
    down, across = level_nodes(decoder.header, level)[0]
    window = decoder.view().window(((3, 18), (9, 25)), level)
    inside = np.ix_(down[(down >= 3) & (down < 18)], across[(across >= 9) & (across < 25)])
    for found, whole in zip(coordinates(window), coordinates(original), strict=True):
        np.testing.assert_allclose(found, whole[inside], rtol=1e-12)


@pytest.mark.parametrize("below", [0, 2])
def test_a_region_with_one_point_of_the_level_is_refused_before_anything_is_sent(below: int) -> None:
    _, container = heights()
    index = index_of(container)
    level, span = index.header.levels - below, (0, 1 << below)
    region = span, span
    said = (
        f"expected a region with at least two points of level {level}, got rows 0:{span[1]}, columns 0:{span[1]}, "
        "where that level has one: ask for a larger region or for a finer level"
    )
    for order in ("quality", "level"):
        with pytest.raises(ls.OptionError, match=said):
            plan(index, ls.Target(region=region, level=level, order=order))
    with pytest.raises(ls.OptionError, match=said):
        ls.Decoder(ls.Selection(region, level=level)).feed(container)
    decoder = ls.Decoder()
    decoder.feed(container)
    with pytest.raises(ls.OptionError, match=said):
        decoder.view().window(region, level)
    larger = (0, 1 + (1 << below)), span
    assert decoder.view().window(larger, level).shape == (2, 1)
    assert plan(index, ls.Target(region=larger, level=level)).bytes
    assert plan(index, ls.Target(first=region)).bytes, "what comes first may be one point"


def test_refusals_say_what_there_is() -> None:
    _, container = heights()
    decoder = ls.Decoder()
    view = decoder.feed(container)[-1]
    with pytest.raises(ls.OptionError, match="expected a region with points of level 0, got rows 1:3, columns 1:3"):
        view.window(((1, 3), (1, 3)), 0)
    with pytest.raises(ls.OptionError, match="expected a level of 0 to"):
        view.window(REGION, 99)
    with pytest.raises(ls.OptionError, match="expected a level as an integer"):
        view.window(REGION, 1.5)  # type: ignore[arg-type]
    with pytest.raises(ls.OptionError, match="expected a level of 0 to"):
        plan(index_of(container), ls.Target(region=REGION, level=99))
    with pytest.raises(ls.OptionError, match="other limits"):
        ls.Target(region=REGION, level=1, until_rms=1)
    received = ls.Decoder(ls.Target(region=REGION, level=4))
    received.feed(container)
    with pytest.raises(ls.OptionError, match="inside the one received"):
        received.view().window(((0, 200), (0, 200)), 3)


def test_memory_is_counted_for_the_window_of_the_level_alone() -> None:
    _, container = heights()
    small = ls.Decoder(ls.Target(region=REGION, level=4), max_vertices=2_000)
    small.feed(container[:200])
    assert small.header is not None
    with pytest.raises(ls.TooLargeError):
        ls.Decoder(ls.Target(region=REGION), max_vertices=2_000).feed(container[:200])
