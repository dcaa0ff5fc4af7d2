"""The kernel of the embedded coder beside the reference decoder, and with what it must refuse."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from lodestream import kernels
from lodestream.entropy.band_fields import COLUMN_SHIFT, COLUMNS, FLAGS, KIND, OFFSET, PARENT, ROW_SHIFT, ROWS, STRIDE
from lodestream.entropy.bitplanes import code_passes, new_models
from lodestream.entropy.tiles import TileTable, gather
from lodestream.grid.layout import Layout

from .reference_units import ReferenceUnits
from .test_bitplanes import coefficients

Ints = NDArray[np.int32]
HUGE = 1 << 40


class Arrays:
    """All that the kernel is given for a channel of which all tiles are coded as one run each."""

    def __init__(self, table: TileTable, trellis: bool) -> None:
        self.table, self.trellis = table, trellis
        self.known, self.sign = np.zeros(table.size, np.int32), np.zeros(table.size, np.int8)
        self.flags, self.early = np.zeros(table.blocks, np.uint8), np.zeros(table.size, np.uint8)
        self.models = new_models(len(table.members), trellis)

    def run(self, tile: int, first: int, last: int, start: int, length: int) -> list[int]:
        """A row of the table of runs."""
        bands = self.table.first[tile]
        return [bands, self.table.first[tile + 1] - bands, tile, first, last, start, length, 0]

    def code(
        self, reading: bool, runs: NDArray[np.int64], true: Ints, data: NDArray[np.uint8], costs: Any = None
    ) -> None:
        """Call the kernel."""
        costs = np.zeros(0) if costs is None else costs
        arrays = self.known, self.sign, self.flags, self.early, true, self.models, data, costs
        code_passes(reading, self.table.bands, runs, *arrays, self.trellis)


def a_table(shape: tuple[int, int], tile: tuple[int, int] = (2, 3)) -> TileTable:
    return TileTable.of(Layout.single(shape, (False, True), tile))


shapes = st.tuples(st.integers(1, 40), st.integers(2, 40))


@given(
    shape=shapes,
    bits=st.integers(1, 28),
    density=st.sampled_from([0.02, 0.3, 1.0]),
    cut=st.integers(0, 54),
    trellis=st.booleans(),
    seed=st.integers(0, 2**32),
)
def test_what_is_written_is_read_as_the_reference_reads_it(
    shape: tuple[int, int], bits: int, density: float, cut: int, trellis: bool, seed: int
) -> None:
    table = a_table(shape)
    true = gather(table, [coefficients(shape, bits, density, seed)])
    writer, reader = Arrays(table, trellis), Arrays(table, trellis)
    reference, passes = ReferenceUnits(table), 2 * bits - 1
    last = min(cut, passes - 1)
    for tile in range(len(table.members)):
        segments = []
        for first, end in ((passes - 1, last), (last - 1, 0)):
            if first < end:
                continue
            data, costs = np.zeros(64 + 64 * table.size, np.uint8), np.zeros(passes)
            runs = np.array([writer.run(tile, first, end, 0, data.size)])
            writer.code(False, runs, true, data, costs)
            written = data[: runs[0, 6]]
            # The shortest string that names a number in the interval: no more than a byte beyond what the bits take.
            assert len(written) <= costs[end] / 8 + 1 + 1e-6
            assert (np.diff(costs[end : first + 1]) <= 0).all()
            reader.code(True, np.array([reader.run(tile, first, end, 0, len(written))]), true[:0], written)
            segments.append((first, end, written.tobytes()))
        reference.read(tile, segments, large=False, indices=trellis)
    assert np.array_equal(reference.known * reference.sign, true)
    for arrays in (writer, reader):
        assert np.array_equal(arrays.known, reference.known)
        assert np.array_equal(arrays.sign, reference.sign)
        assert np.array_equal(arrays.early, writer.early)
        assert np.array_equal(arrays.models, writer.models)


@given(shape=shapes, bits=st.integers(1, 28), trellis=st.booleans(), data=st.binary(max_size=200))
def test_any_bytes_are_read_as_the_reference_reads_them(
    shape: tuple[int, int], bits: int, trellis: bool, data: bytes
) -> None:
    table = a_table(shape)
    reader, reference = Arrays(table, trellis), ReferenceUnits(table)
    tiles = range(len(table.members))
    for tile in tiles:
        reference.read(tile, [(2 * bits - 2, 0, data)], large=False, indices=trellis)
    runs = np.array([reader.run(tile, 2 * bits - 2, 0, 0, len(data)) for tile in tiles])
    reader.code(True, runs, np.zeros(0, np.int32), np.frombuffer(data, np.uint8).copy())
    assert np.array_equal(reader.known, reference.known)
    assert np.array_equal(reader.sign, reference.sign)


@pytest.mark.parametrize("trellis", [False, True])
@pytest.mark.parametrize("budget", [1, 70, 1000])
def test_calls_that_are_cut_short_go_on_where_they_stopped(trellis: bool, budget: int) -> None:
    shape = (70, 60)
    table = a_table(shape, (4, 5))
    true = gather(table, [coefficients(shape, 9, 0.4, 1)])
    results = []
    for at_once in (budget, 1 << 40):
        arrays, data = Arrays(table, trellis), np.zeros(1 << 20, np.uint8)
        room = data.size // len(table.members)
        tiles = range(len(table.members))
        runs = np.array([arrays.run(tile, 16, 0, tile * room, room) for tile in tiles])
        done = []
        for reading in (False, True):
            if reading:
                arrays = Arrays(table, trellis)
            given_true = true[:0] if reading else true
            state, calls, finished = np.zeros(kernels.PASSES_STATE, np.int64), 0, 0
            own = arrays.known, arrays.sign, arrays.flags, arrays.early, given_true, arrays.models, data
            while finished < len(runs):
                finished = kernels.passes(
                    reading,
                    trellis,
                    table.bands,
                    runs,
                    *own,
                    np.zeros(17 * (not reading)),
                    np.zeros(0, np.uint16),
                    state,
                    at_once,
                )
                calls += 1
            done.append(calls)
            assert np.array_equal(arrays.known * arrays.sign, true)
        assert (min(done) > 4) == (at_once == budget)
        results.append((runs.copy(), data))
    assert np.array_equal(results[0][0], results[1][0])
    assert np.array_equal(results[0][1], results[1][1])


def test_a_run_is_checked_when_it_is_its_turn() -> None:
    shape = (30, 30)
    table = a_table(shape)
    arrays, data = Arrays(table, False), np.zeros(100, np.uint8)
    runs = np.array([arrays.run(0, 3, 0, 0, 50), arrays.run(1, 3, 0, 60, 50)])
    state = np.zeros(kernels.PASSES_STATE, np.int64)
    own = arrays.known, arrays.sign, arrays.flags, arrays.early, np.zeros(0, np.int32), arrays.models, data
    nothing = np.zeros(0), np.zeros(0, np.uint16)
    assert kernels.passes(True, False, table.bands, runs, *own, *nothing, state, 1) == 0
    with pytest.raises(ValueError, match="do not fit"):
        kernels.passes(True, False, table.bands, runs, *own, *nothing, state, 1 << 30)


def a_call(**changes: Any) -> int:
    """Read a tile, with something else than what fits: fields of its last band or of the run, sizes, or the state."""
    table = a_table((20, 20))
    arrays, tile = Arrays(table, False), len(table.members) - 1
    bands, runs = table.bands.copy(), np.array([arrays.run(tile, 10, 0, 0, 30)])
    state = np.zeros(kernels.PASSES_STATE, np.int64)
    given: dict[str, Any] = {
        "known": arrays.known,
        "sign": arrays.sign,
        "flags": arrays.flags,
        "early": arrays.early,
        "true": np.zeros(0, np.int32),
        "models": arrays.models,
        "data": np.full(30, 77, np.uint8),
        "costs": np.zeros(0),
        "symbols": np.zeros(0, np.uint16),
    }
    reading, budget = changes.pop("reading", True), changes.pop("budget", 1 << 20)
    for name, change in changes.items():
        if name.startswith("band"):
            bands[-1, int(name[4:])] = change
        elif name.startswith("run"):
            runs[0, int(name[3:])] = change
        elif name.startswith("state"):
            state[int(name[5:])] = change
        else:
            given[name] = given[name].ravel()[:change].copy()
    return kernels.passes(reading, False, bands, runs, *given.values(), state, budget)


def test_the_call_that_others_differ_from_is_taken() -> None:
    assert a_call() == 1


@pytest.mark.parametrize("column", [ROWS, COLUMNS])
def test_a_band_without_coefficients_may_lie_anywhere(column: int) -> None:
    assert a_call(**{f"band{column}": 0, f"band{OFFSET}": 2**40}) == 1


@pytest.mark.parametrize(
    "changes",
    [
        *({f"band{column}": value} for column in range(10) for value in (-1, HUGE, 2**62, -(2**63), 2**63 - 1)),
        *({f"band{column}": 10**5} for column in (OFFSET, STRIDE, ROWS, COLUMNS, FLAGS, PARENT)),
        {f"band{ROW_SHIFT}": 2},
        {f"band{COLUMN_SHIFT}": 30},
        {f"band{KIND}": 4},
        {f"band{OFFSET}": 3},
        {f"band{FLAGS}": 1},
        {f"band{PARENT}": 0},
        *({f"run{column}": value} for column in range(8) for value in (-2, 2**62, -(2**63), 2**63 - 1)),
        {"run0": 1000},
        {"run1": 1000},
        {"run2": 1000},
        {"run3": 56},
        {"run5": 1},
        {"run6": 31},
        *({name: 50} for name in ("known", "sign", "early", "models")),
        {"flags": 3},
        {"reading": False},
        {"budget": 0},
        {"state0": 2},
        {"state0": -1},
        *({f"state{place}": -1} for place in (1, 2, 3)),
        {"state1": 1, "state6": 0},
        {"state1": 1, "state6": 2**32},
        {"state1": 1, "state6": 2**32 - 1, "state7": -1},
        {"state1": 1, "state6": 2**32 - 1, "state5": 2**40},
    ],
)
def test_what_does_not_fit_is_refused(changes: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        a_call(**changes)


def test_a_writer_stays_in_the_room_it_has() -> None:
    shape = (30, 30)
    table = a_table(shape, (5, 5))
    true = gather(table, [coefficients(shape, 20, 1.0, 3)])
    for room in (0, 1, 100):
        arrays, data = Arrays(table, False), np.full(300, 9, np.uint8)
        tile = len(table.members) - 1
        with pytest.raises(ValueError, match="do not fit"):
            arrays.code(False, np.array([arrays.run(tile, 38, 0, 100, room)]), true, data)
        assert (data[:100] == 9).all()
        assert (data[100 + room :] == 9).all()


def test_gains_refuse_what_does_not_fit() -> None:
    table = a_table((20, 20))
    bands, true, early = table.of_tile(0).copy(), np.zeros(table.size, np.int32), np.zeros(table.size, np.uint8)
    weights, errors = np.ones(len(bands)), np.zeros(9)
    assert kernels.pass_gains(bands, weights, true, early, errors) == 0
    for call in (
        (bands, weights[1:], true, early, errors),
        (bands, weights, true[1:].copy(), early, errors),
        (bands, weights, true, early, errors[:0]),
        (bands, weights, true, early, np.zeros(90)),
    ):
        with pytest.raises(ValueError, match="do not fit"):
            kernels.pass_gains(*call)
    for column in (OFFSET, STRIDE, ROWS, COLUMNS):
        for value in (-1, 10**6, 2**62, 2**63 - 1):
            hostile = bands.copy()
            hostile[0, column] = value
            if column == STRIDE and bands[0, ROWS] == 1 and 0 <= value <= 10**6:
                continue  # the way to a row that is not there
            with pytest.raises(ValueError, match="do not fit"):
                kernels.pass_gains(hostile, weights, true, early, errors)
