"""Coefficients in steps: what a stream made for one root mean square error codes in place of whole lattice steps.

Each band has a step, so that one step of any coefficient changes the surface by about as much. What is coded, plane by
plane, are the *indices*: a coefficient is its index times its band's step. A *trellis* halves the distance between the
values that are within reach without longer indices, see `trellis`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .band_fields import COLUMNS, OFFSET, ROWS, STRIDE
from .bitplanes import BLOCK
from .kernels import inlined, kernel
from .layout import Band, Layout
from .predictors import COEFFICIENT_BITS
from .trellis import ODD, TRANSITIONS

__all__ = ["MOST_BASE", "Quantiser", "spread_quantised", "step_of"]

#: Largest `Quantiser.base`.
MOST_BASE = (1 << 24) - 1
#: Largest magnitude of a coefficient, as in the inverse transform.
_LARGEST = 1 << COEFFICIENT_BITS

#: Of a node and of a detail along an axis: 2**16 over the norm of its synthesis function with the four-point rule, by
#: the axis's steps from there to the finest level; further steps halve it for each two of them.
_ALONG = np.array([[65536, 53303, 39201, 27993, 19842, 14039], [65536, 77936, 69201, 52586, 37885, 26915]], np.int64)


@dataclass(frozen=True)
class Quantiser:
    """How the coordinates of a stream are quantised.

    Attributes
    ----------
    base : int
        The step of a coefficient that changes one point alone, in lattice steps; 1 to 2**24 - 1.
    """

    base: int


def step_of(band: Band, level: int, layout: Layout, quantiser: Quantiser) -> int:
    """The step of a band of a level, in lattice steps; at least 1 and below 2**26."""
    product = quantiser.base
    first = max(level, 1)
    for axis in range(2):
        if layout.grids[band.grid].curve and axis == 1:
            # The points of a curve reach across the parts beside it, as nodes do.
            count, detail = layout.levels + 1 - first, False
        else:
            every = range(first, layout.levels + 1)
            count = sum(1 for k in every if layout.steps(band.grid, k)[axis].midpoints)
            detail = band.kind[axis]
        product *= _along(count, detail)
    return max(1, product >> 32)


def _along(count: int, detail: bool) -> int:
    halvings = max(0, (count - 4) // 2)
    return int(_ALONG[int(detail), count - 2 * halvings]) >> halvings


@inlined
def _value(sixteenths: int, step: int) -> int:
    """A coefficient from its index in sixteenths."""
    return min((sixteenths * step) >> 4, _LARGEST)


@kernel
def spread_quantised(
    known: NDArray[np.int32],
    sign: NDArray[np.int8],
    early: NDArray[np.uint8],
    band: NDArray[np.int64],
    step: int,
    remaining: int,
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
                    value = _value(sixteenths, step)
                    out[place + i * pitch + j] = value if sign[at] > 0 else -value
