"""The forward transform of one channel by pieces, level by level; equal to `pyramid.forward` of the whole.

For each level above the core, a first round of tasks steps the rows of each piece along the rows' axis; the predictor
of the columns' axis is then fitted to some of the rows; a second round steps along it, and leaves the coefficients of
the piece's tiles and the samples of the next level.

A grid needs nothing of the others but the fitted predictors: those of all patches, and another of all interfaces. A
band of a grid needs rows of its neighbours, see `crops`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..entropy.band_fields import KIND
from ..entropy.part_table import part_of
from ..entropy.tile_coder import planes_of
from ..entropy.tiles import TileTable, gather
from ..grid.layout import Layout
from ..scratch import Scratch
from ..transform.fitting import fitted_to_columns, sample_stride
from ..transform.lifting import forward_step
from ..transform.predictors import INTERFACES, fitted_steps, is_fitted, predictor
from ..transform.pyramid import empty
from .pieces import Part, Piece, Rows
from .step_rows import crop_rows

__all__ = [
    "Coefficients",
    "Samples",
    "coefficients_of",
    "details_of",
    "first_step",
    "fit_columns",
    "fit_rows",
    "joined",
    "largest_of",
    "sampled_columns",
    "sampled_rows",
    "second_step",
]

_Arrays = list[NDArray[np.int32]]


def joined(arrays: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return int32 arrays, shape (row, column), one after another in a flat array; a single array is not copied."""
    if len(arrays) == 1:
        return arrays[0]
    return np.concatenate([np.zeros(0, np.int32), *(array.ravel() for array in arrays)])


def _separated(stored: NDArray[Any], shapes: Sequence[tuple[int, int]]) -> list[NDArray[Any]]:
    """Return the arrays that `joined` put into a flat one: views of these shapes, (row, column)."""
    if len(shapes) == 1:
        return [stored.reshape(shapes[0])]
    arrays, place = [], 0
    for rows, columns in shapes:
        arrays.append(stored[place : place + rows * columns].reshape(rows, columns))
        place += rows * columns
    return arrays


class Samples:
    """The samples of a level, which lie in pieces.

    Parameters
    ----------
    scratch : Scratch
    name : str
        Pieces are arrays ``name/0``, ``name/1`` ..., `joined`.
    pieces : sequence of sequences of Rows
        What each holds, see `Pieces.samples`.
    layout : Layout
    level : int
    """

    def __init__(
        self, scratch: Scratch, name: str, pieces: Sequence[Sequence[Rows]], layout: Layout, level: int
    ) -> None:
        self._scratch, self._name, self._layout, self._level = scratch, name, layout, level
        self._shapes = [[(rows.height, layout.shape(rows.grid, level)[1]) for rows in piece] for piece in pieces]
        self._places: dict[int, list[tuple[Rows, int, int]]] = defaultdict(list)
        for number, piece in enumerate(pieces):
            for place, rows in enumerate(piece):
                self._places[rows.grid].append((rows, number, place))
        self._opened: tuple[int, list[NDArray[np.int32]]] = -1, []

    def read(self, wanted: Rows, out: NDArray[np.int32]) -> None:
        """Put rows of a grid into ``out``, shape (row, column)."""
        for rows, number, place in self._places[wanted.grid]:
            low, high = max(rows.start, wanted.start), min(rows.stop, wanted.stop)
            if low < high:
                array = self._piece(number)[place]
                out[low - wanted.start : high - wanted.start] = array[low - rows.start : high - rows.start]

    def grid(self, grid: int) -> NDArray[np.int32]:
        """Return all samples of a grid, shape (row, column), an array from `pyramid.empty`."""
        shape = self._layout.shape(grid, self._level)
        array = empty(shape)
        self.read(Rows(grid, 0, shape[0]), array)
        return array

    def _piece(self, number: int) -> list[NDArray[np.int32]]:
        """Return the arrays of a piece. The last piece stays open, since neighbours need it too."""
        if self._opened[0] != number:
            self._opened = number, _separated(self._scratch.read(f"{self._name}/{number}"), self._shapes[number])
        return self._opened[1]


# Fitting.


@lru_cache(maxsize=64)
def _lines(layout: Layout, level: int, axis: int) -> tuple[int, int]:
    """Count the lines along an axis that all patches have together at a level, and all interfaces."""
    counts = [0, 0]
    for number, grid in enumerate(layout.grids):
        counts[grid.interface] += layout.shape(number, level)[1 - axis]
    return counts[0], counts[1]


def _stride(layout: Layout, level: int, grid: int, axis: int) -> int:
    """Return the stride between lines along an axis that a grid's predictor is fitted to; 0: it is not fitted."""
    if not is_fitted(layout.steps(grid, level)[axis]):
        return 0
    lines = _lines(layout, level, axis)[layout.grids[grid].interface]
    return sample_stride(layout.shape(grid, level)[1 - axis], lines)


