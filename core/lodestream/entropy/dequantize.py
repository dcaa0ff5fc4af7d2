"""Coefficients estimated from their known bits: from tiles into the arrays that the inverse transform takes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from .band_fields import COLUMNS, ROWS

__all__ = ["UNANNOUNCED", "spread_bands"]

#: Passes that remain of a tile that was not announced: more than any tile has.
UNANNOUNCED = 57
#: Coefficients that one call of the kernel writes, unless a single band has more.
_COEFFICIENTS_PER_CALL = 1 << 22


def spread_bands(
    known: NDArray[np.int32],
    sign: NDArray[np.int8],
    early: NDArray[np.uint8],
    bands: NDArray[np.int64],
    origins: NDArray[np.int64],
    steps: NDArray[np.int64],
    numbers: NDArray[np.int64],
    state: NDArray[np.int8],
    finer: int,
    out: NDArray[np.int32],
    origin: tuple[int, int],
) -> None:
    """Estimate the coefficients of some bands from their known bits and write them into an array.

    Unknown bits are replaced by the reconstruction point; bits coded by the remaining passes count as unknown.

    Parameters
    ----------
    known, sign, early : flat, see `bitplanes.code_passes`
    bands : int64, shape (band, `band_fields.BAND_FIELDS`)
    origins : int64, shape (band, 3)
        Of each band: its tile, and its first row and column among all coefficients.
    steps : int64, shape (band,)
        Lattice steps; 0 where ``known`` are no indices.
    numbers : int64, flat
        Of the bands.
    state : int8, shape (tile,)
        Passes that remain of each tile, or `UNANNOUNCED`.
    finer : int
        Coefficients of the tiles from this one on are multiplied by 2**`lifting.FRACTION_BITS` and kept within their
        bounds.
    out : int32, shape (row, column)
        Coefficients from the row and column ``origin`` on; updated. Parts of bands outside it are skipped.

    Raises
    ------
    ValueError
        Where a band does not lie inside the flat arrays.
    """
    for batch in _batches(bands, numbers) if known.size > _COEFFICIENTS_PER_CALL else [numbers] if numbers.size else []:
        kernels.spread(known, sign, early, bands, origins, steps, batch, state, finer, out, *origin)


def _batches(bands: NDArray[np.int64], numbers: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Divide the band numbers into the batches of single calls, each int64, shape (band,)."""
    sizes = np.cumsum(bands[numbers, ROWS] * bands[numbers, COLUMNS])
    start = 0
    while start < numbers.size:
        reached = sizes[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(sizes, reached + _COEFFICIENTS_PER_CALL, side="right")))
        yield numbers[start:stop]
        start = stop
