"""Errors of states over a region of the surface: the values that a receiver shows against the original ones.

What regions tell is put together for the whole surface: sums are those of cells, which are added up exactly, so it does
not matter how the surface was divided.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..container.model import Errors, Header
from ..entropy.tiles import Tiles
from ..grid.connectivity import Arrangement
from ..parallel import spread, threads
from ..quantization.distortion import (
    ByBlock,
    Original,
    coordinate_distances,
    distance_figures,
    errors_of_figures,
    originals_of,
    other_originals,
    store_values,
)
from ..quantization.lattice import Lattice
from .pieces import MeasuredPart, measured_parts
from .reconstructor import Grid, KnownState, Reconstructor, known_state
from .region import Region, Span

__all__ = [
    "CORE_POINTS",
    "Comparison",
    "Figures",
    "Measured",
    "Measurer",
    "comparisons",
    "distances_of",
]

State = NDArray[np.int8]

#: Rows, and columns, of the windows that are measured one after another, about. Levels are made with 26 points more on
#: every side, which speaks against smaller windows; memory and the processor's cache speak against larger ones.
_WINDOW_SIDE = 1024
#: Grids of at most so many points together are made whole, by one call for all levels; more than one grid always.
_WHOLE_POINTS = _WINDOW_SIDE**2
#: Levels of at most so many points are made whole for each window: windows of them would be no smaller.
CORE_POINTS = 1 << 14

#: Errors of a state, and the squared distances in cells, one array or none; see `coordinate_distances`.
Measured = tuple[Errors, list[NDArray[np.float64]]]


class Comparison(NamedTuple):
    """Channels that are compared together with what was given.

    Attributes
    ----------
    originals : sequence of Original
        One for each patch.
    channels : range
        Their numbers in the surface; at most three.
    first : int
        The number of the first one among the channels of the originals' points.
    """

    originals: Sequence[Original]
    channels: range
    first: int

    @property
    def kinds(self) -> int:
        """Number of distances: of all channels together, and of each of several channels."""
        return 1 + len(self.channels) if len(self.channels) > 1 else 1


def comparisons(
    region: Region,
    arrangement: Arrangement | None,
    geometric: int,
    points: ByBlock[NDArray[Any]],
    arrays: ByBlock[Sequence[NDArray[Any]]],
    masks: ByBlock[NDArray[np.bool_] | None],
) -> list[Comparison]:
    """Return the original values of the channels of a region: the coordinates together, then each other channel.

    Parameters
    ----------
    region : Region
    arrangement : Arrangement or None
    geometric : int
        Channels that are coordinates.
    points : for each block of the region, shape (row, column, channel)
        The values of coordinates, finite. Of rows these alone, as in what follows.
    arrays : for each block its points, then its attributes, shape (row, column, channel)
    masks : for each block bool, shape (row, column), or None
        True where a point is valid.
    """
    patches = None if arrangement is None else region.patches
    coordinates = originals_of(arrangement, points, masks, patches)
    others = other_originals(arrangement, arrays, masks, geometric, patches)
    return [
        Comparison(coordinates, range(geometric), 0),
        *(Comparison(originals, range(k, k + 1), first) for k, (originals, first) in enumerate(others, geometric)),
    ]


@dataclass(frozen=True)
class Figures:
    """What a region tells of the errors of some states.

    Attributes
    ----------
    squares : float64, shape (state, row of cells, column of cells, kind, 2)
        See `distance_figures`: of the coordinates, then of each other channel. Where there are several grids each patch
        is a row of cells with one cell in it.
    equal : bool, shape (state, kind)
        Whether all values are as given, where the squares of their differences are all 0.
    counts : int64, shape (comparison,)
        Points that are compared: of the coordinates, then of each other channel.
    """

    squares: NDArray[np.float64]
    equal: NDArray[np.bool_]
    counts: NDArray[np.int64]


class Measurer:
    """Measures a region of the finest level in many states.

    Parameters
    ----------
    header : Header
        Of which the layout, the lattices, the predictors, the dtypes and the number of coordinates count.
    region : Region
        All of the surface, some of its grids, or rows, the first of which is a multiple of `PART_ROWS`.
    tiles : sequence of Tiles, one for each channel
        All that is known in the end, see `Reconstructor`.
    compared : sequence of Comparison
        Of the region's patches.
    """

    def __init__(self, header: Header, region: Region, tiles: Sequence[Tiles], compared: Sequence[Comparison]) -> None:
        self._header, self._region, self._tiles, self._compared = header, region, tiles, compared
        self._patches = len(region.patches)

    def errors(self, states: Sequence[State]) -> list[Measured]:
        """Measure the errors of states, int8, shape (tile, channel) each, where the region is the whole surface."""
        figures = [self.figures(states)]
        return [
            distances_of(self._header, figures, number) or self.exact_errors(state)
            for number, state in enumerate(states)
        ]

    def figures(self, states: Sequence[State]) -> Figures:
        """Measure the region's part of the errors of states, int8, shape (tile, channel) each."""
        known = [self._known(state) for state in states]
        kinds = sum(compared.kinds for compared in self._compared)
        squares = np.empty((len(states), *self._region.cells, kinds, 2))
        parts = self._parts()
        count = max(1, min(-(-threads() // len(parts)), len(states)))
        bounds = [len(states) * number // count for number in range(count + 1)]

        def measure(work: tuple[MeasuredPart, Span]) -> tuple[Span, NDArray[np.bool_]]:
            part, (start, stop) = work
            equal = np.empty((stop - start, kinds), np.bool_)
            measuring = _PartMeasurer(self._header, part, self._tiles, self._compared)
            for number in range(start, stop):
                squares[number, *part.cells], equal[number - start] = measuring.measure(known[number])
            return (start, stop), equal

        equal = np.ones((len(states), kinds), np.bool_)
        for (start, stop), same in spread(measure, product(parts, pairwise(bounds))):
            equal[start:stop] &= same
        counts = [sum(original.count for original in compared.originals) for compared in self._compared]
        return Figures(squares, equal, np.array(counts, np.int64))

    def exact_errors(self, state: State) -> Measured:
        """Measure the errors of a state, int8, shape (tile, channel), of the whole surface.

        They are found also where float64 does not hold the squares of its values.
        """
        cells, distances = list[NDArray[np.float64]](), list[tuple[float, float]]()
        known = self._known(state)
        for number, (originals, channels, first) in enumerate(self._compared):
            reconstructed = [self._reconstructor(channel).reconstruct(known[channel]) for channel in channels]
            grids = zip(*(arrays[-self._patches :] for arrays, _ in reconstructed), strict=True)
            distances += coordinate_distances(
                originals,
                [self._header.lattices[channel] for channel in channels],
                [np.stack(coordinates) for coordinates in grids],
                [fraction for _, fraction in reconstructed],
                first,
                None if number else cells,
            )
        return _errors(distances, self._header.geometric), cells

    def _reconstructor(self, channel: int) -> Reconstructor:
        return Reconstructor(
            self._region, self._header.predictors[channel], self._tiles[channel], channel < self._header.geometric
        )

    def _known(self, state: State) -> list[KnownState]:
        """Return the part of a state, int8, shape (tile, channel), that each channel's tiles need."""
        return [
            known_state(tiles.table, state[:, channel], self._region.level) for channel, tiles in enumerate(self._tiles)
        ]

    def _parts(self) -> list[MeasuredPart]:
        return measured_parts(self._region, _WHOLE_POINTS, _WINDOW_SIDE, CORE_POINTS)


class _PartMeasurer:
    """Measures a part of a region in one state after another: what two of them share is not measured again."""

    def __init__(
        self, header: Header, part: MeasuredPart, tiles: Sequence[Tiles], compared: Sequence[Comparison]
    ) -> None:
        self._lattices, self._has_cells = header.lattices, part.region.has_cells
        self._compared = [_cut(comparison, part) for comparison in compared]
        self._patches = len(self._compared[0].originals)
        # Channels that are compared by themselves are made anew for each state, unless levels of a window are shared.
        room = np.empty(part.region.size, np.int32) if part.within is None and len(compared) > 1 else None
        self._channels = [
            Reconstructor(
                part.region,
                predictors,
                channel_tiles,
                channel < header.geometric,
                None if channel < header.geometric else room,
            )
            for channel, (predictors, channel_tiles) in enumerate(zip(header.predictors, tiles, strict=True))
        ]
        #: Of each comparison its figures in the state before, and whether all is equal.
        self._before: list[tuple[NDArray[np.float64], NDArray[np.bool_]] | None] = [None] * len(compared)

    def measure(self, state: Sequence[KnownState]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Measure the sums and maxima of the squared distances of each channel in a state; see `Figures`.

        Returns
        -------
        float64, shape (row of cells, column of cells, kind, 2), and bool, shape (kind,)
        """
        squares, equal = zip(*(self._figures(number, state) for number in range(len(self._compared))), strict=True)
        return np.concatenate(squares, axis=2), np.concatenate(equal)

    def _figures(self, number: int, state: Sequence[KnownState]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        before, (originals, channels, first) = self._before[number], self._compared[number]
        if before is not None and all(self._channels[channel].is_shown(state[channel]) for channel in channels):
            return before
        fractions = [self._channels[channel].reconstruct(state[channel])[1] for channel in channels]
        frames = [self._channels[channel].frames[-self._patches :] for channel in channels]
        lattices = [self._lattices[channel] for channel in channels]
        figures = [
            _compared(original, lattices, _stacked([grids[patch] for grids in frames]), fractions, first)
            for patch, original in enumerate(originals)
        ]
        squares, equal = zip(*figures, strict=True)
        cells = squares[0] if self._has_cells else np.array([[_one_cell(patch_squares)] for patch_squares in squares])
        result = cells, np.all(equal, axis=0)
        self._before[number] = result
        return result


def _cut(comparison: Comparison, part: MeasuredPart) -> Comparison:
    """Return the original values of a part; of a window of a grid a copy of the compared channels alone.

    An array of many components is there in as many comparisons.
    """
    originals = comparison.originals[part.patches]
    if part.within is None:
        return comparison._replace(originals=originals)
    points, counted = originals[0].points, originals[0].counted
    counted = None if counted is None else np.ascontiguousarray(counted[part.within])
    channels = slice(comparison.first, comparison.first + len(comparison.channels))
    compared = np.ascontiguousarray(points[part.within][..., channels])
    return comparison._replace(originals=[Original(compared, counted)], first=0)


def _stacked(frames: Sequence[Grid]) -> NDArray[np.int32]:
    return frames[0][np.newaxis] if len(frames) == 1 else np.stack(frames)


def _one_cell(squares: NDArray[np.float64]) -> list[tuple[float, float]]:
    """Return the sum and the largest of each kind over all cells of a patch."""
    if squares.shape[:2] == (1, 1):
        return [(total, largest) for total, largest in squares[0, 0].tolist()]
    return [
        (math.fsum(kind_squares[..., 0].flat), float(kind_squares[..., 1].max()))
        for kind_squares in np.moveaxis(squares, 2, 0)
    ]


def _compared(
    original: Original, lattices: Sequence[Lattice], canvas: NDArray[np.int32], fractions: Sequence[int], channel: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return `distance_figures`, and for each kind whether all values are equal, that is, all squares are 0.

    Parameters are those of `distance_figures`; ``canvas`` are its coordinates, int32, shape (channel, row, column).

    Returns
    -------
    float64, shape (row of cells, column of cells, kind, 2), and bool, shape (kind,)
    """
    squares = distance_figures(original, lattices, canvas, fractions, channel)
    equal = np.zeros(squares.shape[2], np.bool_)
    if original.points.dtype.kind == "f" and original.points.dtype.itemsize == 8 and not squares[..., 1].any():
        # Squares of the smallest differences vanish: only a look at the values tells that there are none.
        columns = original.points.shape[1]
        same = np.empty((*original.points.shape[:2], len(lattices)), original.points.dtype)
        for number, (lattice, fraction) in enumerate(zip(lattices, fractions, strict=True)):
            store_values(lattice, (canvas[number, :, :columns], fraction), same, number)
        wanted = original.points[..., channel : channel + len(lattices)]
        chosen = slice(None) if original.counted is None else original.counted
        equal[:] = np.array_equal(wanted[chosen], same[chosen])
    return squares, equal


def distances_of(header: Header, figures: Sequence[Figures], state: int) -> Measured | None:
    """Return the errors of the whole surface in a state, and the distances in its cells.

    Parameters
    ----------
    header : Header
    figures : sequence of Figures
        Of all regions in their order.
    state : int
        Which of the states.

    Returns
    -------
    (Errors, list of float64 arrays, shape (row of cells, column of cells, 2)) or None
        None: float64 does not hold the squares.
    """
    geometric, distances, cells = header.geometric, list[tuple[float, float]](), list[NDArray[np.float64]]()
    first = 0
    for comparison, count in enumerate(np.sum([part.counts for part in figures], axis=0).tolist()):
        kinds = 1 + geometric if comparison == 0 and geometric > 1 else 1
        span = slice(first, first + kinds)
        first += kinds
        squares = np.concatenate([part.squares[state, :, :, span] for part in figures])
        dtype = header.dtypes[comparison + geometric - 1 if comparison else 0]
        errors = errors_of_figures([squares], count, dtype) if count else [(0.0, 0.0)] * kinds
        if errors is None:
            if not all(part.equal[state, span].all() for part in figures):
                return None
            errors = [(0.0, 0.0)] * kinds
        elif comparison == 0 and errors[0][1]:
            cells = [squares[..., 0, :]]
        distances += errors
    return _errors(distances, geometric), cells


def _errors(kind_errors: Sequence[tuple[float, float]], geometric: int) -> Errors:
    """Return errors from those of each kind: all coordinates together, then each of several channels."""
    distances, *channels = kind_errors
    return Errors(*distances, tuple(channels if geometric > 1 else kind_errors if len(kind_errors) > 1 else ()))
