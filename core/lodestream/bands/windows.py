"""Windows of a surface of one grid, measured in one state after another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..decoding.reconstructor import KnownState, Reconstructor
from ..encoding.holes import given_arrays
from ..encoding.prepared import Prepared
from ..grid.layout import Layout
from ..quantization.distortion import Original, distance_figures, other_originals, store_values
from ..quantization.lattice import Lattice

__all__ = ["RowsGiven", "WindowMeasurer", "compared", "window_core"]

#: Rows or columns, half-open.
Span = tuple[int, int]

#: The finest level of at most so many points is made whole for each window: windows of it would be no smaller.
_CORE_POINTS = 1 << 14


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

    def window(self, rows: Span, columns: Span) -> RowsGiven:
        """The same of a window, by its rows and columns from the first ones on."""
        within = slice(*rows), slice(*columns)
        others = [(_part(original, within), channel) for original, channel in self.others]
        return RowsGiven(_part(self.coordinates, within), others)

    @staticmethod
    def prepared(prepared: Prepared, rows: Span) -> RowsGiven:
        """Rows of a surface that is encoded."""
        block, within = prepared.surface.blocks[0], slice(*rows)
        mask = None if block.mask is None else block.mask[within]
        arrays = [array[within] for array in given_arrays(block)]
        return RowsGiven.of(prepared.arrays[0][0][within], arrays, mask, prepared.geometric)


def _part(original: Original, within: tuple[slice, slice]) -> Original:
    counted = original.counted
    return Original(
        np.ascontiguousarray(original.points[within]),
        None if counted is None else np.ascontiguousarray(counted[within]),
    )


def window_core(layout: Layout) -> int:
    """The level that is reconstructed whole for each window, of a surface of one grid."""
    return max((level for level in range(layout.levels + 1) if layout.points(level) <= _CORE_POINTS), default=0)


class WindowMeasurer:
    """Measures a window of a surface in one state after another.

    Parameters
    ----------
    given : RowsGiven
        Of the window.
    lattices, geometric
        As of `RowsMeasurer`.
    channels : list of Reconstructor
    """

    def __init__(
        self, given: RowsGiven, lattices: Sequence[Lattice], geometric: int, channels: list[Reconstructor]
    ) -> None:
        self._given, self._lattices, self._geometric, self._channels = given, lattices, geometric, channels
        #: Of the coordinates, then of each other channel: figures in the state before, and whether all is equal.
        self._before: list[tuple[NDArray[np.float64], NDArray[np.bool_]] | None] = [None] * (1 + len(given.others))

    def measure(self, state: list[KnownState]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Sums and largest of the squared distances of the window in a state of each channel.

        Returns
        -------
        float64, shape (row of cells, column of cells, kind, 2), and bool, shape (kind,)
            See `Figures.squares` and `Figures.equal`, of one state.
        """
        geometric = self._geometric
        parts = [self._compared(0, self._given.coordinates, range(geometric), 0, state)]
        for number, (original, channel) in enumerate(self._given.others):
            own = geometric + number
            parts.append(self._compared(1 + number, original, range(own, own + 1), channel, state))
        squares, equal = zip(*parts, strict=True)
        return np.concatenate(squares, axis=2), np.concatenate(equal)

    def _compared(
        self, number: int, original: Original, channels: range, first: int, state: list[KnownState]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Figures of some channels that are compared together, the array's from ``first`` on."""
        before = self._before[number]
        if before is not None and all(self._channels[channel].is_shown(state[channel]) for channel in channels):
            return before
        fractions = [self._channels[channel].reconstruct(state[channel])[1] for channel in channels]
        frames = [self._channels[channel].frames[0] for channel in channels]
        canvas = frames[0][None] if len(frames) == 1 else np.stack(frames)
        lattices = self._lattices[channels.start : channels.stop]
        found = compared(original, lattices, canvas, fractions, first)
        self._before[number] = found
        return found


def compared(
    original: Original, lattices: Sequence[Lattice], canvas: NDArray[np.int32], fractions: Sequence[int], channel: int
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """`distance_figures`, and of each kind whether all values are equal: known where the squares are all 0.

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
