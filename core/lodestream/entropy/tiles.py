"""Coefficients of one channel cut into tiles, as the embedded coder wants them: flat arrays, zeros around each band."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..grid.layout import REMEMBERED, Band, Layout
from ..kernels import PASSES_STATE
from ..quantization.band_steps import Quantiser, band_step
from .band_fields import BAND_FIELDS, COLUMNS, OFFSET, ROWS, STRIDE
from .bitplanes import PADDING, code_passes, new_models
from .dequantize import spread_bands

__all__ = ["Reading", "Run", "TileTable", "Tiles", "gather"]

#: A band without a parent finds a zero between zeros, to which 31 shifts any row or column.
_NO_PARENT = (1, 0, 31, 31)

#: Where reading: no coefficients that would be written, and no costs.
_NOTHING, _FREE = np.zeros(0, np.int32), np.zeros(0)

#: Column of a table of runs: where a run's bytes begin, see `bitplanes.code_passes`.
RUN_START = 5

#: By grid and kind, a tile's bands, where they begin in the flat arrays, and their strides there.
_Places = dict[tuple[int, int], tuple[Band, int, int]]


@dataclass(frozen=True)
class TileTable:
    """Places of all bands in the flat arrays.

    Attributes
    ----------
    bands : int64, shape (band, `band_fields.BAND_FIELDS`)
        Of all tiles in order.
    first : list of int
        Number of each tile's first band, and the number of bands at the end.
    size, blocks : int
        Lengths of the flat arrays of coefficients and of block flags.
    origins : int64, shape (band, 3)
        Of each band: its tile, and its first row and column in the array of coefficients.
    of_grid : list of int64 arrays
        For each grid the numbers of its bands, coarsest level first.
    """

    layout: Layout
    members: list[tuple[Band, ...]]
    bands: NDArray[np.int64]
    first: list[int]
    size: int
    blocks: int
    origins: NDArray[np.int64]
    of_grid: list[NDArray[np.int64]]

    @staticmethod
    @lru_cache(maxsize=REMEMBERED)
    def of(layout: Layout, coordinate: bool = True) -> TileTable:
        """Lay out the tiles of a surface, for its coordinates or for other channels: without interfaces."""
        rows: list[tuple[int, ...]] = []
        origins: list[tuple[int, int, int]] = []
        of_grid: list[list[int]] = [[] for _ in layout.grids]
        first = [0]
        size, blocks = 3, 0
        members = [tile.bands if coordinate else tile.whole for tile in layout.tiles]
        known: list[_Places] = []  # of every tile so far; parents come before their children
        for number, (tile, bands) in enumerate(zip(layout.tiles, members, strict=True)):
            above, own = known[tile.parent] if tile.parent >= 0 else {}, {}
            for band in bands:
                of_grid[band.grid].append(len(rows))
                height, width = band.shape
                stride, across = width + 2, (width + 7) // 8
                place = size + 2 * stride + 2
                flags, kind = blocks + across + 2, 2 * band.kind[0] + band.kind[1]
                # Children are later tiles: they look the place of their parents up here.
                own[band.grid, kind] = band, place, stride
                parent = above.get((band.grid, kind))
                joined = _NO_PARENT if parent is None else _joined(band, tile.level, layout, *parent)
                rows.append((place, stride, height, width, flags, *joined, kind))
                origins.append((number, band.rows[0], band.columns[0]))
                # Two rows and two columns of zeros around each band: contexts read beyond its sides without asking.
                size += (height + 4) * stride + 2
                blocks += ((height + 7) // 8 + 2) * (across + 1) + 1
            first.append(len(rows))
            known.append(own)
        places = np.array(origins, np.int64).reshape(-1, 3)
        of = [np.array(numbers, np.int64) for numbers in of_grid]
        described = np.array(rows, np.int64).reshape(-1, BAND_FIELDS)
        return TileTable(layout, members, described, first, size + PADDING, blocks, places, of)

    def steps(self, quantiser: Quantiser) -> NDArray[np.int64]:
        """The step of each band, in lattice steps; int64, shape (band,)."""
        found: dict[tuple[int, int, tuple[bool, bool]], int] = {}  # many tiles have bands of the same kind
        for tile, bands in zip(self.layout.tiles, self.members, strict=True):
            for band in bands:
                key = tile.level, band.grid, band.kind
                if key not in found:
                    found[key] = band_step(band, tile.level, self.layout, quantiser)
        return np.array(
            [
                found[tile.level, band.grid, band.kind]
                for tile, bands in zip(self.layout.tiles, self.members, strict=True)
                for band in bands
            ],
            np.int64,
        )

    def small_size(self, large: int) -> int:
        """How long the flat array of coefficients is up to the tile ``large``, the first that is not in it."""
        if self.first[large] == len(self.bands):
            return self.size
        row = self.bands[self.first[large]]
        return int(row[OFFSET] - 2 * row[STRIDE] - 2) + PADDING

    def of_small(self, size: int) -> TileTable:
        """The same places in flat arrays that end after so many coefficients, see `small_size`."""
        return replace(self, size=size)

    def of_tile(self, tile: int) -> NDArray[np.int64]:
        """The rows of one tile's bands, shape (band, `band_fields.BAND_FIELDS`), a view."""
        return self.bands[self.first[tile] : self.first[tile + 1]]