def _line_counts(layout: Layout, level: int, part: Part, stride: int) -> tuple[int, int]:
    """Count the rows of nodes, and of details, of a part that `sampled_rows` takes."""
    coarse = layout.shape(part.grid, level - 1)[0]
    nodes, details = (
        len(range(-(before + first) % stride, last - first, stride))
        for before, (first, last) in ((0, part.nodes), (coarse, part.details))
    )
    return nodes, details


def sampled_columns(arrays: Sequence[NDArray[np.int32]], layout: Layout, level: int, rows: Sequence[Rows]) -> _Arrays:
    """Return the columns of samples to which the predictor of the rows' axis is fitted, shape (row, column) each.

    ``arrays`` have ``rows`` of the level. Grids whose axis is too short have none.
    """
    if level == 0:
        return []
    strides = [_stride(layout, level, some.grid, 0) for some in rows]
    return [np.ascontiguousarray(array[:, ::stride]) for array, stride in zip(arrays, strides, strict=True) if stride]


def sampled_rows(stepped: Sequence[NDArray[np.int32]], layout: Layout, piece: Piece) -> _Arrays:
    """Return the rows of `first_step` to which the predictor of the columns' axis is fitted, shape (row, column) each.

    Of each part the nodes, then the details; none of grids whose axis is too short.
    """
    lines = []
    for array, part in zip(stepped, piece.parts, strict=True):
        stride = _stride(layout, piece.level, part.grid, 1)
        if stride:
            count = part.nodes[1] - part.nodes[0]
            coarse = layout.shape(part.grid, piece.level - 1)[0]
            lines.append(array[:count][-part.nodes[0] % stride :: stride])
            lines.append(array[count:][-(coarse + part.details[0]) % stride :: stride])
    return lines


