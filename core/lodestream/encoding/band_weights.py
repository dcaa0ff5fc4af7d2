"""What the coefficients of each band are worth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..entropy.tiles import TileTable
from ..grid.layout import Layout
from ..quantization.lattice import Lattice
from ..transform.pyramid import synthesis_norms
from .prepared import Prepared

__all__ = ["band_weights"]


def band_weights(
    prepared: Prepared, channel: int, lattice: Lattice, table: TileTable, predictors: NDArray[np.int8]
) -> NDArray[np.float64]:
    """Return what a coefficient of one is worth in each band: float64, shape (band,).

    Errors are weighed relative to the extent, so that their squares stay within float64 at any scale; an attribute
    shares the stream in proportion to its own range.
    """
    layout: Layout = prepared.layout
    norms = [synthesis_norms(layout, predictors, grid) for grid in range(len(layout.grids))]
    span = prepared.extent if channel < prepared.geometric else prepared.span(channel)
    spacing = lattice.spacing / span if span else 0.0
    classes, of_band = table.classes()
    return np.array([norms[grid][level, *map(int, kind)] * spacing**2 for level, grid, kind in classes])[of_band]