class Run(NamedTuple):
    """Passes of a tile, from ``first`` down to ``last``, with their bytes."""

    tile: int
    first: int
    last: int
    data: bytes


class Reading:
    """Runs of passes that are decoded one after another.

    Readings of different tiles may run at the same time, unless one has a tile whose parent the other one has.
    """

    def __init__(self, tiles: Tiles, table: NDArray[np.int64], parts: list[bytes]) -> None:
        self._tiles, self._table, self._parts = tiles, table, parts
        self._state = np.zeros(PASSES_STATE, np.int64)

    def run(self) -> None:
        """Decode; after an interruption another call goes on where it was, and once all is done it does nothing."""
        if self._state[0] < len(self._table):
            data = np.frombuffer(bytearray().join(self._parts), np.uint8)  # kernels take what can be written
            self._tiles.code(True, self._table, _NOTHING, data, _FREE, self._state)
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
        self.large = len(table.members) if self.trellis else table.layout.tiles_from(large)
        self.models = new_models(len(table.members), self.trellis, self.large)

    def read(self, runs: Sequence[Run]) -> None:
        """Decode runs of passes one after another."""
        self.readings(runs, [len(runs)])[0].run()

    def readings(self, runs: Sequence[Run], ends: Sequence[int]) -> list[Reading]:
        """What decodes the runs up to each of ``ends``, from the end before it."""
        described, start, bands = [], 0, self.table.first
        for tile, first, last, data in runs:
            length = len(data)
            count = bands[tile + 1] - bands[tile]
            described.append((bands[tile], count, tile, first, last, start, length, tile >= self.large))
            start += length
        table = np.array(described, np.int64).reshape(-1, 8)
        made, begin = [], 0
        for end in ends:
            own = table[begin:end]
            if begin:
                own[:, RUN_START] -= own[:1, RUN_START].copy()
            made.append(Reading(self, own, [run.data for run in runs[begin:end]]))
            begin = end
        return made

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
        """Read or write runs of passes; `bitplanes.code_passes` tells the shapes of all arrays."""
        arrays = self.known, self.sign, self.flags, self.early, true, self.models, data, costs
        code_passes(reading, self.table.bands, runs, *arrays, self.trellis, state, symbols)

    def spread(self, tile: int, remaining: int, coefficients: Sequence[NDArray[np.int32]]) -> None:
        """Put a tile's coefficients, as they are known when so many passes remain, into the arrays of all coefficients.

        ``coefficients`` have the shape (row, column) of each grid. Unknown bits are replaced by the reconstruction
        point; what the remaining passes told counts as unknown.
        """
        state = np.full(len(self.table.layout.tiles), remaining, np.int8)
        first, last = self.table.first[tile : tile + 2]
        for array, numbers in zip(coefficients, self.table.of_grid, strict=True):
            self._spread(numbers[(numbers >= first) & (numbers < last)], state, array, len(state))

    def spread_levels(
        self,
        level: int,
        state: NDArray[np.int8],
        coefficients: Sequence[NDArray[np.int32]],
        whole: int,
        start: int | None = None,
        bare: Collection[int] = (),
    ) -> None:
        """`spread` all tiles of the levels up to one: zeros where they were not announced.

        Parameters
        ----------
        level : int
        state : int8, shape (tile,)
            Passes that remain of each tile.
        coefficients : int32 arrays, shape (row, column), one for each grid
            What they hold at the places of these tiles does not matter.
        whole : int
            Coefficients of levels above this one are multiplied by 2**`FRACTION_BITS`.
        start : int, optional
            The levels up to this one are passed over.
        bare : collection of int
            So are these.
        """
        table, tiles_of = self.table, self.table.layout.tiles_of
        finer, state = tiles_of(whole).stop, np.ascontiguousarray(state)
        for lowest, highest in _runs(0 if start is None else start + 1, level, bare):
            span = table.first[tiles_of(lowest).start], table.first[tiles_of(highest).stop]
            for array, numbers in zip(coefficients, table.of_grid, strict=True):
                own = np.arange(*span) if len(coefficients) == 1 else numbers[slice(*np.searchsorted(numbers, span))]
                self._spread(own, state, array, finer)

    def spread_rows(
        self, numbers: NDArray[np.int64], state: NDArray[np.int8], rows: NDArray[np.int32], first: int, finer: bool
    ) -> None:
        """`spread` what some bands have in some rows of a grid, zeros where they were not announced.

        Parameters
        ----------
        numbers : int64, shape (band,)
            In the table.
        state : int8, shape (tile,)
        rows : int32, shape (row, column)
            The grid's coefficients from row ``first`` on.
        finer : bool
            They are multiplied by 2**`FRACTION_BITS`.
        """
        self._spread(numbers, state, rows, 0 if finer else len(self.table.members), (first, 0))

    def band(self, number: int, state: NDArray[np.int8], finer: bool) -> NDArray[np.int32]:
        """`spread` one band, by its number in the table, into an array of its own; int32, shape (row, column).

        ``finer``: its coefficients are multiplied by 2**`FRACTION_BITS`.
        """
        height, width = (int(n) for n in self.table.bands[number, [ROWS, COLUMNS]])
        array = np.zeros((height, width), np.int32)
        tile, top, left = (int(n) for n in self.table.origins[number])
        self._spread(np.array([number]), state, array, tile if finer else tile + 1, (top, left))
        return array

    def _spread(
        self,
        numbers: NDArray[np.int64],
        state: NDArray[np.int8],
        array: NDArray[np.int32],
        finer: int,
        origin: tuple[int, int] = (0, 0),
    ) -> None:
        arrays = self.known, self.sign, self.early, self.table.bands, self.table.origins, self.steps
        spread_bands(*arrays, numbers, np.ascontiguousarray(state), finer, array, origin)


