"""The forward transform of one channel by bands of rows, level by level from the finest one down.

For each level above the core, a first round of tasks steps the rows of each band along the rows' axis; the predictor of
the columns' axis is then fitted to some of the rows; a second round steps along it, and leaves the coefficients of the
band's tiles and the samples of the next level. What comes out is what `pyramid.forward` makes of the whole.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..entropy.band_fields import KIND
from ..entropy.part_table import Part, part_of
from ..entropy.tile_coder import planes_of
from ..entropy.tiles import TileTable, gather
from ..grid.layout import Layout
from ..scratch import Scratch
from ..transform.fitting import fitted_to_columns, sample_stride
from ..transform.lifting import forward_step
from ..transform.predictors import is_fitted, predictor
from ..transform.pyramid import empty, forward
from .crops import crop_rows
from .geometry import Band, Bands

__all__ = [
    "core_transform",
    "first_step",
    "fit_columns",
    "fit_rows",
    "read_rows",
    "sampled_columns",
    "sampled_rows",
    "second_step",
]


def read_rows(
    scratch: Scratch, name: str, pieces: list[tuple[int, int]], rows: tuple[int, int], out: NDArray[np.int32]
) -> None:
    """Put rows of an array that lies in pieces, files ``name/0``, ``name/1`` ..., into ``out``, shape (row, column)."""
    start, stop = rows
    for number, (first, last) in enumerate(pieces):
        low, high = max(first, start), min(last, stop)
        if low < high:
            out[low - start : high - start] = scratch.read(f"{name}/{number}")[low - first : high - first]


def sampled_columns(samples: NDArray[np.int32]) -> NDArray[np.int32]:
    """The columns of samples, shape (row, column), that a predictor of the rows' axis is fitted to."""
    return np.ascontiguousarray(samples[:, :: sample_stride(samples.shape[1])])


def fit_rows(columns: list[NDArray[np.int32]], layout: Layout, level: int) -> tuple[int, int] | None:
    """The (a, b) of the rows' axis, of sampled columns of all bands one below the other; None: it has none."""
    step = layout.steps(0, level)[0]
    return fitted_to_columns([(np.concatenate(columns), step)]) if is_fitted(step) else None


def fit_columns(rows: list[NDArray[np.int32]], layout: Layout, level: int) -> tuple[int, int] | None:
    """The (a, b) of the columns' axis, of sampled rows of all bands in their order, see `first_step`."""
    step = layout.steps(0, level)[1]
    return fitted_to_columns([(np.concatenate(rows).T, step)]) if is_fitted(step) else None


def first_step(
    scratch: Scratch,
    name: str,
    pieces: list[tuple[int, int]],
    layout: Layout,
    band: Band,
    predictors: NDArray[np.int8],
) -> NDArray[np.int32]:
    """Nodes and details of a band's rows after the step along the rows' axis.

    Parameters
    ----------
    scratch, name, pieces
        Where the samples of the level lie, see `read_rows`.
    layout : Layout
        Of one grid.
    band : Band
    predictors : int8, shape (level, axis, 2)

    Returns
    -------
    int32, shape (row, column)
        The nodes, then the details.
    """
    step, columns = layout.steps(0, band.level)[0], layout.shape(0, band.level)[1]
    crop = crop_rows(step, band.nodes, band.details)
    canvas, done = empty((crop.step.length, columns)), 0
    for span in crop.samples:
        read_rows(scratch, name, pieces, span, canvas[done : done + span[1] - span[0]])
        done += span[1] - span[0]
    if step.midpoints:
        forward_step(canvas, 0, crop.step, predictor(predictors, layout.grids[0], step, band.level, 0))
    return np.concatenate([canvas[crop.nodes], canvas[crop.details]])


def sampled_rows(stepped: NDArray[np.int32], layout: Layout, band: Band) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Those of the rows of `first_step`, shape (row, column), that a predictor of the columns' axis is fitted to.

    Returns
    -------
    int32, shape (row, column), twice
        Of the nodes, and of the details.
    """
    rows, coarse = layout.shape(0, band.level)[0], layout.shape(0, band.level - 1)[0]
    stride = sample_stride(rows)
    nodes = stepped[-band.nodes[0] % stride : band.nodes[1] - band.nodes[0] : stride]
    details = stepped[band.nodes[1] - band.nodes[0] :][-(coarse + band.details[0]) % stride :: stride]
    return nodes.copy(), details.copy()


def second_step(
    stepped: NDArray[np.int32], layout: Layout, band: Band, predictors: NDArray[np.int8], table: TileTable
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int8]]:
    """The samples of the level below, and the coefficients of a band, after the step along the columns' axis.

    Parameters
    ----------
    stepped : int32, shape (row, column)
        As `first_step` returns it; changed.
    layout, band, predictors
    table : TileTable
        Of all tiles.

    Returns
    -------
    int32, shape (row, column)
        Nodes of the band, samples of the level below.
    int32, flat
        What the band's tiles have in the flat array of all coefficients, see `tiles.gather`.
    int8, shape (tile,)
        Bit-planes of the band's tiles.
    """
    step = layout.steps(0, band.level)[1]
    if step.midpoints:
        forward_step(stepped, 1, step, predictor(predictors, layout.grids[0], step, band.level, 1))
    count = band.nodes[1] - band.nodes[0]
    nodes = np.ascontiguousarray(stepped[:count, : step.coarse])
    return nodes, *_of_tiles(stepped, part_of(table, [band.tiles]), _Shift(layout, band))


def core_transform(
    samples: NDArray[np.int32], bands: Bands, table: TileTable, fit: bool
) -> tuple[NDArray[np.int8], NDArray[np.int32], NDArray[np.int8]]:
    """The levels of the core in one piece.

    Parameters
    ----------
    samples : int32, shape (row, column)
        Of the core's finest level, an array from `pyramid.empty`; changed.
    bands : Bands
    table : TileTable
        Of all tiles.
    fit : bool
        See `pyramid.forward`.

    Returns
    -------
    int8, shape (level, axis, 2)
        Predictors; (0, 0) of the levels above.
    int32, flat, and int8, shape (tile,)
        Coefficients and bit-planes of the core's tiles, as `second_step` returns them of a band.
    """
    predictors = forward([samples], bands.layout, fit, bands.core)
    return predictors, *_of_tiles(samples, part_of(table, [bands.core_tiles]), None)


class _Shift:
    """How far rows of the array of all coefficients, of nodes and of details, are moved among those of a band."""

    def __init__(self, layout: Layout, band: Band) -> None:
        self.nodes = -band.nodes[0]
        self.details = band.nodes[1] - band.nodes[0] - layout.shape(0, band.level - 1)[0] - band.details[0]


def _of_tiles(array: NDArray[np.int32], part: Part, shift: _Shift | None) -> tuple[NDArray[np.int32], NDArray[np.int8]]:
    """Coefficients, flat, and bit-planes of some tiles, of an array, shape (row, column), that has rows of theirs."""
    table = part.table
    origins = table.origins.copy()
    if shift is not None:
        origins[:, 1] += np.where(table.bands[:, KIND] > 1, shift.details, shift.nodes)
    flat = gather(table, [array], origins)
    planes = np.array([planes_of(table, flat, tile) for tile in range(len(table.members))], np.int8)
    return flat[part.spans[0][1]], planes
