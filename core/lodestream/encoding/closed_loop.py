"""Quantization for one error in a closed loop, from the coarsest level to the finest.

Each level is reconstructed as the reader will, and the details of the next one are predicted from that: so errors of
nodes do not enter the details. What the reader is to have are the details before the third lifting step. The levels are
then orthogonal: no error of one could be made good by another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..entropy.band_fields import COLUMNS, KIND, OFFSET, ROWS, STRIDE
from ..entropy.dequantize import spread_bands
from ..entropy.tiles import TileTable
from ..grid.layout import Layout
from ..quantization.band_steps import Quantiser
from ..transform.predictors import predictor
from ..transform.pyramid import PADDING, allocate, bare_level, inverse_level, take_details, take_nodes, third_step
from .noise_shaping import feedback_rules
from .rate_distortion import MOST_TRIES, IndexChooser, longest_base

__all__ = ["ClosedLoop", "choose_indices"]

#: The quantization step of a stream made for one error, over the error, that is tried first.
_LIKELY_STEP = 6
_BOTH = 3  # details along both axes, in `band_fields.KIND`


class ClosedLoop:
    """Quantizes one channel, which is a coordinate.

    Parameters
    ----------
    table : TileTable
    predictors : int8, shape (level, axis, 2)
        See `transform.forward`.
    arrays : int32, shape (row, column), one for each grid
        The channel's lattice coordinates. They are kept, as nodes and details before the third lifting step.
    """

    def __init__(self, table: TileTable, predictors: NDArray[np.int8], arrays: Sequence[NDArray[np.int32]]) -> None:
        self._table, self._predictors, self._aims = table, predictors, arrays
        for level in range(table.layout.levels, 0, -1):
            for number, array in enumerate(arrays):
                bare_level(array, table.layout, number, level)
        self._levels = list(_bands(table))
        self._chooser = IndexChooser(table)

    def indices(
        self, steps: NDArray[np.int64], rules: NDArray[np.float32], reconstructions: Sequence[NDArray[np.int32]]
    ) -> NDArray[np.int32]:
        """Return the index of every coefficient, and put what the reader will have into ``reconstructions``.

        The result has the shape (`TileTable.size`,), ``reconstructions`` of the grids (row, column) each. For ``steps``
        and ``rules`` of the bands see `TileTable.steps` and `noise_shaping.feedback_rules`.
        """
        table, predictors = self._table, self._predictors
        for reconstruction in reconstructions:
            reconstruction.fill(0)
        self._chooser.begin(steps, rules)
        coder = _Coder(table, self._chooser, steps, self._aims, reconstructions)
        for level, of_grid in self._levels:
            if level == 0:
                coder.code(of_grid, {})
                take_nodes(reconstructions, table.layout)
                continue
            for number in of_grid:
                take_details(reconstructions, table.layout, predictors, number, level)
            details = {
                number: _Details(table.layout, predictors, number, level, reconstructions[number]) for number in of_grid
            }
            both = {number: table.bands[numbers, KIND] == _BOTH for number, numbers in of_grid.items()}
            coder.code(
                {k: numbers[~both[k]] for k, numbers in of_grid.items()}, {k: d.along_one() for k, d in details.items()}
            )
            coder.code(
                {k: numbers[both[k]] for k, numbers in of_grid.items()}, {k: d.along_both() for k, d in details.items()}
            )
            for number in of_grid:
                inverse_level(reconstructions[number], table.layout, predictors, number, level)
        return self._chooser.end()


def _bands(table: TileTable) -> Iterator[tuple[int, dict[int, NDArray[np.int64]]]]:
    """Yield the numbers of each grid's bands level by level, interfaces before patches that take sides from them."""
    layout = table.layout
    levels = layout.tile_levels[table.origins[:, 0]]
    grids = list(range(len(layout.grids)))
    interfaces = sum(grid.interface for grid in layout.grids)
    for level in range(layout.levels + 1):
        groups = [grids] if level == 0 else [grids[:interfaces], grids[interfaces:]]
        for group in groups:
            yield level, {k: table.of_grid[k][levels[table.of_grid[k]] == level] for k in group}


