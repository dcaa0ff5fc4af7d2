"""Coefficients of one channel cut into tiles for the embedded coder: flat arrays, zeros around each band."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..grid.layout import REMEMBERED, Layout
from ..grid.tile_arrays import AT_ONCE, BandArrays, runs_of
from ..kernels import PASSES_STATE
from ..quantization.band_steps import Quantiser, band_step
from .band_fields import COLUMNS, OFFSET, ROWS, STRIDE
from .bitplanes import PADDING, code_passes, new_models
from .dequantize import spread_bands
from .stacks import Stacks

__all__ = ["BandClass", "Reading", "Run", "TileTable", "Tiles", "gather"]

#: Parent fields of a band without a parent: a zero between zeros, to which shifts by 31 map any row and column.
NO_PARENT = (1, 0, 31, 31)

#: Arguments of a decoding call: no coefficients to write, and no costs.
_NO_COEFFICIENTS, _NO_COSTS = np.zeros(0, np.int32), np.zeros(0)

#: Column of a table of runs: the first byte of a run, see `bitplanes.code_passes`.
RUN_START = 5

#: Zeros before the first band in a flat array: bands without a parent refer to them.
_MARGIN = 3


class BandClass(NamedTuple):
    """Properties shared by bands of many tiles: level, grid, and whether they hold details along rows and columns."""

    level: int
    grid: int
    kind: tuple[bool, bool]


class TileTable:
    """Positions of all bands in the flat arrays, of all tiles of a surface or of some.

    Two numbers are stored for each tile; tables of the bands are computed on demand.

    Parameters
    ----------
    layout : Layout
    coordinate : bool
        For coordinates, or for other channels: without interfaces.
    chosen : int64, shape (tile,), optional
        The table is of these tiles of the layout alone, in this order, and numbers them anew. Bands whose parents are
        not among them have none. All if not given.

    Attributes
    ----------
    members : range, or int64 of shape (tile,)
        The numbers that the table's tiles have in the layout.
    first : int64, shape (tile + 1,)
        Number of each tile's first band, and the number of bands at the end.
    starts : int64, shape (tile + 1,)
        Where each tile begins in the flat arrays of coefficients, zeros around its bands included, and where the last
        one ends.
    size, blocks : int
        Lengths of the flat arrays of coefficients and of block flags.
    """

    def __init__(self, layout: Layout, coordinate: bool = True, chosen: NDArray[np.int64] | None = None) -> None:
        self.layout, self.coordinate, self.chosen = layout, coordinate or not layout.shared, chosen
        self.members: range | NDArray[np.int64] = range(layout.tile_arrays.count) if chosen is None else chosen
        count = len(self.members)
        self.first, self.starts, self.blocks = np.zeros(count + 1, np.int64), np.full(count + 1, _MARGIN), 0
        for run in runs_of(count):
            arrays = self._arrays_of(run)
            ends = np.cumsum(np.bincount(arrays.tile, minlength=len(run)))
            sizes, blocks = _sizes(arrays.shape)
            sums = np.concatenate([[0], np.cumsum(sizes)])
            self.first[run.start + 1 : run.stop + 1] = self.first[run.start] + ends
            self.starts[run.start + 1 : run.stop + 1] = self.starts[run.start] + sums[ends]
            self.blocks += int(blocks.sum())
        self.size = int(self.starts[-1]) + PADDING
        # The arrays of a small table are kept: `bands`, `origins` and `of_grid` need them next.
        self._kept = arrays if 0 < count <= AT_ONCE else None

    @staticmethod
    def of(layout: Layout, coordinate: bool = True) -> TileTable:
        """Return the table of all tiles of a surface, the same object for the same layout."""
        return _table(layout, coordinate or not layout.shared)

    @cached_property
    def bands(self) -> NDArray[np.int64]:
        """The kernels' table of all tiles' bands in order, int64, shape (band, `band_fields.BAND_FIELDS`)."""
        arrays = self._arrays()
        height, width = arrays.shape.T
        stride, across = width + 2, (width + 7) // 8
        sizes, blocks = _sizes(arrays.shape)
        place = _MARGIN + np.cumsum(sizes) - sizes + 2 * stride + 2
        flags = np.cumsum(blocks) - blocks + across + 2
        columns = [place, stride, height, width, flags, *self._joined(arrays, place, stride), arrays.kind]
        return np.ascontiguousarray(np.array(columns).T)

    @cached_property
    def without_bands(self) -> NDArray[np.int64]:
        """The tiles that have none, int64, shape (tile,)."""
        return np.flatnonzero(np.diff(self.first) == 0)

    @cached_property
    def origins(self) -> NDArray[np.int64]:
        """Of each band: its tile, and its first row and column in the array of coefficients; int64, shape (band, 3)."""
        arrays = self._arrays()
        return np.ascontiguousarray(np.array([arrays.tile, *arrays.start.T]).T)

    @cached_property
    def of_grid(self) -> list[NDArray[np.int64]]:
        """For each grid the numbers of its bands, coarsest level first; int64 arrays of shape (band,)."""
        if len(self.layout.grids) == 1:
            return [np.arange(self.first[-1])]
        grids = self._arrays().grid
        ends = np.cumsum(np.bincount(grids, minlength=len(self.layout.grids)))
        return np.split(np.argsort(grids, kind="stable"), ends[:-1])

    def of_grids(self, chosen: range) -> list[NDArray[np.int64]]:
        """Return `of_grid` for consecutive grids, int64, shape (band,) each; other grids cost nothing."""
        grids = self._arrays().grid
        order = np.argsort(grids, kind="stable")
        ends = np.searchsorted(grids[order], np.arange(chosen.start, chosen.stop + 1))
        return [order[first:last] for first, last in pairwise(ends.tolist())]

    def classes(self) -> tuple[list[BandClass], NDArray[np.int64]]:
        """Return the distinct classes of the bands, and the class number of each band, int64, shape (band,)."""
        arrays, grids = self._arrays(), len(self.layout.grids)
        codes = (arrays.level * grids + arrays.grid) * 4 + arrays.kind
        present = np.flatnonzero(np.bincount(codes))
        number = np.zeros(4 * grids * (self.layout.levels + 1), np.int64)
        number[present] = np.arange(len(present))
        classes = [BandClass(k // 4 // grids, k // 4 % grids, (k % 4 > 1, k % 2 == 1)) for k in present.tolist()]
        return classes, number[codes]

    def steps(self, quantiser: Quantiser) -> NDArray[np.int64]:
        """Return the step of each band, in lattice steps; int64, shape (band,)."""
        classes, of_band = self.classes()
        return np.array([band_step(*band_class, self.layout, quantiser) for band_class in classes], np.int64)[of_band]

    def tiles_from(self, level: int) -> int:
        """Return the number of the first tile of a level or of finer levels, or else the number of tiles."""
        first = self.layout.tiles_from(level)
        return first if self.chosen is None else int(np.searchsorted(self.chosen, first))

    def level_of(self, tile: int) -> int:
        """Return the level of one of the table's tiles."""
        return self.layout.level_of(self.members[tile])

    def of_tile(self, tile: int) -> NDArray[np.int64]:
        """Return the rows of one tile's bands, shape (band, `band_fields.BAND_FIELDS`), a view."""
        return self.bands[self.first[tile] : self.first[tile + 1]]

    def _arrays_of(self, run: range) -> BandArrays:
        """Compute the arrays of the bands of a run of the table's tiles."""
        numbers = np.arange(run.start, run.stop) if self.chosen is None else self.chosen[run.start : run.stop]
        return self.layout.tile_arrays.bands(numbers, self.coordinate)

    def _arrays(self) -> BandArrays:
        """Compute the arrays of the bands of all tiles."""
        return self._arrays_of(range(len(self.members))) if self._kept is None else self._kept

    def _joined(
        self, arrays: BandArrays, place: NDArray[np.int64], stride: NDArray[np.int64]
    ) -> tuple[NDArray[np.int64], ...]:
        """Return the parent fields of the bands, see `bitplanes.code_passes`: four arrays of shape (band,)."""
        numbers, grids = np.asarray(self.members), len(self.layout.grids)
        above = self.layout.tile_arrays.parents(numbers)
        if self.chosen is not None:
            order = np.argsort(numbers, kind="stable")
            position = order[np.minimum(np.searchsorted(numbers, above, sorter=order), len(order) - 1)]
            above = np.where(numbers[position] == above, position, -1)
        if not len(arrays.tile):
            return *np.zeros((2, 0), np.int64), *arrays.halved.T
        # The parent of a band has its grid and its kind, and bands stand by tile, grid and kind.
        keys, parent_tile = (arrays.tile * grids + arrays.grid) * 4 + arrays.kind, above[arrays.tile]
        wanted = keys + 4 * grids * (parent_tile - arrays.tile)
        parent = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
        known = (parent_tile >= 0) & (keys[parent] == wanted)
        # Without its first row, which comes from an interface, a band has an odd origin: its parent's has one too.
        row, column = (((arrays.origin + arrays.halved) >> arrays.halved) - arrays.origin[parent]).T
        joined = place[parent] + row * stride[parent] + column, stride[parent], *arrays.halved.T
        return tuple(np.where(known, a, b) for a, b in zip(joined, NO_PARENT, strict=True))


