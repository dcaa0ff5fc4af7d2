"""The embedded coder: one tile of one channel, bit-plane by bit-plane, through an adaptive binary range coder.

A plane takes two passes. Each goes through the tile's bands, and each band through its blocks of 8 x 8 coefficients in
raster order. The first pass visits only insignificant coefficients with a significant neighbour, for these are the bits
that lower the error most; the second visits all others. There, a block without a significant coefficient so far sends
one flag: does it get one in this plane? In a block that has, each coefficient sends its bit of the plane and, with the
first 1, its sign.

What a context sees of a coefficient are the bits known so far: of this plane for coefficients coded before it, of the
planes above for those that come later, and of the planes at and above this one for its parent and what is around that.
All of it is counted in units of the plane (bits below are shifted out), at most 3 for a neighbour; what lies outside
the tile's band is 0. docs/format.md, "Contexts of a unit", numbers the contexts:

- *Significance*, 36: by the two neighbours in the row, the two in the column, and one sum of all that is further off,
  of the parent and of what is around that. Rows and columns change places in bands with details along the rows' axis
  only.
- *Refinement*, 1, of the first bit after the highest one. Those after it are as likely 0 as 1 and have no context.
- *Signs*, 15: by the signs of the two neighbours in the row and of the two in the column; opposite cases share one.
- *Flags*, 27: by the blocks beside this one that have a significant coefficient, and by the parents.
- With a trellis, those of plane 0 are others, for either quantiser that an index may be for: that follows from the
  parity of the indices before it, so plane 0 has no first pass there.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from .band_fields import COLUMNS, OFFSET, ROWS, STRIDE

__all__ = [
    "BLOCK",
    "PADDING",
    "code_passes",
    "new_models",
    "pass_count",
    "pass_gains",
    "reconstruction_point",
    "symbols_room",
]

#: Rows and columns of a block.
BLOCK = 8
#: Elements that the kernel may read behind the last coefficient and its margin.
PADDING = 16
#: Coefficients that one call of the kernel visits; it takes some hundredths of a second.
_COEFFICIENTS_PER_CALL = 1 << 21


def pass_count(planes: int) -> int:
    """Return the number of coding passes of ``planes`` bit-planes: two for each, but the highest has no first pass."""
    return 2 * planes - 1 if planes else 0


def new_models(count: int, trellis: bool = False, large: int | None = None) -> NDArray[np.int32]:
    """Return the contexts of ``count`` tiles before their first planes: int32, shape (tile, context).

    ``large`` is the first of the tiles that are large units, if there are any.
    """
    size = kernels.TRELLIS_MODEL if trellis else kernels.MODEL
    models = np.full((count, size), kernels.NEW_CONTEXT, np.int32)
    models[count if large is None else large :] = 0
    return models


def symbols_room(coefficients: int, planes: int) -> int:
    """Return the size of ``symbols`` in `code_passes` for a large unit that is written, in elements of uint16."""
    return coefficients * (planes + 2) + 2048


def code_passes(
    reading: bool,
    bands: NDArray[np.int64],
    runs: NDArray[np.int64],
    known: NDArray[np.int32],
    sign: NDArray[np.int8],
    flags: NDArray[np.uint8],
    early: NDArray[np.uint8],
    true: NDArray[np.int32],
    models: NDArray[np.int32],
    data: NDArray[np.uint8],
    costs: NDArray[np.float64],
    trellis: bool,
    state: NDArray[np.int64] | None = None,
    symbols: NDArray[np.uint16] | None = None,
) -> None:
    """Code runs of passes of one channel, in order; plane p of a tile has the passes 2 p + 1 and 2 p.

    Parameters
    ----------
    reading : bool
        Read ``data`` rather than write it.
    bands : int64, shape (band, `band_fields.BAND_FIELDS`)
    runs : int64, shape (run, 8)
        Of each: the tile's first band and the number of its bands, the tile, the first and the last pass (from the
        highest down), where its bytes begin in ``data``, how many they are, and 1 if it is a large unit, whose passes
        are written all at once. Where writing, the bytes are the room for them, and are replaced by how many were
        written; a bit in a context takes at most 11 bits, in a large unit 16.
    known : int32, flat
        Magnitudes as far as they are known, of all tiles, two zeros around each band; updated.
    sign : int8, flat
        -1, +1, or 0 where no bit is known; updated.
    flags : uint8, flat
        Not 0 where a block has a significant coefficient; updated.
    early : uint8, flat
        1 + the plane in whose first pass a coefficient was coded last; in large units 1 + the plane in which it was
        found, and 128 more if in the second pass; updated.
    true : int32, flat
        The coefficients with their signs, where writing; empty where reading.
    models : int32, shape (tile, number), see `new_models`
        Updated.
    data : uint8
    costs : float64
        The bits written when each pass ended, by its number; or empty, unless a large unit is written.
    trellis : bool
        The coefficients are indices with a trellis, see `quantization.band_steps`; ``models`` are of a trellis.
    state : int64, shape (`kernels.PASSES_STATE`,), optional
        How far the runs are, zeros at first; updated. A call that was interrupted goes on from there when it is made
        again with the same arrays.
    symbols : uint16, optional
        Room for the decisions of a large unit that is written, see `symbols_room`.

    Raises
    ------
    ValueError
        When what ``bands`` or ``runs`` say does not fit the other arrays, or there is no room for what is written.
    """
    if state is None:
        state = np.zeros(kernels.PASSES_STATE, np.int64)
    symbols = np.zeros(0, np.uint16) if symbols is None else symbols
    arrays = known, sign, flags, early, true, models, data, costs, symbols, state
    # A kernel cannot be interrupted: it returns after so many coefficients, and `state` says where to go on.
    while kernels.passes(reading, trellis, bands, runs, *arrays, _COEFFICIENTS_PER_CALL) < len(runs):
        pass


def pass_gains(
    bands: NDArray[np.int64],
    weights: NDArray[np.float64],
    passes: int,
    true: NDArray[np.int32],
    early: NDArray[np.uint8],
) -> NDArray[np.float64]:
    """Return the weighted squared error of a tile for each number of passes that remain: float64, shape (passes + 1,).

    ``weights`` are the squared norms of the bands' synthesis functions, float64, shape (band,); ``early`` is the state
    after all passes of the tile have been coded.
    """
    errors, band_errors = np.zeros(passes + 1), np.empty(passes + 1)
    for part, part_weights in _parts(bands, weights):
        kernels.pass_gains(part, part_weights, true, early, band_errors)
        errors += band_errors
    return errors


def _parts(
    bands: NDArray[np.int64], weights: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Yield bands and weights call by call: all together, or in runs of rows where there are many coefficients."""
    if (bands[:, ROWS] * bands[:, COLUMNS]).sum() <= _COEFFICIENTS_PER_CALL:
        yield bands, weights
        return
    for number in range(len(bands)):
        band, weight = bands[number : number + 1], weights[number : number + 1]
        rows, columns = int(band[0, ROWS]), int(band[0, COLUMNS])
        height = max(1, _COEFFICIENTS_PER_CALL // columns)
        for top, first in itertools.product(range(0, rows, height), range(0, columns, _COEFFICIENTS_PER_CALL)):
            part = band.copy()
            part[0, OFFSET] += top * band[0, STRIDE] + first
            part[0, ROWS], part[0, COLUMNS] = min(height, rows - top), min(_COEFFICIENTS_PER_CALL, columns - first)
            yield part, weight


def reconstruction_point(plane: int) -> int:
    """Return the amount added to a significant magnitude whose bits below ``plane`` are unknown."""
    return (7 << plane) >> 4