def fit_rows(
    stored: Sequence[NDArray[np.int32]],
    pieces: Sequence[Sequence[Rows]],
    layout: Layout,
    level: int,
    rule: int,
    search: bool,
) -> tuple[int, int] | None:
    """Fit the (a, b) of the rows' axis of all patches, or of all interfaces; None where the level has none.

    Parameters
    ----------
    stored : sequence of int32 arrays
        What `sampled_columns` took of each piece of samples, `joined`.
    pieces : sequence of sequences of Rows
        See `Pieces.samples`.
    layout, level
    rule : int
        0, or `INTERFACES`.
    search : bool
        See `fitted_predictor`.
    """
    if (level - 1, rule) not in fitted_steps(layout):
        return None
    columns: dict[int, _Arrays] = defaultdict(list)
    for flat, piece in zip(stored, pieces, strict=True):
        strides = {rows: stride for rows in piece if (stride := _stride(layout, level, rows.grid, 0))}
        shapes = [(rows.height, -(-layout.shape(rows.grid, level)[1] // stride)) for rows, stride in strides.items()]
        for rows, array in zip(strides, _separated(flat, shapes), strict=True):
            if layout.grids[rows.grid].interface == (rule == INTERFACES):
                columns[rows.grid].append(array)
    sampled = [(np.concatenate(c), layout.steps(grid, level)[0]) for grid, c in columns.items()]
    return fitted_to_columns(sampled, search)


def fit_columns(
    stored: Sequence[NDArray[np.int32]], pieces: Sequence[Piece], layout: Layout, level: int, search: bool
) -> tuple[int, int] | None:
    """Fit the (a, b) of the columns' axis of all patches; None where the level has none.

    Parameters
    ----------
    stored : sequence of int32 arrays
        What `sampled_rows` took of each of the pieces, `joined`.
    pieces : sequence of Piece
        Of the level.
    layout, level
    search : bool
        See `fitted_predictor`.
    """
    if (level - 1, 1) not in fitted_steps(layout):
        return None
    nodes: dict[int, _Arrays] = defaultdict(list)
    details: dict[int, _Arrays] = defaultdict(list)
    for flat, piece in zip(stored, pieces, strict=True):
        strides = {part: stride for part in piece.parts if (stride := _stride(layout, level, part.grid, 1))}
        counts = [count for part, stride in strides.items() for count in _line_counts(layout, level, part, stride)]
        widths = [layout.shape(part.grid, level)[1] for part in strides for _ in range(2)]
        arrays = _separated(flat, list(zip(counts, widths, strict=True)))
        for part, upper, lower in zip(strides, arrays[::2], arrays[1::2], strict=True):
            nodes[part.grid].append(upper)
            details[part.grid].append(lower)
    lines = {grid: np.concatenate([*nodes[grid], *details[grid]]).T for grid in nodes}
    return fitted_to_columns([(array, layout.steps(grid, level)[1]) for grid, array in lines.items()], search)


# Steps.


def first_step(
    read: Callable[[Rows, NDArray[np.int32]], None], layout: Layout, piece: Piece, predictors: NDArray[np.int8]
) -> _Arrays:
    """Transform a piece along the rows' axis.

    Parameters
    ----------
    read : callable
        See `Samples.read`.
    layout : Layout
    piece : Piece
    predictors : int8, shape (level, rule, 2)

    Returns
    -------
    list of int32, shape (row, column)
        Of each part the nodes, then the details.
    """
    arrays = []
    for part in piece.parts:
        grid, step = layout.grids[part.grid], layout.steps(part.grid, piece.level)[0]
        crop = crop_rows(step, part.nodes, part.details)
        canvas, place = empty((crop.step.length, layout.shape(part.grid, piece.level)[1])), 0
        for start, stop in crop.samples:
            read(Rows(part.grid, start, stop), canvas[place : place + stop - start])
            place += stop - start
        if step.midpoints:
            forward_step(canvas, 0, crop.step, predictor(predictors, grid, step, piece.level, 0))
        if crop.nodes.stop == crop.details.start:
            arrays.append(canvas[crop.nodes.start : crop.details.stop])
        else:
            arrays.append(np.concatenate([canvas[crop.nodes], canvas[crop.details]]))
    return arrays


def second_step(
    stored: NDArray[np.int32], layout: Layout, piece: Piece, predictors: NDArray[np.int8]
) -> tuple[_Arrays, _Arrays]:
    """Transform a piece along the columns' axis.

    Parameters
    ----------
    stored : int32
        What `first_step` returns, `joined`.
    layout, piece, predictors
        As of `first_step`.

    Returns
    -------
    list of int32, shape (row, column), twice
        Of each part nodes and details; and its nodes alone, samples of the level below, views of the former.
    """
    parts = piece.parts
    shapes = [
        (last - first + stop - start, layout.shape(grid, piece.level)[1])
        for grid, (first, last), (start, stop) in parts
    ]
    arrays, nodes = [], []
    for view, part in zip(_separated(stored, shapes), parts, strict=True):
        array = empty(view.shape)
        array[...] = view
        grid, step = layout.grids[part.grid], layout.steps(part.grid, piece.level)[1]
        if step.midpoints:
            forward_step(array, 1, step, predictor(predictors, grid, step, piece.level, 1))
        arrays.append(array)
        nodes.append(array[: part.nodes[1] - part.nodes[0], : step.coarse])
    return arrays, nodes


class Coefficients(NamedTuple):
    """What the tiles of a piece hold.

    Attributes
    ----------
    flat : int32, flat
        What they have in the flat array of all coefficients, see `tiles.gather`.
    planes : int8, shape (tile,)
        Their bit-planes.
    """

    flat: NDArray[np.int32]
    planes: NDArray[np.int8]


def coefficients_of(
    arrays: Sequence[NDArray[np.int32]], table: TileTable, tiles: range, parts: Sequence[Part] | None = None
) -> Coefficients:
    """Return the coefficients of neighbouring tiles.

    Parameters
    ----------
    arrays : sequence of int32 arrays, shape (row, column)
        After the steps of both axes: of each part; or of each grid, with all coarser levels.
    table : TileTable
        Of all tiles.
    tiles : range
    parts : sequence of Part, optional
        What the arrays have of the tiles' level. All rows of all grids if not given.
    """
    part = part_of(table, [tiles])
    local, origins, grids = part.table, None, range(len(table.layout.grids))
    if parts is not None:
        origins, grids = local.origins.copy(), range(parts[0].grid, parts[-1].grid + 1)
        level = table.layout.level_of(tiles.start)
        for piece_part, bands in zip(parts, local.of_grids(grids), strict=True):
            height = piece_part.nodes[1] - piece_part.nodes[0]
            below = height - table.layout.shape(piece_part.grid, level - 1)[0] - piece_part.details[0]
            origins[bands, 1] += np.where(local.bands[bands, KIND] > 1, below, -piece_part.nodes[0])
    flat = gather(local, arrays, origins, grids)
    planes = np.array([planes_of(local, flat, tile) for tile in range(len(tiles))], np.int8)
    return Coefficients(flat[part.spans[0][1]], planes)


def details_of(array: NDArray[np.int32], nodes: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the three bands of details beside the nodes as two views, shape (row, column).

    ``array``, shape (row, column), has the nodes in its first rows and columns.
    """
    rows, columns = nodes.shape
    return array[rows:], array[:rows, columns:]


def largest_of(arrays: Sequence[NDArray[np.int32]]) -> int:
    """Return the largest magnitude in arrays, shape (row, column); 0 if there are none."""
    return max((max(int(array.max()), -int(array.min())) for array in arrays if array.size), default=0)