@lru_cache(maxsize=REMEMBERED)
def _table(layout: Layout, coordinate: bool) -> TileTable:
    """Make the table of all tiles of a layout."""
    return TileTable(layout, coordinate)


def _sizes(shape: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the elements that bands of a shape, (band, axis), take of coefficients and of block flags, (band,)."""
    height, width = shape.T
    # Two rows and two columns of zeros around each band: contexts read beyond its sides without a test.
    return (height + 4) * (width + 2) + 2, ((height + 7) // 8 + 2) * ((width + 7) // 8 + 1) + 1


class Run(NamedTuple):
    """Passes of a tile, from ``first`` down to ``last``, and their bytes."""

    tile: int
    first: int
    last: int
    data: bytes | memoryview


class Reading:
    """Runs of passes that are decoded in order, in one or more calls.

    Readings of different tiles may run in parallel, unless one has a tile whose parent is in the other.
    """

    def __init__(self, tiles: Tiles, table: NDArray[np.int64], parts: list[bytes | memoryview]) -> None:
        self._tiles, self._table, self._parts = tiles, table, parts
        self._state = np.zeros(PASSES_STATE, np.int64)

    def run(self) -> None:
        """Decode the runs. After an interruption, another call continues; once all are decoded, it does nothing."""
        if self._state[0] < len(self._table):
            data = np.frombuffer(bytearray().join(self._parts), np.uint8)  # kernels take writable arrays
            self._tiles.code(True, self._table, _NO_COEFFICIENTS, data, _NO_COSTS, self._state)
            self._parts = []


class Tiles:
    """Magnitudes, signs, block flags, marks of first passes and models of one channel, see `bitplanes.code_passes`.

    Where there is a quantiser, they are those of indices; otherwise the units of level ``large`` and finer ones are
    large, none if it is 0. The attribute ``large`` is the first such tile.
    """

    def __init__(self, table: TileTable, quantiser: Quantiser | None = None, large: int = 0) -> None:
        self.table = table
        self.steps = np.zeros(len(table.bands), np.int64) if quantiser is None else table.steps(quantiser)
        self.known = np.zeros(table.size, np.int32)
        self.sign = np.zeros(table.size, np.int8)
        self.flags = np.zeros(table.blocks, np.uint8)
        self.early = np.zeros(table.size, np.uint8)
        self.trellis = quantiser is not None
        self.large = len(table.members) if self.trellis else table.tiles_from(large)
        self.models = new_models(len(table.members), self.trellis, self.large)

    def read(self, runs: Sequence[Run]) -> None:
        """Decode runs of passes in order."""
        self.readings(runs, [len(runs)])[0].run()

    def readings(self, runs: Sequence[Run], ends: Sequence[int]) -> list[Reading]:
        """Divide the runs at ``ends`` into readings, each from the end before it."""
        fields = np.array([(tile, first, last, len(data)) for tile, first, last, data in runs], np.int64).reshape(-1, 4)
        tile, length = fields[:, 0], fields[:, 3]
        table = np.empty((len(fields), 8), np.int64)  # bands, their number, tile, first, last, start, length, large
        table[:, 0] = self.table.first[tile]
        table[:, 1] = self.table.first[tile + 1] - table[:, 0]
        table[:, 2:5] = fields[:, :3]
        table[:, RUN_START] = length.cumsum() - length
        table[:, 6] = length
        table[:, 7] = tile >= self.large
        readings, begin = [], 0
        for end in ends:
            rows = table[begin:end]
            if begin:
                rows[:, RUN_START] -= rows[:1, RUN_START].copy()
            readings.append(Reading(self, rows, [run.data for run in runs[begin:end]]))
            begin = end
        return readings

    def forget_passes(self) -> None:
        """Forget in which passes coefficients were found, a byte a value: nothing is read any more.

        Only states of which no passes remain can be shown from now on.
        """
        self.early = self.sign.view(np.uint8)  # kernels want as many numbers, and look at none where no passes remain

    def code(
        self,
        reading: bool,
        runs: NDArray[np.int64],
        true: NDArray[np.int32],
        data: NDArray[np.uint8],
        costs: NDArray[np.float64],
        state: NDArray[np.int64] | None = None,
        symbols: NDArray[np.uint16] | None = None,
    ) -> None:
        """Decode or encode runs of passes; `bitplanes.code_passes` describes the shapes of all arrays."""
        arrays = self.known, self.sign, self.flags, self.early, true, self.models, data, costs
        code_passes(reading, self.table.bands, runs, *arrays, self.trellis, state, symbols)

    def spread(self, tile: int, remaining: int, coefficients: Sequence[NDArray[np.int32]]) -> None:
        """Write a tile's coefficients, estimated from all but the last ``remaining`` passes, into arrays of grids.

        ``coefficients`` have the shape (row, column) of each grid. Unknown bits are replaced by the reconstruction
        point; bits coded by the remaining passes count as unknown.
        """
        state = np.full(len(self.table.layout.tiles), remaining, np.int8)
        first, last = self.table.first[tile : tile + 2]
        for array, numbers in zip(coefficients, self.table.of_grid, strict=True):
            self._spread(numbers[(numbers >= first) & (numbers < last)], state, array, len(state))

    def stacks(self, arrays: Sequence[NDArray[np.int32] | None]) -> Stacks:
        """Return the stacks of arrays of coefficients for `spread_levels`, shape (row, column), one for each grid.

        None stands for a grid that is passed over.
        """
        return Stacks(self.table.origins, self.table.of_grid, arrays)

    def spread_levels(
        self,
        level: int,
        state: NDArray[np.int8],
        stacks: Stacks,
        whole: int,
        bare: Collection[int] = (),
    ) -> None:
        """Apply `spread` to all tiles of the levels up to one; tiles that were not announced give zeros.

        Parameters
        ----------
        level : int
        state : int8, shape (tile,)
            Passes that remain of each tile.
        stacks : Stacks
            Those of `stacks`. Values of their arrays at the places of these tiles are overwritten.
        whole : int
            Coefficients of levels above this one are multiplied by 2**`FRACTION_BITS`.
        bare : collection of int
            These levels are passed over.
        """
        table, state = self.table, np.ascontiguousarray(state)
        finer = table.tiles_from(whole + 1)
        for lowest, highest in _runs(0, level, bare):
            span = table.first[[table.tiles_from(lowest) if lowest else 0, table.tiles_from(highest + 1)]]
            for plane, numbers in stacks.planes:
                bands = numbers[slice(*np.searchsorted(numbers, span))]
                self._spread(bands, state, plane, finer, origins=stacks.origins)

    def spread_part(
        self,
        numbers: NDArray[np.int64],
        state: NDArray[np.int8],
        part: NDArray[np.int32],
        origin: tuple[int, int],
        finer: bool,
    ) -> None:
        """Apply `spread` to bands in a part of a grid; bands of tiles that were not announced give zeros.

        Parameters
        ----------
        numbers : int64, shape (band,)
            In the table.
        state : int8, shape (tile,)
        part : int32, shape (row, column)
            The grid's coefficients from the row and column ``origin`` on.
        finer : bool
            They are multiplied by 2**`FRACTION_BITS`.
        """
        self._spread(numbers, state, part, 0 if finer else len(self.table.members), origin)

    def band(self, number: int, state: NDArray[np.int8], finer: bool) -> NDArray[np.int32]:
        """Apply `spread` to one band, by its number in the table; return int32, shape (row, column).

        ``finer``: its coefficients are multiplied by 2**`FRACTION_BITS`.
        """
        height, width = (int(n) for n in self.table.bands[number, [ROWS, COLUMNS]])
        array = np.zeros((height, width), np.int32)
        tile, first_row, first_column = (int(n) for n in self.table.origins[number])
        self._spread(np.array([number]), state, array, tile if finer else tile + 1, (first_row, first_column))
        return array

    def _spread(
        self,
        numbers: NDArray[np.int64],
        state: NDArray[np.int8],
        array: NDArray[np.int32],
        finer: int,
        origin: tuple[int, int] = (0, 0),
        origins: NDArray[np.int64] | None = None,
    ) -> None:
        """Write the estimated coefficients of some bands into an array whose first element is at ``origin``.

        ``origins`` are those of the table, unless the array has other rows.
        """
        origins = self.table.origins if origins is None else origins
        arrays = self.known, self.sign, self.early, self.table.bands, origins, self.steps
        spread_bands(*arrays, numbers, np.ascontiguousarray(state), finer, array, origin)


def _runs(first: int, last: int, without: Collection[int]) -> Iterator[tuple[int, int]]:
    """Yield the numbers from ``first`` to ``last`` as (first, last) of runs, omitting those in ``without``."""
    for number in (*sorted(n for n in without if first <= n <= last), last + 1):
        if first < number:
            yield first, number - 1
        first = number + 1


def gather(
    table: TileTable,
    coefficients: Sequence[NDArray[np.int32]],
    origins: NDArray[np.int64] | None = None,
    grids: range | None = None,
) -> NDArray[np.int32]:
    """Collect the signed coefficients of all tiles, shape (`TileTable.size`,), from the arrays of grids, (row, column).

    ``origins`` are those of the table, unless the arrays have other rows; ``grids`` are all, unless the tiles have
    bands of these alone.
    """
    flat, bands = np.zeros(table.size, np.int32), table.bands
    starts = (table.origins if origins is None else origins)[:, 1:]
    of_grid = table.of_grid if grids is None else table.of_grids(grids)
    for array, numbers in zip(coefficients, of_grid, strict=True):
        places = bands[numbers][:, [OFFSET, STRIDE, ROWS, COLUMNS]].tolist()
        for (place, stride, rows, columns), (top, first) in zip(places, starts[numbers].tolist(), strict=True):
            frame = flat[place : place + rows * stride].reshape(rows, stride)
            frame[:, :columns] = array[top : top + rows, first : first + columns]
    return flat
