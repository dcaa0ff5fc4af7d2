"""Coefficients from what is known of their bits: of tiles, into the arrays that the inverse transform takes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .band_fields import COLUMNS, OFFSET, ROWS, STRIDE
from .bitplanes import BLOCK, reconstruction_point
from .lifting import FRACTION_BITS
from .numba_kernels import bare_kernel, inlined
from .predictors import COEFFICIENT_BITS
from .trellis import ODD, TRANSITIONS

__all__ = ["UNANNOUNCED", "spread_bands"]

#: Passes that remain of a tile that was not announced: more than any tile has.
UNANNOUNCED = 57
#: Largest magnitude of a coefficient, as in the inverse transform.
_LARGEST = 1 << COEFFICIENT_BITS


@inlined
def _value(sixteenths: int, step: int, shift: int) -> int:
    """A coefficient from its index in sixteenths, times 2**shift."""
    return min(((sixteenths * step) >> 4) << shift, _LARGEST)


@bare_kernel
def _spread_quantised(
    known: NDArray[np.int32],
    sign: NDArray[np.int8],
    early: NDArray[np.uint8],
    band: NDArray[np.int64],
    step: int,
    remaining: int,
    shift: int,
    out: NDArray[np.int32],
    place: int,
    pitch: int,
) -> None:
    """Coefficients of a tile's band from what is known of their indices, see `tiles.Tiles.spread_levels`.

    Parameters
    ----------
    known, sign, early : flat, see `bitplanes.code_passes`
    band : int64, shape (`band_fields.BAND_FIELDS`,)
    step : int
        Lattice steps.
    remaining : int
        Passes of the tile that count as unknown.
    shift : int
        Coefficients are multiplied by 2**shift.
    out : int32, flat
        The coefficient of row i and column j goes to ``place + i * pitch + j``.
    """
    offset, stride, rows, columns = band[OFFSET], band[STRIDE], band[ROWS], band[COLUMNS]
    begun = remaining >> 1
    plane = begun + (remaining & 1)
    state = 0
    # Between whole planes the middle of what is possible, nearer to zero; of the two quantisers, their mean.
    middle = 7 * ((1 << plane) - 1) - 4
    found = 16 * (1 << begun) + 7 * ((1 << begun) - 1) - 4
    for top in range(0, rows, BLOCK):
        for left in range(0, columns, BLOCK):
            for i in range(top, min(top + BLOCK, rows)):
                for j in range(left, min(left + BLOCK, columns)):
                    at = offset + i * stride + j
                    magnitude = int(known[at])
                    high = magnitude >> plane
                    if remaining == 0:
                        sixteenths = 16 * magnitude - (8 * ODD[state] if magnitude else 0)
                        state = TRANSITIONS[state, magnitude & 1]
                    elif high:
                        sixteenths = 16 * (high << plane) + middle
                    elif plane != begun and early[at] == begun + 1 and magnitude >> begun:
                        sixteenths = found
                    else:
                        sixteenths = 0
                    value = _value(sixteenths, step, shift)
                    out[place + i * pitch + j] = value if sign[at] > 0 else -value


@bare_kernel
def spread_bands(
    known: NDArray[np.int32],
    sign: NDArray[np.int8],
    early: NDArray[np.uint8],
    bands: NDArray[np.int64],
    windows: NDArray[np.int64],
    steps: NDArray[np.int64],
    numbers: NDArray[np.int64],
    state: NDArray[np.int8],
    finer: int,
    out: NDArray[np.int32],
    pitch: int,
    first_row: int,
    first_column: int,
) -> None:
    """Put what is known of some bands into an array of coefficients.

    Unknown bits are replaced by the reconstruction point; what the remaining passes told counts as unknown.

    Parameters
    ----------
    known, sign, early : flat, see `bitplanes.code_passes`
    bands : int64, shape (band, `band_fields.BAND_FIELDS`)
    windows : int64, shape (band, 3)
        Of each band: its tile, and its first row and column among all coefficients.
    steps : int64, shape (band,)
        Lattice steps; 0 where ``known`` are no indices.
    numbers : int64, flat
        Of the bands.
    state : int8, shape (tile,)
        Passes that remain of each tile, or `UNANNOUNCED`.
    finer : int
        Coefficients of the tiles from this one on are multiplied by 2**`FRACTION_BITS` and kept within their bounds.
    out : int32, flat
        Coefficients from ``first_row`` and ``first_column`` on, whose rows are ``pitch`` apart; updated.
    """
    for number in range(numbers.size):
        band = numbers[number]
        tile, top, left = windows[band, 0], windows[band, 1] - first_row, windows[band, 2] - first_column
        passes, shift = int(state[tile]), FRACTION_BITS if tile >= finer else 0
        width = bands[band, COLUMNS]
        if steps[band] and passes < UNANNOUNCED:
            place, row, step = top * pitch + left, bands[band], steps[band]
            _spread_quantised(known, sign, early, row, step, passes, shift, out, place, pitch)
            continue
        for i in range(bands[band, ROWS]):
            start = bands[band, OFFSET] + i * bands[band, STRIDE]
            target = (top + i) * pitch + left
            _spread_row(
                known[start : start + width],
                sign[start : start + width],
                early[start : start + width],
                passes,
                shift,
                out[target : target + width],
            )


@inlined
def _spread_row(
    magnitudes: NDArray[np.int32],
    signs: NDArray[np.int8],
    marks: NDArray[np.uint8],
    remaining: int,
    places: int,
    out: NDArray[np.int32],
) -> None:
    begun = remaining >> 1  # the plane whose first pass is the last one known, if the number is odd
    plane = begun + (remaining & 1)
    shift, limit = np.int32(places), np.int32(_LARGEST >> places)
    if remaining >= UNANNOUNCED:
        for j in range(out.size):
            out[j] = 0
    elif remaining == 0:
        for j in range(out.size):
            out[j] = np.int32(np.int32(signs[j]) * min(magnitudes[j], limit)) << shift
    elif begun == plane:
        low, middle = np.int32(plane), np.int32(reconstruction_point(plane))
        for j in range(out.size):
            high = np.int32((magnitudes[j] >> low) << low)
            value = np.int32(high + middle) if high != 0 else np.int32(0)
            out[j] = np.int32(np.int32(signs[j]) * min(value, limit)) << shift
    else:
        low, middle = np.int32(plane), np.int32(reconstruction_point(plane))
        lower, mark = np.int32(begun), np.uint8(begun + 1)
        middle_begun = np.int32((1 << begun) + reconstruction_point(begun))
        for j in range(out.size):
            high = np.int32((magnitudes[j] >> low) << low)
            found = np.int32(magnitudes[j] >> lower) if marks[j] == mark else np.int32(0)
            value = np.int32(high + middle) if high != 0 else middle_begun if found != 0 else np.int32(0)
            out[j] = np.int32(np.int32(signs[j]) * min(value, limit)) << shift
