"""Indices of quantization steps in place of coefficients, for a stream that is made for one root mean square error."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..container.fields import told
from ..entropy.tiles import TileTable
from ..quantization.band_steps import Quantiser
from ..quantization.distortion import coordinate_distances
from ..transform.predictors import COEFFICIENT_BITS
from ..transform.pyramid import copied, forward
from .closed_loop import ClosedLoop, choose_indices
from .curves import band_weights
from .lattice_coordinates import Lattices, lattice_coordinates
from .prepared import Prepared

__all__ = ["NoQuantiserError", "Quantized", "closed_loop", "quantize"]


class NoQuantiserError(Exception):
    """No quantization step is short enough for the error: the type of the values itself rounds by more."""


@dataclass(frozen=True, eq=False)
class Quantized:
    """What is coded of the coordinates.

    Attributes
    ----------
    quantiser : Quantiser
    predictors : tuple of int8 arrays, shape (level, axis, 2), one for each coordinate
        See `pyramid.forward`.
    indices : tuple of int32 arrays, flat, see `tiles.gather`
    weights : tuple of float64 arrays, shape (band,)
        What an index of one is worth, in squared error relative to the extent.
    """

    quantiser: Quantiser
    predictors: tuple[NDArray[np.int8], ...]
    indices: tuple[NDArray[np.int32], ...]
    weights: tuple[NDArray[np.float64], ...]


def quantize(prepared: Prepared, lattices: Lattices, table: TileTable, progress: Callable[[float], None]) -> Quantized:
    """Choose the longest quantization steps whose error is at most the one that the stream is made for.

    Parameters
    ----------
    prepared : Prepared
        Of a stream that is made for one error.
    lattices : Lattices
        With a `fineness`.
    table : TileTable
        Of the coordinates.
    progress : callable
        Called now and then with the fraction of this that is done, 0 to 1.

    Raises
    ------
    NoQuantiserError
        If no steps are that short.
    """
    assert prepared.rms is not None
    canvases, channels = prepared.canvases(), range(prepared.geometric)
    loops, predictors = zip(*(closed_loop(prepared, lattices, table, channel) for channel in channels), strict=True)

    def error(tries: float) -> float:
        progress(tries)
        patches = canvases[prepared.interfaces :]
        coordinate_lattices = lattices.channels[: prepared.geometric]
        return told(coordinate_distances(prepared.originals, coordinate_lattices, patches, [0] * len(channels))[0][0])

    chosen = choose_indices(table, loops, canvases, error, prepared.rms, lattices.fineness)
    if chosen is None:
        raise NoQuantiserError
    quantiser, indices = chosen
    squares = table.steps(quantiser).astype(np.float64) ** 2
    weights = (
        band_weights(prepared, channel, lattices.channels[channel], table, predictors[channel]) * squares
        for channel in channels
    )
    return Quantized(quantiser, predictors, tuple(indices), tuple(weights))


def closed_loop(
    prepared: Prepared, lattices: Lattices, table: TileTable, channel: int
) -> tuple[ClosedLoop, NDArray[np.int8]]:
    """Return the closed loop that quantizes a coordinate, and its predictors, int8, shape (level, axis, 2).

    It keeps the lattice coordinates, int32, shape (row, column) of each grid.
    """
    for fit in (True, False):
        arrays: Sequence[NDArray[np.int32]] = lattice_coordinates(prepared, channel, lattices.channels[channel])
        originals = [copied(array) for array in arrays]
        predictors = forward(arrays, prepared.layout, fit, search=prepared.choices.search)
        # Fitted predictors can let coefficients grow beyond what a container holds; the default ones never do.
        if max(max(int(array.max()), -int(array.min())) for array in arrays) < 1 << COEFFICIENT_BITS:
            break
    return ClosedLoop(table, predictors, originals), predictors
