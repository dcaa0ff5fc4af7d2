"""Errors of states over some rows of a surface, and the residual of these rows.

What rows tell is put together for the whole surface: sums are those of cells, which are added up in the same order
whatever the rows were.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.chunks import ChunkPlace, chunk_places
from ..container.fields import told, told_roughly
from ..container.model import Errors, Header
from ..decoding.reconstructor import KnownState, Reconstructor, known_state
from ..decoding.region import Region
from ..decoding.values import Values
from ..encoding.prepared import Prepared
from ..encoding.residual_encoder import ChunkCoder
from ..entropy.tiles import Tiles
from ..kernels import PART_COLUMNS, PART_ROWS
from ..parallel import spread
from ..quantization.distortion import (
    errors_of_figures,
    store_values,
)
from ..quantization.lattice import Lattice
from .windows import RowsGiven, WindowMeasurer, window_core

__all__ = [
    "BANDS_TOGETHER",
    "Figures",
    "RowsMeasurer",
    "ValuesOfRows",
    "chunks_of_rows",
    "distances_of",
    "errors_of",
    "kinds_of",
    "measured_rows",
]

#: Rows or columns, half-open.
Span = tuple[int, int]

#: Rows and points of the windows that are measured one after another. Each level is made with 26 points more on every
#: side, which speaks against smaller windows; memory speaks against larger ones.
_WINDOW_ROWS, _WINDOW_POINTS = 1024, 1 << 21
#: Rows that are measured together have so many times the points of a band of the transform. What their tiles hold takes
#: 8 bytes a value.
BANDS_TOGETHER = 2


@dataclass(frozen=True)
class Figures:
    """What rows tell of the errors of some states.

    Attributes
    ----------
    squares : float64, shape (state, row of cells, column of cells, kind, 2)
        See `distance_figures`: of the coordinates, then of each other channel.
    equal : bool, shape (state, kind)
        Whether all values are as given, where the squares of their differences are all 0.
    counts : int64, shape (comparison,)
        Points that are compared: of the coordinates, then of each other channel.
    """

    squares: NDArray[np.float64]
    equal: NDArray[np.bool_]
    counts: NDArray[np.int64]


def measured_rows(prepared: Prepared, chunk: tuple[int, int], points: int) -> list[Span]:
    """The rows of a surface of one grid in runs that are measured together.

    ``chunk`` are the rows and columns of a chunk of residual, as exponents of two; ``points`` are those of a band of
    the transform, which takes about as much memory.
    """
    rows, columns = prepared.layout.shape(0, prepared.layout.levels)
    unit = max(PART_ROWS, 1 << chunk[0])
    each = unit * max(1, BANDS_TOGETHER * points // (unit * columns))
    return [(start, min(start + each, rows)) for start in range(0, rows, each)]


class RowsMeasurer:
    """Measures rows of a surface of one grid in many states.

    Parameters
    ----------
    given : RowsGiven
        Of the rows.
    lattices : sequence of Lattice, one for each channel
    geometric : int
        Channels that are coordinates.
    predictors : int8, shape (channel, level, axis, 2)
    region : Region
        The rows, the first of which is a multiple of `PART_ROWS`.
    tiles : sequence of Tiles, one for each channel
        Of the region's tiles, see `Reconstructor`.
    """

    def __init__(
        self,
        given: RowsGiven,
        lattices: Sequence[Lattice],
        geometric: int,
        predictors: NDArray[np.int8],
        region: Region,
        tiles: Sequence[Tiles],
    ) -> None:
        self._given, self._lattices, self._geometric = given, lattices, geometric
        self._predictors, self._region, self._tiles = predictors, region, tiles
        self._core = min(region.core, window_core(region.layout))
        (self._shape,) = region.shapes

    def figures(self, states: Sequence[NDArray[np.int8]]) -> Figures:
        """What the rows tell of the errors of states, int8, shape (tile, channel) each."""
        known = [self._known(state) for state in states]
        counts = [self._given.coordinates.count, *(original.count for original, _ in self._given.others)]
        kinds = (1 + self._geometric if self._geometric > 1 else 1) + len(self._given.others)
        cells = [-(-length // size) for length, size in zip(self._shape, (PART_ROWS, PART_COLUMNS), strict=True)]
        squares, equal = np.empty((len(states), *cells, kinds, 2)), np.ones((len(states), kinds), np.bool_)

        def measure(window: tuple[Span, Span]) -> NDArray[np.bool_]:
            (top, bottom), (left, right) = window
            rows = slice(top // PART_ROWS, -(-bottom // PART_ROWS))
            columns = slice(left // PART_COLUMNS, -(-right // PART_COLUMNS))
            same = np.empty((len(states), kinds), np.bool_)
            measuring = self._window(window)
            for number, state in enumerate(known):
                squares[number, rows, columns], same[number] = measuring.measure(state)
            return same

        for same in spread(measure, self._windows()):
            equal &= same
        return Figures(squares, equal, np.array(counts, np.int64))

    def _known(self, state: NDArray[np.int8]) -> list[KnownState]:
        """A state, int8, shape (tile, channel), as far as each channel's tiles are concerned."""
        return [
            known_state(tiles.table, state[:, channel], self._region.level) for channel, tiles in enumerate(self._tiles)
        ]

    def _windows(self) -> list[tuple[Span, Span]]:
        """The windows that are measured one after another, by their rows and columns, from the first row on."""
        rows, columns = self._shape
        down = min(rows, _WINDOW_ROWS)
        points = min(_WINDOW_POINTS, rows * columns // 2)
        across = PART_COLUMNS * max(1, points // (PART_COLUMNS * down))
        if self._region.layout.grids[0].closed[1]:
            across = columns  # each would be made of all of them
        return [
            ((top, min(top + down, rows)), (left, min(left + across, columns)))
            for top in range(0, rows, down)
            for left in range(0, columns, across)
        ]

    def _window(self, window: tuple[Span, Span]) -> WindowMeasurer:
        return WindowMeasurer(self._given.window(*window), self._lattices, self._geometric, self._made(window))

    def _made(self, window: tuple[Span, Span]) -> list[Reconstructor]:
        """What reconstructs a window, of each channel."""
        (top, bottom), columns = window
        whole = self._region
        assert whole.spans is not None
        first = whole.spans[0][0]
        region = Region.window(whole.layout, whole.level, (first + top, first + bottom), columns, self._core)
        return [Reconstructor(region, own, tiles) for own, tiles in zip(self._predictors, self._tiles, strict=True)]

    def values(self, state: NDArray[np.int8], kinds: Sequence[tuple[int, np.dtype[Any]]]) -> Values:
        """The rows of all channels in a state, int8, shape (tile, channel), as `to_values` makes them of a block.

        ``kinds`` are the components and the dtype of the points, and of each attribute.
        """
        known = self._known(state)
        arrays = [np.empty((*self._shape, components), dtype) for components, dtype in kinds]

        def store(window: tuple[Span, Span]) -> None:
            channel, made = 0, self._made(window)
            for array, (components, dtype) in zip(arrays, kinds, strict=True):
                for component in range(components):
                    (coordinates,), fraction = made[channel].reconstruct(known[channel])
                    values = np.empty(coordinates.shape, dtype)
                    store_values(self._lattices[channel], (coordinates, fraction), values[..., None], 0)
                    array[slice(*window[0]), slice(*window[1]), component] = values
                    channel += 1

        spread(store, self._windows())
        return Values(arrays)


def kinds_of(prepared: Prepared) -> list[tuple[int, np.dtype[Any]]]:
    """Components and dtype of the points, and of each attribute, as `RowsMeasurer.values` takes them."""
    return [(given.shape[2], given.dtype) for given in prepared.arrays[0]]


@dataclass(frozen=True)
class ValuesOfRows:
    """Values of some rows of a block, from row ``top`` on."""

    values: Values
    top: int

    def window(self, window: ChunkPlace) -> NDArray[Any]:
        """One channel at the place of a chunk, shape (row, column), a view."""
        return self.values.window(window, self.top)


def chunks_of_rows(
    prepared: Prepared, header: Header, values: Values, rows: Span
) -> tuple[list[bytes], list[bytes], list[bool]]:
    """The residual of some rows, whose values without it are these.

    Returns
    -------
    list of bytes, twice
        Chunks in the order of `chunk_places`: of the points, and of holes that are kept.
    list of bool
        Of each channel whether it is exact with them.
    """
    coder = ChunkCoder(prepared, header, [ValuesOfRows(values, rows[0])])
    chunks: tuple[list[bytes], list[bytes]] = [], []
    exact = [True] * header.channels
    for place in chunk_places(header, rows):
        data, whole = coder.code(place)
        chunks[place.kept].append(data)
        exact[place.channel] &= whole
    return *chunks, exact


def errors_of(
    figures: Sequence[Figures], state: int, geometric: int, dtypes: Sequence[np.dtype[Any]]
) -> tuple[Errors, list[NDArray[np.float64]]] | None:
    """Errors of the whole surface in a state as a container tells them, and its cells; shapes as of `distances_of`."""
    found = distances_of(figures, state, geometric, dtypes)
    if found is None:
        return None
    errors, cells = found
    channels = tuple((told_roughly(rms), told_roughly(worst)) for rms, worst in errors.channels)
    return Errors(told(errors.rms), told(errors.maximum), channels), cells


def distances_of(
    figures: Sequence[Figures], state: int, geometric: int, dtypes: Sequence[np.dtype[Any]]
) -> tuple[Errors, list[NDArray[np.float64]]] | None:
    """Errors of the whole surface in a state, and the distances in cells.

    Parameters
    ----------
    figures : sequence of Figures
        Of all rows in their order.
    state : int
        Which of the states.
    geometric : int
        Channels that are coordinates.
    dtypes : sequence of dtype
        Of every channel.

    Returns
    -------
    (Errors, list of float64 arrays) or None
        As `measured` finds them of the whole surface; None: float64 does not hold the squares.
    """
    counts = np.sum([own.counts for own in figures], axis=0)
    kinds = 1 + geometric if geometric > 1 else 1
    found: list[tuple[float, float]] = []
    cells: list[NDArray[np.float64]] = []
    first = 0
    for comparison, count in enumerate(counts.tolist()):
        own = kinds if comparison == 0 else 1
        span = slice(first, first + own)
        first += own
        dtype = dtypes[0 if comparison == 0 else geometric + comparison - 1]
        whole = np.concatenate([one.squares[state, :, :, span] for one in figures])
        errors: list[tuple[float, float]] | None = [(0.0, 0.0)] * own
        if count:
            errors = errors_of_figures([whole], count, dtype)
            if errors is None and all(one.equal[state, span].all() for one in figures):
                errors = [(0.0, 0.0)] * own
            elif errors is None:
                return None
            elif comparison == 0 and errors[0][1]:
                cells = [whole[..., 0, :]]
        assert errors is not None
        found += errors
    distances, *each = found
    channels = each if geometric > 1 else found if len(found) > 1 else []
    return Errors(*distances, tuple(channels)), cells
