from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import lodestream as ls
from lodestream import Decoder, OptionError, Target, Tolerance, TruncatedStreamError, View, kernels
from lodestream.container import Index, describe
from lodestream.decoding.region import Region
from lodestream.encoding import prepared
from lodestream.parallel import VARIABLE
from lodestream.planning.planner import plan
from lodestream.target import Order

from ..surfaces import SAMPLES, contained, errors, figures, follow, index_of, is_told, terrain

ORDERS: tuple[Order, ...] = ("quality", "level")
Told = list[tuple[tuple[int, int, int, float, float, bool], bytes]]


def told(views: list[View]) -> Told:
    """Everything that views say and show."""
    return [(figures(view), view.points.tobytes()) for view in views]


def assert_measured(name: str, view: View) -> None:
    """The errors that a view tells are those of what it shows."""
    original = SAMPLES[name][0]
    rms, worst = errors(original, view.points)
    assert is_told(view.rms, rms)
    assert is_told(view.max_error, worst)


def states(container: bytes) -> list[View]:
    """All views of a container in file order."""
    return Decoder().feed(container)


@pytest.mark.parametrize("name", SAMPLES)
def test_every_layer_has_exactly_the_recorded_errors(name: str) -> None:
    container, index = contained(name)
    views = states(container)
    records = [(r.number, r.level, r.end, r.rms, r.max_error) for r in index.layers]
    if index.residual:
        left = index.levels[-1]
        records.append((len(records), index.header.levels, index.surface_end, left.rms, left.max_error))
    assert [figures(view)[:5] for view in views] == records
    assert [view.complete for view in views] == [False] * (len(views) - 1) + [True]
    for view in views:
        assert_measured(name, view)
    levels = [view.level for view in views]
    assert levels == sorted(levels)


def coded_level(index: Index, level: int) -> int:
    """The finest level up to this one of which there is a segment."""
    levels = {index.header.layout.tiles[segment.tile].level for segment in index.segments}
    return max(found for found in levels if found <= level)


@pytest.mark.sweep(8)
@pytest.mark.parametrize("name", SAMPLES)
def test_every_level_has_exactly_the_recorded_errors(name: str) -> None:
    container, index = contained(name)
    for record in index.levels:
        for order in ORDERS:
            decoder, _ = follow(container, plan(index, Target(level=record.level, order=order)))
            view = decoder.view()
            assert (view.rms, view.max_error) == (record.rms, record.max_error)
            if index.segments:
                assert view.level in (record.level, coded_level(index, record.level))
                assert view.complete == (record.level == index.header.levels)
            assert_measured(name, view)
            assert decoder.points_at(record.level).shape[:2] == record.shape
            assert decoder.metadata == {"name": name}