def _runs(first: int, last: int, without: Collection[int]) -> Iterator[tuple[int, int]]:
    """The numbers from ``first`` to ``last`` as runs, by their first and last, without some of them."""
    for number in (*sorted(n for n in without if first <= n <= last), last + 1):
        if first < number:
            yield first, number - 1
        first = number + 1


def _joined(band: Band, level: int, layout: Layout, parent: Band, place: int, stride: int) -> tuple[int, int, int, int]:
    """What a band of this level says of its parent, see `bitplanes.code_passes`."""
    finer, coarser = layout.shape(band.grid, level - 1), layout.shape(band.grid, level - 2)
    down, right = int(finer[0] != coarser[0]), int(finer[1] != coarser[1])
    # Without its first row, which comes from an interface, a band has an odd origin: its parent's has one too.
    row = ((band.origin[0] + down) >> down) - parent.origin[0]
    column = ((band.origin[1] + right) >> right) - parent.origin[1]
    return place + row * stride + column, stride, down, right


def _window(coefficients: NDArray[np.int32], band: Band) -> NDArray[np.int32]:
    return coefficients[slice(*band.rows), slice(*band.columns)]


def gather(table: TileTable, coefficients: Sequence[NDArray[np.int32]]) -> NDArray[np.int32]:
    """The signed coefficients of all tiles, shape (`TileTable.size`,), from those of the grids, (row, column)."""
    flat = np.zeros(table.size, np.int32)
    for number, bands in enumerate(table.members):
        for band, row in zip(bands, table.of_tile(number), strict=True):
            place, stride, height = (int(x) for x in row[[OFFSET, STRIDE, ROWS]])
            start = place - stride - 1
            frame = flat[start : start + (height + 2) * stride].reshape(height + 2, stride)
            frame[1:-1, 1:-1] = _window(coefficients[band.grid], band)
    return flat