class _Details:
    """What the third lifting step predicts of the details of a level of a grid, from what the reader has of it."""

    def __init__(
        self, layout: Layout, predictors: NDArray[np.int8], grid: int, level: int, reconstruction: NDArray[np.int32]
    ) -> None:
        self._steps, (rows, columns) = layout.steps(grid, level), layout.shape(grid, level)
        self._rules = [predictor(predictors, layout.grids[grid], step, level, a) for a, step in enumerate(self._steps)]
        self._reconstructed, (self._top, self._left) = reconstruction[:rows, :columns], layout.shape(grid, level - 1)
        self._predicted = allocate((rows, columns))

    def along_one(self) -> NDArray[np.int32]:
        """Return the predictions of details along one axis, from the nodes; int32, shape (row, column) of the level."""
        nodes = self._reconstructed[: self._top, : self._left]
        self._predicted[: self._top, self._left :] = self._third_step(nodes, 1)
        self._predicted[self._top :, : self._left] = self._third_step(nodes, 0)
        return self._predicted

    def along_both(self) -> NDArray[np.int32]:
        """Return the predictions along both axes, from the details along one.

        Int32, shape (row, column) of the level.
        """
        details = self._predicted[: self._top, self._left :] + self._reconstructed[: self._top, self._left :]
        both = self._predicted[self._top :, self._left :]
        both[...] = self._third_step(details, 0)
        both += self._third_step(self._reconstructed[self._top :, : self._left], 1)
        return self._predicted

    def _third_step(self, nodes: NDArray[np.int32], axis: int) -> NDArray[np.int32]:
        return third_step(nodes, axis, self._steps[axis], self._rules[axis])


class _Coder:
    """Chooses the indices of bands, and puts what the reader makes of them into reconstructions of the grids."""

    def __init__(
        self,
        table: TileTable,
        chooser: IndexChooser,
        steps: NDArray[np.int64],
        aims: Sequence[NDArray[np.int32]],
        reconstructions: Sequence[NDArray[np.int32]],
    ) -> None:
        self._table, self._chooser, self._steps = table, chooser, steps
        self._aims, self._reconstructed_grids = aims, reconstructions
        self._targets, self._sizes = np.zeros((2, table.size), np.int32)
        self._signs = np.zeros(table.size, np.int8)
        self._early = np.zeros(table.size, np.uint8)
        self._complete = np.zeros(len(table.layout.tiles), np.int8)

    def code(self, of_grid: dict[int, NDArray[np.int64]], predicted: dict[int, NDArray[np.int32]]) -> None:
        """Code some bands of each grid: the target less the prediction, if there is one."""
        for grid, numbers in of_grid.items():
            for number in numbers.tolist():
                target, window = self._own(self._targets, number), self._window(number)
                target[...] = self._aims[grid][window]
                if predicted:
                    target -= predicted[grid][window]
        together = np.concatenate([np.zeros(0, np.int64), *of_grid.values()])
        if not together.size:
            return
        self._chooser.choose(together, self._targets)
        for number in together.tolist():
            chosen = self._own(self._chooser.chosen, number)
            np.abs(chosen, out=self._own(self._sizes, number))
            np.sign(chosen, out=self._own(self._signs, number), casting="same_kind")
        known = self._sizes, self._signs, self._early, self._table.bands, self._table.origins, self._steps
        for grid, numbers in of_grid.items():
            spread_bands(*known, numbers, self._complete, self._complete.size, self._reconstructed_grids[grid], (0, 0))

    def _own(self, flat: NDArray[Any], number: int) -> NDArray[Any]:
        """Return a band in a flat array, shape (row, column), a view."""
        place, stride, rows, columns = self._table.bands[number, [OFFSET, STRIDE, ROWS, COLUMNS]].tolist()
        return flat[place : place + rows * stride].reshape(rows, stride)[:, :columns]

    def _window(self, number: int) -> tuple[slice, slice]:
        """Return where a band lies among the coefficients of its grid."""
        _, top, left = self._table.origins[number].tolist()
        rows, columns = self._table.bands[number, [ROWS, COLUMNS]].tolist()
        return slice(top, top + rows), slice(left, left + columns)


def choose_indices(
    table: TileTable,
    loops: Sequence[ClosedLoop],
    canvases: Sequence[NDArray[np.int32]],
    error_of: Callable[[float], float],
    wanted: float,
    fineness: int,
) -> tuple[Quantiser, list[NDArray[np.int32]]] | None:
    """Return the longest quantization steps whose error is at most the one wanted, and the indices then.

    None if there are none.

    Parameters
    ----------
    table : TileTable
    loops : one for each coordinate
    canvases : int32, shape (coordinate, row, column or more), one for each grid
        Room for what the reader will have.
    error_of : callable
        The error of what the canvases hold; it is given the share of all tries that is done.
    fineness : int
        Lattice steps that make the error wanted in one coordinate.
    """
    kept: dict[int, list[NDArray[np.int32]]] = {}
    done: list[int] = []

    def error(base: int) -> float:
        steps, rules = table.steps(Quantiser(base)), feedback_rules(table, Quantiser(base))
        indices = []
        for number, loop in enumerate(loops):
            indices.append(loop.indices(steps, rules, [canvas[number, :, :-PADDING] for canvas in canvases]))
        done.append(base)
        rms = error_of(len(done) / MOST_TRIES)
        if rms <= wanted:
            kept.clear()
            kept[base] = indices
        return rms

    base = longest_base(error, wanted, _LIKELY_STEP * fineness)
    return None if base is None else (Quantiser(base), kept[base])
