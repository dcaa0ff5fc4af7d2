"""The second stage: lattice coordinates of every channel through the forward transform, and cut into tiles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..entropy.tiles import TileTable, gather
from ..grid.layout import Layout
from ..quantization.lattice import Lattice
from ..transform.predictors import COEFFICIENT_BITS, default_predictors
from ..transform.pyramid import copied, forward, synthesis_norms
from .closed_loop import ClosedLoop
from .lattice_coordinates import Lattices, lattice_coordinates
from .prepared import Prepared

__all__ = ["Transformed", "band_weights", "transform"]


@dataclass(frozen=True, eq=False)
class Transformed:
    """What the transform makes of a prepared surface.

    Attributes
    ----------
    prepared : Prepared
    lattices : Lattices
    tables : tuple of TileTable, one for each channel
    predictors : int8, shape (channel, level, axis, 2)
        See `pyramid.forward`.
    loops : tuple of ClosedLoop
        Of a stream that is made for one error: one for each coordinate, whose indices are not chosen yet. Each keeps
        the lattice coordinates of its channel, four bytes a point. Else none.
    coefficients : tuple of int32 arrays, flat, see `tiles.gather`
        One for each channel that has no loop; those with loops come before them.
    weights : tuple of float64 arrays, shape (band,), one for each channel
        What a coefficient of one is worth, in squared error relative to the extent.
    """

    prepared: Prepared
    lattices: Lattices
    tables: tuple[TileTable, ...]
    predictors: NDArray[np.int8]
    loops: tuple[ClosedLoop, ...]
    coefficients: tuple[NDArray[np.int32], ...]
    weights: tuple[NDArray[np.float64], ...]


def transform(prepared: Prepared, lattices: Lattices) -> Transformed:
    """Put every channel on its lattice and transform it."""
    layout, geometric = prepared.layout, prepared.geometric
    table = TileTable.of(layout)
    other = TileTable.of(layout, False) if layout.shared else table
    channels = range(len(lattices.channels))
    tables = tuple(table if channel < geometric else other for channel in channels)
    predictors = np.zeros((len(channels), *default_predictors(layout).shape), np.int8)
    loops, coefficients, weights = [], [], []
    for channel, lattice in enumerate(lattices.channels):
        looped = lattices.fineness > 0 and channel < geometric
        arrays, originals, own = _forward(prepared, channel, lattice, looped)
        predictors[channel] = own
        if looped:
            loops.append(ClosedLoop(tables[channel], own, originals))
        else:
            coefficients.append(gather(tables[channel], arrays))
        del arrays, originals  # before the arrays of the next channel are made
        weights.append(band_weights(prepared, channel, lattice, tables[channel], own))
    return Transformed(prepared, lattices, tables, predictors, tuple(loops), tuple(coefficients), tuple(weights))


def _forward(
    prepared: Prepared, channel: int, lattice: Lattice, keep: bool
) -> tuple[list[NDArray[np.int32]], Sequence[NDArray[np.int32]], NDArray[np.int8]]:
    """Coefficients of a channel, one array for each grid; its lattice coordinates if they are to be kept; predictors.

    Fitted predictors can let coefficients grow beyond what a container holds; the default ones never do.
    """
    for fit in (True, False):
        arrays = lattice_coordinates(prepared, channel, lattice)
        originals = [copied(array) for array in arrays] if keep else []
        predictors = forward(arrays, prepared.layout, fit)
        if max(_largest(array) for array in arrays) < 1 << COEFFICIENT_BITS:
            break
    return arrays, originals, predictors


def band_weights(
    prepared: Prepared, channel: int, lattice: Lattice, table: TileTable, predictors: NDArray[np.int8]
) -> NDArray[np.float64]:
    """What a coefficient of one is worth in each band: float64, shape (band,).

    Errors are weighed relative to the extent, so that their squares stay within float64 at any scale; an attribute
    shares the stream in proportion to its own range.
    """
    layout: Layout = prepared.layout
    norms = [synthesis_norms(layout, predictors, grid) for grid in range(len(layout.grids))]
    span = prepared.extent if channel < prepared.geometric else prepared.span(channel)
    spacing = lattice.spacing / span if span else 0.0
    classes, of_band = table.classes()
    return np.array([norms[grid][level, *map(int, kind)] * spacing**2 for level, grid, kind in classes])[of_band]


def _largest(values: NDArray[np.int32]) -> int:
    """The largest magnitude."""
    return max(int(values.max()), -int(values.min()))
