"""The third stage: the integers that are coded, coefficients or, for one error, indices of quantization steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..container.fields import told
from ..entropy.tile_coder import Channel, planes_of
from ..entropy.tiles import TileTable
from ..quantization.band_steps import Quantiser
from ..quantization.distortion import coordinate_distances
from .closed_loop import choose_indices
from .lattice_coordinates import Lattices
from .prepared import Prepared
from .transformed import Transformed

__all__ = ["NoQuantiserError", "Quantized", "quantize"]


class NoQuantiserError(Exception):
    """No quantization step is short enough for the error: the type of the values itself rounds by more."""


@dataclass(frozen=True, eq=False)
class Quantized:
    """What is coded of every channel.

    Attributes
    ----------
    prepared : Prepared
    lattices : Lattices
    tables : tuple of TileTable, one for each channel
    predictors : int8, shape (channel, level, axis, 2)
    quantiser : Quantiser or None
        Of the coordinates; None: coefficients are coded as they are.
    channels : tuple of Channel
        Coefficients or indices, int32, flat, see `tiles.gather`; weights and bit-planes.
    """

    prepared: Prepared
    lattices: Lattices
    tables: tuple[TileTable, ...]
    predictors: NDArray[np.int8]
    quantiser: Quantiser | None
    channels: tuple[Channel, ...]


def quantize(transformed: Transformed, progress: Callable[[float], None]) -> Quantized:
    """Choose the longest quantization steps whose error is at most the one that the stream is made for, if it is.

    Parameters
    ----------
    transformed : Transformed
    progress : callable
        Called now and then with the fraction of this stage that is done, 0 to 1.

    Raises
    ------
    NoQuantiserError
        If no steps are that short.
    """
    prepared, lattices, tables = transformed.prepared, transformed.lattices, transformed.tables
    quantiser, integers, weights = None, list(transformed.coefficients), list(transformed.weights)
    if transformed.loops:
        quantiser, indices = _for_one_error(transformed, progress)
        integers[:0] = indices
        squares = tables[0].steps(quantiser).astype(np.float64) ** 2
        weights[: len(indices)] = [own * squares for own in weights[: len(indices)]]
    channels = tuple(
        Channel(*own, _planes(tables[k], own[0])) for k, own in enumerate(zip(integers, weights, strict=True))
    )
    return Quantized(prepared, lattices, tables, transformed.predictors, quantiser, channels)


def _for_one_error(
    transformed: Transformed, progress: Callable[[float], None]
) -> tuple[Quantiser, list[NDArray[np.int32]]]:
    """The quantiser of a stream that is made for one error, and the indices of each coordinate, flat."""
    prepared = transformed.prepared
    assert prepared.rms is not None
    canvases, geometric = prepared.canvases(), prepared.geometric
    lattices = transformed.lattices.channels[:geometric]

    def error(tries: float) -> float:
        progress(tries)
        patches = canvases[prepared.interfaces :]
        return told(coordinate_distances(prepared.originals, lattices, patches, [0] * geometric)[0][0])

    fineness = transformed.lattices.fineness
    found = choose_indices(transformed.tables[0], transformed.loops, canvases, error, prepared.rms, fineness)
    if found is None:
        raise NoQuantiserError
    return found


def _planes(table: TileTable, integers: NDArray[np.int32]) -> NDArray[np.int8]:
    """Bit-planes of each tile: int8, shape (tile,)."""
    return np.array([planes_of(table, integers, tile) for tile in range(len(table.layout.tiles))], np.int8)
