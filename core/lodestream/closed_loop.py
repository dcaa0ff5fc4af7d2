"""Quantisation for one error in a closed loop, from the coarsest level to the finest.

Each level is reconstructed as the reader will, and the details of the next one are predicted from that: so errors of
nodes do not enter the details. What the reader is to have are the details before the third step. The levels are then
orthogonal: no error of one could be made good by another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .band_fields import COLUMNS, KIND, OFFSET, ROWS, STRIDE
from .quantiser import Quantiser
from .rate_distortion import MOST_TRIES, IndexChooser, longest_base
from .spreading import spread_bands
from .tiles import TileTable
from .transform import PADDING, allocate, bare_level, inverse_level, take_details, take_nodes

__all__ = ["ClosedLoop", "quantise"]

#: The step of a stream made for one error, over the error, that is tried first.
_LIKELY_STEP = 6
#: How often all indices are chosen with the first step, to learn what they cost.
_FIRST_TURNS = 2
_BOTH = 3  # details along both axes, in `band_fields.KIND`


class _Stage(NamedTuple):
    """Bands of a level that do not depend on each other.

    Attributes
    ----------
    level : int
    bands : dict of int to int64 array
        By grid, in the order of the layout: their numbers in the table.
    """

    level: int
    bands: dict[int, NDArray[np.int64]]


class ClosedLoop:
    """Quantises one channel, which is a coordinate.

    Parameters
    ----------
    table : TileTable
    predictors : int8, shape (level, axis, 2)
        See `transform.forward`.
    arrays : int32, shape (row, column), one for each grid
        The channel's lattice coordinates. They are kept, as nodes and details before the third step.
    """

    def __init__(self, table: TileTable, predictors: NDArray[np.int8], arrays: Sequence[NDArray[np.int32]]) -> None:
        self._table, self._predictors, self._aims = table, predictors, arrays
        for level in range(table.layout.levels, 0, -1):
            for number, array in enumerate(arrays):
                bare_level(array, table.layout, number, level)
        self._chooser = IndexChooser(table)
        self._turns = _FIRST_TURNS

    def indices(self, quantiser: Quantiser, pictures: Sequence[NDArray[np.int32]]) -> NDArray[np.int32]:
        """The index of every coefficient, flat; and what the reader will have of the grids, into ``pictures``."""
        for _ in range(self._turns):
            chosen = self._chosen(quantiser, pictures)
        self._turns = 1  # what was learned of one choice serves the next one, with other steps, too
        return chosen

    def _chosen(self, quantiser: Quantiser, pictures: Sequence[NDArray[np.int32]]) -> NDArray[np.int32]:
        table, predictors = self._table, self._predictors
        for picture in pictures:
            picture.fill(0)
        self._chooser.begin(quantiser)
        coder = _Coder(table, self._chooser, table.steps(quantiser), self._aims, pictures)
        for first, second in _stages(table):
            level = first.level
            if level == 0:
                coder.code(first, predictors)
                take_nodes(pictures, table.layout)
                continue
            for number in first.bands:
                take_details(pictures, table.layout, predictors, number, level)
            coder.code(first, predictors)
            coder.code(second, predictors)
            for number in first.bands:
                inverse_level(pictures[number], table.layout, predictors, number, level)
        return self._chooser.end()


class _Coder:
    """Chooses the indices of bands, and puts what the reader makes of them into pictures of the grids."""

    def __init__(
        self,
        table: TileTable,
        chooser: IndexChooser,
        steps: NDArray[np.int64],
        aims: Sequence[NDArray[np.int32]],
        pictures: Sequence[NDArray[np.int32]],
    ) -> None:
        self._table, self._chooser, self._steps = table, chooser, steps
        self._aims, self._pictures = aims, pictures
        self._targets, self._sizes = np.zeros((2, table.size), np.int32)
        self._signs = np.zeros(table.size, np.int8)
        self._early = np.zeros(table.size, np.uint8)
        self._complete = np.zeros(len(table.layout.tiles), np.int8)

    def code(self, stage: _Stage, predictors: NDArray[np.int8]) -> None:
        """Code the bands of a stage: what is to be reached less what the reader predicts."""
        for grid, numbers in stage.bands.items():
            if not numbers.size:
                continue
            predicted = self._predicted(grid, stage.level, predictors) if stage.level else None
            for number in numbers.tolist():
                target, window = self._own(self._targets, number), self._window(number)
                target[...] = self._aims[grid][window]
                if predicted is not None:
                    target -= predicted[window]
        every = np.concatenate(list(stage.bands.values()))
        if not every.size:
            return
        self._chooser.choose(every, self._targets)
        for number in every.tolist():
            chosen = self._own(self._chooser.chosen, number)
            np.abs(chosen, out=self._own(self._sizes, number))
            np.sign(chosen, out=self._own(self._signs, number), casting="unsafe")
        known = self._sizes, self._signs, self._early, self._table.bands, self._table.windows, self._steps
        for grid, numbers in stage.bands.items():
            spread_bands(*known, numbers, self._complete, self._complete.size, self._pictures[grid], (0, 0))

    def _predicted(self, grid: int, level: int, predictors: NDArray[np.int8]) -> NDArray[np.int32]:
        """Details before the third step that the reader has when those coded so far are known, the others 0."""
        layout = self._table.layout
        rows, columns = layout.shape(grid, level)
        picture = allocate((rows, columns))
        picture[...] = self._pictures[grid][:rows, :columns]
        inverse_level(picture, layout, predictors, grid, level)
        bare_level(picture, layout, grid, level)
        return picture

    def _own(self, flat: NDArray[np.generic], number: int) -> NDArray[np.generic]:
        """A band in a flat array, shape (row, column), a view."""
        place, stride, rows, columns = self._table.bands[number, [OFFSET, STRIDE, ROWS, COLUMNS]].tolist()
        return np.lib.stride_tricks.as_strided(
            flat[place:], (rows, columns), (stride * flat.itemsize, flat.itemsize)
        )

    def _window(self, number: int) -> tuple[slice, slice]:
        """Where a band lies among the coefficients of its grid."""
        _, top, left = self._table.windows[number].tolist()
        rows, columns = self._table.bands[number, [ROWS, COLUMNS]].tolist()
        return slice(top, top + rows), slice(left, left + columns)


def _stages(table: TileTable) -> Iterator[tuple[_Stage, _Stage]]:
    """The bands in the order in which they can be coded.

    Level by level, curves before the parts that take their sides from them; of these first what has nodes along an
    axis, then the details along both.
    """
    layout = table.layout
    levels = np.array([tile.level for tile in layout.tiles])[table.windows[:, 0]]
    both = table.bands[:, KIND] == _BOTH
    every = list(range(len(layout.grids)))
    curves = [number for number in every if layout.grids[number].curve]
    parts = every[len(curves) :]
    for level in range(layout.levels + 1):
        groups = [every] if level == 0 else [curves, parts] if curves else [parts]
        for group in groups:
            own = {k: table.of_grid[k][levels[table.of_grid[k]] == level] for k in group}
            yield (
                _Stage(level, {k: numbers[~both[numbers]] for k, numbers in own.items()}),
                _Stage(level, {k: numbers[both[numbers]] for k, numbers in own.items()}),
            )


def quantise(
    loops: Sequence[ClosedLoop],
    canvases: Sequence[NDArray[np.int32]],
    error_of: Callable[[], float],
    wanted: float,
    fineness: int,
    progress: Callable[[float], None],
) -> tuple[Quantiser, list[NDArray[np.int32]]] | None:
    """The longest steps whose error is at most the one wanted, and the indices then; None where no step is that short.

    Parameters
    ----------
    loops : one for each coordinate
    canvases : int32, shape (coordinate, row, column or more), one for each grid
        Room for what the reader will have.
    error_of : callable
        The error of what the canvases hold.
    fineness : int
        Lattice steps that make the error wanted in one coordinate.
    progress : callable
        Called now and then with the fraction done, 0 to 1.
    """
    kept: dict[int, list[NDArray[np.int32]]] = {}
    done: list[int] = []

    def error(base: int) -> float:
        found = []
        for number, loop in enumerate(loops):
            found.append(loop.indices(Quantiser(base), [canvas[number, :, :-PADDING] for canvas in canvases]))
        done.append(base)
        progress(len(done) / MOST_TRIES)
        rms = error_of()
        if rms <= wanted:
            kept.clear()
            kept[base] = found
        return rms

    base = longest_base(error, wanted, _LIKELY_STEP * fineness)
    return None if base is None else (Quantiser(base), kept[base])