def test_tiles_that_no_layer_names_are_known_with_their_level(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a level that is there as a whole nothing more comes: tiles without a segment are zeros."""
    monkeypatch.setattr(prepared, "tile_exponents", lambda *_: (4, 4))
    heights = np.zeros((130, 130), np.int16)
    heights[:, :50] = np.random.default_rng(3).integers(-9, 10, (130, 50)).cumsum(0).cumsum(1) // 4
    container = ls.encode(heights)
    index = index_of(container)
    tiles = index.header.layout.tiles
    named = {segment.tile for segment in index.segments}
    for record in index.levels[:-1]:
        view = follow(container, plan(index, Target(level=record.level, order="level")))[0].view()
        rms, worst = errors(heights, view.points)
        assert is_told(record.rms, rms)
        assert is_told(record.max_error, worst)
    levels = {tile.level for number, tile in enumerate(tiles) if number not in named}
    assert levels & {tiles[number].level for number in named} - {index.header.levels}


@pytest.mark.sweep(6)
@pytest.mark.parametrize("name", SAMPLES)
@pytest.mark.long
def test_every_prefix_decodes_to_its_last_whole_layer(name: str) -> None:
    container, _ = contained(name)
    expected = told(states(container))
    ends = [figures_[2] for figures_, _ in expected]
    # Of the larger containers, fewer prefixes: each is decoded from its start.
    all_of_them = len(container) < 1000
    for length in range(len(container) + 1):
        near = all_of_them or {length - 1, length, length + 1} & set(ends)
        if not near and length % 61:
            continue
        decoder = Decoder()
        views = decoder.feed(container[:length])
        whole = sum(end <= length for end in ends)
        assert len(views) == len(decoder.layers) == whole
        assert decoder.complete == (whole == len(ends))
        if whole < len(ends):
            with pytest.raises(TruncatedStreamError, match="expected"):
                decoder.finish()
        else:
            decoder.finish()
        if whole:
            assert figures(decoder.view()) == expected[whole - 1][0]
            assert decoder.view().points.tobytes() == expected[whole - 1][1]
            assert (decoder.bytes, decoder.rms) == (ends[whole - 1], decoder.view().rms)
        else:
            assert decoder.bytes == 0
            with pytest.raises(TruncatedStreamError, match="one whole layer"):
                decoder.view()


def chunkings(length: int) -> list[list[int]]:
    """Where chunks end: whole, byte by byte, and some random ones."""
    rng = np.random.default_rng(length)
    cuts = [sorted({int(n) for n in rng.integers(0, length, count)} | {length}) for count in (1, 3, 10, 40)]
    return [[length], list(range(1, length + 1)), [length, length], *cuts]


@pytest.mark.sweep(8)
@pytest.mark.parametrize("name", SAMPLES)
def test_every_chunking_gives_the_same_views(name: str) -> None:
    container, index = contained(name)
    expected = told(states(container))
    for ends in chunkings(len(container)):
        decoder, views, start = Decoder(), [], 0
        for end in ends:
            views += decoder.feed(memoryview(container)[start:end])
            start = end
        assert told(views) == told(decoder.layers) == expected
        decoder.finish()
        assert decoder.metadata == {"name": name}
        assert decoder.index is not None
        assert describe(decoder.index) == describe(index)


def some_targets(name: str) -> list[Target]:
    """All levels in both orders, and every kind of limit."""
    _, index = contained(name)
    middle = index.layers[len(index.layers) // 2]
    found = [Target(level=k, order=order) for k in range(index.header.levels + 1) for order in ORDERS]
    for order in ORDERS:
        found += [
            Target(order=order),
            Target(until_rms=Tolerance(middle.rms), order=order),
            Target(until_max=Tolerance(middle.max_error), order=order),
            Target(max_bytes=max(middle.end, index.levels[0].bytes), order=order),
        ]
    return found


@pytest.mark.sweep(6)
@pytest.mark.parametrize("name", SAMPLES)
def test_every_plan_leads_to_the_state_that_it_says(name: str) -> None:
    container, index = contained(name)
    for number, target in enumerate(some_targets(name)):
        made = plan(index, target)
        decoder, views = follow(container, made)
        view = decoder.view()
        assert (view.bytes, view.rms, view.max_error) == (made.bytes, made.rms, made.max_error)
        # Where nothing but the header is needed, the surface is complete at once, whatever the target.
        assert not index.segments or decoder.complete == (made.ended == "complete")
        assert not index.segments or view.level in (made.level, coded_level(index, made.level))
        marks = {(m.bytes, m.rms, m.max_error) for m in made.marks}
        seen = {(v.bytes, v.rms, v.max_error) for v in views}
        assert marks <= seen
        # A layer or a level may happen to become whole on the way, and is seen too.
        others = {(rms, worst) for _, rms, worst in seen - marks}
        layers, levels = ({(r.rms, r.max_error) for r in index.layers}, {(r.rms, r.max_error) for r in index.levels})
        assert others <= layers | levels
        for view in views:
            assert_measured(name, view)
        expected = told(views)
        chunks = (1, 7, 64, 1000)[number // 2 % 4]  # of two targets in turn, one in either order
        again, same = follow(container, made, chunks)
        assert told(same) == expected
        assert again.metadata == {"name": name}
        if target == Target() or target == Target(order="level"):
            assert again.surface().points.tobytes() == ls.decode(container).points.tobytes()


@pytest.mark.parametrize("name", SAMPLES)
def test_views_stay_what_they_were_when_finer_ones_have_come(name: str) -> None:
    container, index = contained(name)
    early = []
    decoder = Decoder()
    for end in [layer.end for layer in index.layers]:
        early += told(
            decoder.feed(container[decoder.bytes or 0 : end]) if decoder.layers else decoder.feed(container[:end])
        )
    lazy = Decoder()
    views = lazy.feed(container)
    # Asked from the last to the first, after everything has come.
    assert told(views[::-1])[::-1][: len(early)] == early
    assert told(views)[: len(early)] == early


def test_a_level_s_grid_is_the_best_grid_of_its_size() -> None:
    container, index = contained("heights")
    best = ls.hierarchy(SAMPLES["heights"][0])
    decoder = Decoder()
    decoder.feed(container)
    step = index.header.lattices[0].step
    for level, grid in enumerate(best):
        assert np.abs(decoder.points_at(level) - grid).max() <= 4.5 * step
        # Levels up to this one are all that its grid needs.
        partial, _ = follow(container, plan(index, Target(level=level)))
        np.testing.assert_array_equal(partial.points_at(level), decoder.points_at(level))
    for level in (-1, len(best)):
        with pytest.raises(OptionError, match=f"0 to {len(best) - 1}"):
            decoder.points_at(level)


@pytest.mark.parametrize("name", SAMPLES)
def test_grids_have_the_dtype_and_axes_of_the_original(name: str) -> None:
    container, index = contained(name)
    original = SAMPLES[name][0]
    for view in states(container)[:: max(1, len(index.layers) // 3)]:
        assert view.points.dtype == original.dtype
        assert view.points.shape == original.shape
        for record in index.levels:
            grid = view.points_at(record.level)
            assert grid.dtype == original.dtype
            assert record.shape is not None
            assert grid.shape == (*record.shape, *original.shape[2:])
    surface = ls.decode(container)
    assert surface.closed == SAMPLES[name][1]
    assert surface.metadata == {"name": name}
    if SAMPLES[name][2] is None:
        assert surface.points.tobytes() == original.tobytes()


@pytest.mark.parametrize("name", SAMPLES)
def test_the_description_has_the_keys_of_the_contract(name: str) -> None:
    container, index = contained(name)
    told = describe(index)
    points, closed, precision = SAMPLES[name]
    shape = list(points.shape[:2])
    assert (told["shape"], told["closed"]) == (shape, list(closed))
    assert told["blocks"] == [{"shape": shape, "closed": list(closed)}]
    assert (told["bytes"], told["metadata"]) == (len(container), {"name": name})
    assert told["exact"] is (precision is None)
    assert [level["level"] for level in told["levels"]] == list(range(index.header.levels + 1))
    for level in told["levels"]:
        assert set(level) == {"level", "shape", "bytes", "rms", "max"}
    for layer in told["layers"]:
        assert set(layer) == {"bytes", "level", "rms", "max"}
    assert told["levels"][-1]["shape"] == shape
    assert told["levels"][-1]["bytes"] == index.surface_end
    assert_plain(told)


def assert_plain(value: Any) -> None:
    """Values that JSON holds, and nothing like them."""
    if isinstance(value, dict):
        assert all(type(key) is str for key in value)
        for member in value.values():
            assert_plain(member)
    elif isinstance(value, list):
        for member in value:
            assert_plain(member)
    else:
        assert type(value) in (int, float, bool, str, type(None))


def test_a_large_surface_of_several_tiles_keeps_its_promises_too() -> None:
    points: NDArray[Any] = np.rint(terrain((400, 391), 3)).astype(np.int32)
    container = ls.encode(points)
    index = index_of(container)
    assert len(index.header.layout.tiles) > 10
    assert 1 < index.header.large < index.header.levels
    for view, record in zip(states(container)[::6], index.layers[::6], strict=True):
        rms, worst = errors(points, view.points)
        assert view.rms == record.rms
        assert is_told(view.rms, rms)
        assert is_told(view.max_error, worst)
    expected = index.levels[4]
    for order in ORDERS:
        decoder, _ = follow(container, plan(index, Target(level=4, order=order)), 1777)
        rms, worst = errors(points, decoder.view().points)
        assert is_told(expected.rms, rms)
        assert is_told(expected.max_error, worst)
        whole, _ = follow(container, plan(index, Target(order=order)), 10_007)
        np.testing.assert_array_equal(whole.surface().points, points)


def feed_in_bytes(decoder: Decoder, data: bytes) -> None:
    for place in range(len(data)):
        decoder.feed(data[place : place + 1])


def test_bytes_after_the_end_and_a_damaged_footer_are_refused_and_the_surface_stays() -> None:
    container = ls.encode(terrain((9, 12)))
    damaged = container[:-9] + bytes([container[-9] ^ 1]) + container[-8:]
    for data in (container + b"\x00", damaged):
        whole, bytewise = Decoder(), Decoder()
        with pytest.raises(ls.CorruptStreamError):
            whole.feed(data)
        with pytest.raises(ls.CorruptStreamError):
            feed_in_bytes(bytewise, data)
        assert whole.complete
        assert bytewise.complete


@pytest.mark.parametrize("shape", [(150, 130), (190, 180)])
def test_an_interrupted_view_is_decoded_on_from_where_it_was(
    shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    container = ls.encode(terrain(shape))
    assert bool(index_of(container).header.large) == (shape == (190, 180))
    wanted = Decoder()
    wanted.feed(container)
    surface = wanted.surface()
    passes, calls = kernels.passes, 0

    def interrupted(*arguments: Any) -> int:
        nonlocal calls
        calls += 1
        done = passes(*arguments[:-1], 5000)
        if calls % 3 == 0 and calls < 15:
            raise KeyboardInterrupt
        return done

    monkeypatch.setattr(kernels, "passes", interrupted)
    decoder = Decoder()
    interrupts = 0
    try:
        decoder.feed(container[: index_of(container).surface_end])  # which applies the residual
    except KeyboardInterrupt:
        interrupts += 1
    while True:
        try:
            points = decoder.surface().points
            break
        except KeyboardInterrupt:
            interrupts += 1
    assert interrupts == 4
    assert np.array_equal(points, surface.points)


def test_long_segments_are_windows_of_what_arrived_and_those_of_a_caller_s_buffer_copies() -> None:
    heights = np.random.default_rng(5).integers(0, 4000, (200, 300)).astype(np.int16)
    container = ls.encode(heights)
    for given in (container, bytearray(container), memoryview(bytearray(container))):
        decoder = Decoder()
        decoder.feed(given)
        lent = [s.data.obj for s in decoder._queue._waiting.values() if isinstance(s.data, memoryview)]
        assert lent
        assert all(isinstance(data, bytes) for data in lent)
        assert all(data is container for data in lent) == (given is container)
        if not isinstance(given, bytes):
            given[:] = bytes(len(container))  # what the caller does next
        np.testing.assert_array_equal(decoder.view().points, heights)


@pytest.mark.parametrize("path", ["hill.lode", Path("hill.lode")])
def test_the_path_of_a_container_is_not_its_bytes(path: Any) -> None:
    with pytest.raises(ls.InputError, match=r"the bytes of a container, got .*hill.lode.*: pass what .*read_bytes"):
        ls.decode(path)


def test_decode_forgets_what_states_before_the_last_one_need(monkeypatch: pytest.MonkeyPatch) -> None:
    """It takes a byte a value less than a decoder whose earlier views may still be asked for."""
    monkeypatch.setenv(VARIABLE, "1")  # what several threads hold at once depends on their turns
    heights = np.rint(np.random.default_rng(2).normal(0, 9, (500, 600)).cumsum(axis=0)).astype(np.int16)
    container = ls.encode(heights)

    def by_decoder() -> ls.Surface:
        decoder = Decoder()
        decoder.feed(container)
        decoder.finish()
        return decoder.surface()

    ls.decode(container)  # what is imported or computed once
    peaks = []
    for decode in (by_decoder, lambda: ls.decode(container)):
        tracemalloc.start()
        surface = decode()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        np.testing.assert_array_equal(surface.points, heights)
    assert peaks[1] <= peaks[0] - 0.9 * heights.size


def test_a_last_state_with_passes_left_keeps_what_it_needs() -> None:
    decoder = Decoder()
    decoder.feed(ls.encode(terrain((60, 70))))
    queue, header = decoder._queue, decoder.header
    assert header is not None
    region, odd = Region.whole(header.layout, header.levels), 0
    for view in decoder.layers[:-1]:
        expected = queue.values(queue.length, view._state, region)[0].arrays[0]
        queue.keep_last(view._state)
        np.testing.assert_array_equal(queue.values(queue.length, view._state, region)[0].arrays[0], expected)
        odd += int((view._state % 2 == 1).sum())
    assert odd, "passes are left of planes that have begun"
