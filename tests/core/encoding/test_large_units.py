"""Large units beside the reference decoder, and surfaces that have such."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.entropy import bitplanes
from lodestream.entropy.bitplanes import pass_count, symbols_room
from lodestream.entropy.tile_coder import Channel, TileCoder
from lodestream.entropy.tiles import Run, Tiles, TileTable, gather
from lodestream.grid.layout import Layout
from tests.examples import examples

from ..entropy.coding import planes_of
from ..entropy.reference_units import ReferenceUnits, places_of
from ..entropy.test_bitplanes import coefficients

Ints = NDArray[np.int32]
#: Of a unit: first and last pass, and the bytes.
Segments = list[tuple[int, int, bytes]]


def noise(seed: int) -> bytes:
    """Enough of it for decisions in many planes."""
    return np.random.default_rng(seed).bytes(5000)


shapes = st.tuples(st.integers(2, 40), st.integers(2, 150)).filter(lambda shape: shape[0] * shape[1] <= 2000)
exponents = st.tuples(st.integers(1, 5), st.integers(1, 7))
closures = st.tuples(st.booleans(), st.booleans())
budgets = st.sampled_from([1, 70, 1000, 1 << 21])


def a_table(shape: tuple[int, int], closed: tuple[bool, bool], tile: tuple[int, int]) -> TileTable:
    return TileTable.of(Layout.single(shape, closed, tile))


def channel_of(table: TileTable, values: Ints) -> Channel:
    top = np.array(planes_of(table.layout, values), np.int8)
    return Channel(gather(table, [values]), np.ones(len(table.bands)), top)


def cut(rng: np.random.Generator, passes: int) -> list[tuple[int, int]]:
    """First and last passes of segments."""
    chosen = np.flatnonzero(rng.random(passes) < rng.choice([0.0, 0.1, 0.5, 1.0]))
    ends = sorted({passes, 0, *chosen.tolist()}, reverse=True)
    return [(first - 1, last) for first, last in itertools.pairwise(ends)]


def read(table: TileTable, units: dict[int, Segments], budget: int) -> Tiles:
    """Read all units, in as many calls of the kernel as a budget needs."""
    tiles = Tiles(table, None, 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bitplanes, "_COEFFICIENTS_PER_CALL", budget)
        tiles.read([Run(tile, *segment) for tile, segments in units.items() for segment in segments])
    return tiles


def check_alike(found: Tiles, expected: Tiles | ReferenceUnits) -> None:
    for name in ("known", "sign", "early", "flags") if isinstance(expected, Tiles) else ("known", "sign"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), err_msg=name)


@given(
    shape=shapes,
    closed=closures,
    tile=exponents,
    bits=st.integers(1, 28),
    density=st.sampled_from([0.02, 0.3, 1.0]),
    count=st.integers(1, 2),
    budget=budgets,
    seed=st.integers(0, 2**32),
)
@examples(10)
def test_what_is_written_is_read_in_any_segments_and_calls(
    shape: tuple[int, int],
    closed: tuple[bool, bool],
    tile: tuple[int, int],
    bits: int,
    density: float,
    count: int,
    budget: int,
    seed: int,
) -> None:
    table, rng = a_table(shape, closed, tile), np.random.default_rng(seed)
    channels = [channel_of(table, coefficients(shape, bits, density, seed + k)) for k in range(count)]
    coder = TileCoder([table] * count, channels, count, None, 1)
    for number, channel in enumerate(channels):
        units: dict[int, Segments] = {}
        expected = ReferenceUnits(table)
        for unit in range(1, len(table.members)):
            passes = pass_count(int(channel.top[unit]))
            costs, units[unit] = np.zeros(passes), []
            for first, last in cut(rng, passes):
                data = coder.code(unit, number, first + 1, first + 1 - last, costs)
                units[unit].append((first, last, data))
            if passes:
                whole, ends = coder.strings[unit, number]
                assert (costs == 8 * ends).all()
                assert (len(whole), sorted(ends, reverse=True)) == (ends[0], list(ends))
                starts = [0 if first == passes - 1 else ends[first + 1] for first, *_ in units[unit]]
                chunks = [whole[start : ends[last]] for start, (_, last, _) in zip(starts, units[unit], strict=True)]
                assert [chunk or b"\0" for chunk in chunks] == [data for *_, data in units[unit]]
            if units[unit]:
                expected.read(unit, units[unit], large=True)
        reader = read(table, units, budget)
        check_alike(reader, expected)
        check_alike(reader, coder.tiles[number])
        for band in table.bands[table.first[1] :]:
            places = places_of(band.tolist())
            np.testing.assert_array_equal((reader.known * reader.sign)[places], channel.true[places])


@given(
    shape=shapes,
    tile=exponents,
    bits=st.integers(1, 28),
    data=st.lists(st.one_of(st.binary(max_size=300), st.integers(0, 2**32).map(noise)), min_size=1, max_size=4),
    budget=budgets,
)
@examples(10)
def test_any_bytes_are_read_as_the_reference_reads_them(
    shape: tuple[int, int], tile: tuple[int, int], bits: int, data: list[bytes], budget: int
) -> None:
    table = a_table(shape, (False, True), tile)
    starts = np.linspace(2 * bits - 1, 0, len(data) + 1).astype(int)
    cuts = [(first - 1, last) for first, last in itertools.pairwise(starts.tolist())]
    segments = [(*cut, part) for cut, part in zip(cuts, data, strict=True) if cut[0] >= cut[1]]
    expected = ReferenceUnits(table)
    units = dict.fromkeys(range(1, len(table.members)), segments)
    for unit in units:
        expected.read(unit, segments, large=True)
    reader = read(table, units, budget)
    check_alike(reader, expected)
    models = {tuple(model.tolist()) for model in reader.models[1:]}
    assert all(p < 2**16 and n <= 127 for model in models for p, n in ((c & 0xFFFF, c >> 16) for c in model[:68]))


SHAPE, TILE = (30, 140), (5, 7)
ENOUGH = {"data": 20_000, "costs": 17, "symbols": symbols_room(30 * 140, 9), "truth": -1, "state": kernels.PASSES_STATE}


def a_call(reading: bool, **changes: int) -> tuple[int, bytes]:
    """Code the last tile with something else than what fits: fields of the run, the state or the model, or lengths.

    What the kernel returns, and what it then has of the bytes.
    """
    trellis = bool(changes.get("trellis"))
    table = a_table(SHAPE, (False, False), TILE)
    true = gather(table, [coefficients(SHAPE, 9, 0.5, 1)])
    tiles, tile = Tiles(table, None, 1), changes.get("tile", len(table.members) - 1)
    lengths = {**ENOUGH, **{name: value for name, value in changes.items() if name in ENOUGH}}
    first = table.first[tile]
    runs = np.array([[first, table.first[tile + 1] - first, tile, 16, 0, 100, lengths["data"], 1]])
    state = np.zeros(lengths["state"], np.int64)
    for name, value in changes.items():
        if name.startswith("run"):
            runs[0, int(name[3:])] = value
        elif name.startswith("state_"):
            state[int(name[6:])] = value
        elif name.startswith("model"):
            tiles.models[tile, int(name[5:])] = value
        elif name == "early":
            tiles.early[:] = value
    data = np.full(100 + lengths["data"] + 100, 9, np.uint8)
    given = tiles.known, tiles.sign, tiles.flags, tiles.early, true[:0] if reading else true
    room = np.zeros(lengths["costs"]), np.zeros(lengths["symbols"], np.uint16)
    models = np.zeros((len(table.members), kernels.TRELLIS_MODEL), np.int32) if trellis else tiles.models
    try:
        done = kernels.passes(reading, trellis, table.bands, runs, *given, models, data, *room, state, 1 << 20)
    finally:
        assert (data[:100] == 9).all()
        assert (data[-100:] == 9).all()
    return done, data[100 : 100 + runs[0, 6]].tobytes()


def test_the_calls_that_others_differ_from_are_taken() -> None:
    written = a_call(False)[1]
    assert a_call(True)[0] == a_call(True, run6=0)[0] == 1
    assert a_call(False, symbols=ENOUGH["symbols"] + 1)[1] == written
    assert 1000 < len(written) < 15_000


@pytest.mark.parametrize(
    ("reading", "changes"),
    [
        *((False, {name: length}) for name in ("data", "costs", "symbols") for length in (0, 1, 7, 10, 16, 1000)[:5]),
        *((False, {name: 1000}) for name in ("data", "symbols")),
        *((False, {"symbols": 9 * 30 * 40 + more}) for more in (0, 3000)),
        (False, {"tile": 1, "symbols": 1000}),  # enough for its few coefficients, but not for any stripe's
        (False, {"run3": -1}),
        (False, {"run3": -1, "data": 0}),
        (False, {"run4": 2}),
        (False, {"run3": 17}),
        *((reading, {"trellis": True}) for reading in (False, True)),
        *((reading, {"run7": value}) for reading in (False, True) for value in (-1, 2, 2**62)),
        *((True, {f"state_{place}": -1}) for place in (1, 2, 3)),
        *((True, {"state_1": 1, f"state_{place}": value}) for place in (5, 7) for value in (-1, 2**50)),
        (True, {"state_1": 1, "state_5": 8}),
        (True, {"state_1": 1, "state_7": 20_001}),
    ],
)
def test_calls_of_large_units_that_do_not_fit_are_refused(reading: bool, changes: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        a_call(reading, **changes)


@given(
    state=st.tuples(*[st.sampled_from([0, 1, 2, 5, 17, 1000, 2**40, 2**63 - 1])] * 3),
    bits=st.sampled_from([0, 1, 7]),
    place=st.integers(0, 20_000),
    model=st.tuples(st.integers(0, 69), st.sampled_from([0, 1, 2**16 - 1, 2**31 - 1, -1, -(2**31)])),
    early=st.integers(0, 255),
)
@examples(15)
def test_whatever_was_kept_a_call_ends_and_stays_in_its_arrays(
    state: tuple[int, int, int], bits: int, place: int, model: tuple[int, int], early: int
) -> None:
    """Sanitizers see to the arrays."""
    kept = {"state_1": state[0], "state_2": state[1], "state_3": state[2], "state_5": bits, "state_7": place}
    assert a_call(True, early=early, **kept, **{f"model{model[0]}": model[1]})[0] == 1
    assert a_call(False, early=early)[0] == 1
