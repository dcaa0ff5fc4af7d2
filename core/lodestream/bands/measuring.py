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
from ..decoding.reconstruction import Values
from ..decoding.rows import RowsGeometry, RowsReconstructor
from ..encoding.holes import given_arrays
from ..encoding.prepared import Prepared
from ..encoding.residual_encoder import ChunkCoder
from ..entropy.tiles import Tiles
from ..kernels import PART_ROWS
from ..quantization.distortion import (
    Original,
    distance_figures,
    errors_of_figures,
    other_originals,
    store_values,
)
from ..quantization.lattice import Lattice
from ..transform.pyramid import PADDING

__all__ = [
    "Figures",
    "RowsGiven",
    "RowsMeasurer",
    "ValuesOfRows",
    "chunks_of_rows",
    "distances_of",
    "errors_of",
    "kinds_of",
    "measured_rows",
]

#: Rows, half-open.
Span = tuple[int, int]


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
    """The rows of a surface of one grid in runs that are measured together, of about so many points each.

    ``chunk`` are the rows and columns of a chunk of residual, as exponents of two.
    """
    rows, columns = prepared.layout.shape(0, prepared.layout.levels)
    unit = max(PART_ROWS, 1 << chunk[0])
    each = unit * max(1, points // (unit * columns))
    return [(start, min(start + each, rows)) for start in range(0, rows, each)]


@dataclass(frozen=True)
class RowsGiven:
    """The given values of some rows of a surface of one grid, which reconstructions are compared with.

    Attributes
    ----------
    coordinates : Original
    others : list of (Original, int)
        Of each channel that is no coordinate: the array it is in, and its number there.
    """

    coordinates: Original
    others: list[tuple[Original, int]]

    @staticmethod
    def of(
        points: NDArray[Any], arrays: Sequence[NDArray[Any]], mask: NDArray[np.bool_] | None, geometric: int
    ) -> RowsGiven:
        """What is compared of some rows.

        Parameters
        ----------
        points : shape (row, column, channel)
            Finite where errors are counted.
        arrays : sequence of arrays, shape (row, column, channel)
            Points and attributes as they were given.
        mask : bool, shape (row, column), or None
            True where a point is valid.
        geometric : int
            The first so many channels of the points are coordinates.
        """
        others: list[tuple[Original, int]] = []
        if sum(array.shape[2] for array in arrays) > geometric:
            found = other_originals(None, [arrays], [mask], geometric)
            others = [(originals[0], channel) for originals, channel in found]
        return RowsGiven(Original(np.ascontiguousarray(points), mask), others)

    @staticmethod
    def prepared(prepared: Prepared, rows: Span) -> RowsGiven:
        """Rows of a surface that is encoded."""
        block, within = prepared.surface.blocks[0], slice(*rows)
        mask = None if block.mask is None else block.mask[within]
        arrays = [array[within] for array in given_arrays(block)]
        return RowsGiven.of(prepared.arrays[0][0][within], arrays, mask, prepared.geometric)


class RowsMeasurer:
    """Measures rows of a surface of one grid in one state after another.

    Parameters
    ----------
    given : RowsGiven
        Of the geometry's rows.
    lattices : sequence of Lattice, one for each channel
    geometric : int
        Channels that are coordinates.
    predictors : int8, shape (channel, level, axis, 2)
    geometry : RowsGeometry
    tiles : sequence of Tiles, one for each channel
        Of the geometry's tiles, see `RowsReconstructor`.
    """

    def __init__(
        self,
        given: RowsGiven,
        lattices: Sequence[Lattice],
        geometric: int,
        predictors: NDArray[np.int8],
        geometry: RowsGeometry,
        tiles: Sequence[Tiles],
    ) -> None:
        self._given, self._lattices, self._geometric = given, lattices, geometric
        self._channels = [RowsReconstructor(geometry, own, mine) for own, mine in zip(predictors, tiles, strict=True)]
        first, last = geometry.rows
        self._shape = last - first, geometry.layout.shape(0, geometry.layout.levels)[1]
        self._canvas = np.empty((geometric, self._shape[0], self._shape[1] + PADDING), np.int32)

    def figures(self, states: Sequence[NDArray[np.int8]]) -> Figures:
        """What the rows tell of the errors of states, int8, shape (tile, channel) each."""
        found = [self._of_state(state) for state in states]
        originals = [self._given.coordinates, *(original for original, _ in self._given.others)]
        counts = np.array([original.count for original in originals], np.int64)
        return Figures(np.stack([squares for squares, _ in found]), np.stack([equal for _, equal in found]), counts)

    def _of_state(self, state: NDArray[np.int8]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        geometric = self._geometric
        fractions = [self._reconstruct(k, k, state) for k in range(geometric)]
        parts = [self._compare(self._given.coordinates, self._lattices[:geometric], self._canvas, fractions, 0)]
        for number, (original, channel) in enumerate(self._given.others, geometric):
            fraction = self._reconstruct(0, number, state)
            lattices = self._lattices[number : number + 1]
            parts.append(self._compare(original, lattices, self._canvas[:1], [fraction], channel))
        squares, equal = zip(*parts, strict=True)
        return np.concatenate(squares, axis=2), np.concatenate(equal)

    def _reconstruct(self, place: int, channel: int, state: NDArray[np.int8]) -> int:
        rows, fraction = self._channels[channel].reconstruct(np.ascontiguousarray(state[:, channel]))
        self._canvas[place, :, :-PADDING] = rows
        return fraction

    @staticmethod
    def _compare(
        original: Original, lattices: Sequence[Any], canvas: NDArray[np.int32], fractions: Sequence[int], channel: int
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        squares = distance_figures(original, lattices, canvas, fractions, channel)
        equal = np.zeros(squares.shape[2], np.bool_)
        if original.points.dtype.itemsize == 8 and not squares[..., 1].any():
            # Squares of the smallest differences vanish: only a look at the values tells that there are none.
            columns = original.points.shape[1]
            same = np.empty((*original.points.shape[:2], len(lattices)), original.points.dtype)
            for number, (lattice, fraction) in enumerate(zip(lattices, fractions, strict=True)):
                store_values(lattice, (canvas[number, :, :columns], fraction), same, number)
            wanted = original.points[..., channel : channel + len(lattices)]
            chosen = slice(None) if original.counted is None else original.counted
            equal[:] = np.array_equal(wanted[chosen], same[chosen])
        return squares, equal

    def values(self, state: NDArray[np.int8], kinds: Sequence[tuple[int, np.dtype[Any]]]) -> Values:
        """The rows of all channels in a state, int8, shape (tile, channel), as `to_values` makes them of a block.

        ``kinds`` are the components and the dtype of the points, and of each attribute.
        """
        channel, arrays = 0, []
        for components, dtype in kinds:
            array = np.empty((*self._shape, components), dtype)
            for component in range(components):
                made = self._channels[channel].reconstruct(np.ascontiguousarray(state[:, channel]))
                store_values(self._lattices[channel], made, array, component)
                channel += 1
            arrays.append(array)
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
