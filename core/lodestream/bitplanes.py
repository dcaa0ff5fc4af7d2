"""The embedded coder: one tile of one channel, bit-plane by bit-plane, through an adaptive binary range coder.

A plane takes two passes. Each goes through the tile's bands, and each band through its blocks of 8 x 8 coefficients in
raster order. The first pass visits only insignificant coefficients with a significant neighbour, for these are the bits
that lower the error most; the second visits all others. There, a block without a significant coefficient so far sends
one flag: does it get one in this plane? In a block that has, each coefficient sends its bit of the plane and, with the
first 1, its sign.

What a context sees of a coefficient are the bits known so far: of this plane for coefficients coded before it, of the
planes above for those that come later, and of the planes at and above this one for its parent and what is around that.
All of it is counted in units of the plane (bits below are shifted out); what lies outside the tile's band is 0. The
contexts, in this order:

- *Across*, of a coefficient's bit: ((m 5 + h) 5 + v) 4 + kind. m is the class of its own magnitude so far, in units of
  the next higher plane: 0, 1, 2 (for 2 and 3), 3 (for 4 and more). h and v are the sums of the two neighbours in its
  row and of those in its column, at most 4. kind is the band's: 1 for details along the columns' axis plus 2 for
  details along the rows' axis.
- *Around*, (m 7 + r) 6 + f, for m = 0 and 1 only, mixed with the former with two weights for each m. r is the `_CLASS`
  of the sum of the sixteen coefficients at distance two, the four in the same row or column counted twice; f is that of
  four times the parent plus its four neighbours, at most 5.
- *Signs*, a 1 is negative: (3 (x + 1) + y + 1) 4 + kind. x is the sign of the sum of the signs known of the neighbours
  in the row, y of those in the column.
- With a trellis, in plane 0, *across* and *around* for m = 0 and 1 are other ones, of the quantiser that the index is
  for: that follows from the parity of all before it, so plane 0 has no first pass there.
- *Flags*: (3 b + a) 3 + f. b counts the blocks to the left and above that have a significant coefficient, a those to
  the right and below; f is the largest of the parents of the block's coefficients, at most 2.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from . import kernels
from .band_fields import COLUMNS, OFFSET, ROWS, STRIDE

__all__ = ["BLOCK", "PADDING", "code_passes", "new_models", "pass_count", "pass_gains", "reconstruction_point"]

#: Rows and columns of a block.
BLOCK = 8
#: What the kernel may look at behind the last coefficient and its margin.
PADDING = 16
#: Coefficients that are looked at in one call of the kernel: some hundredths of a second.
_AT_ONCE = 1 << 21


def pass_count(planes: int) -> int:
    """Coding passes of so many bit-planes: two each, but the highest has no first pass."""
    return 2 * planes - 1 if planes else 0


def new_models(count: int, trellis: bool = False) -> NDArray[np.int32]:
    """The contexts and weights of so many tiles before their first planes: int32, shape (tile, number)."""
    models = np.empty((count, kernels.TRELLIS_MODEL if trellis else kernels.MODEL), np.int32)
    kernels.new_models(trellis, models)
    return models


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
) -> None:
    """Code runs of passes of one channel, one after another; plane p of a tile has the passes 2 p + 1 and 2 p.

    Parameters
    ----------
    reading : bool
        Read ``data`` rather than write it.
    bands : int64, shape (band, `band_fields.BAND_FIELDS`)
    runs : int64, shape (run, 7)
        Of each: the tile's first band and the number of its bands, the tile, the first and the last pass (from the
        highest down), where its bytes begin in ``data``, and how many they are. Where writing, that is the room for
        them, and is replaced by how many were written; a bit in a context takes at most 11 bits.
    known : int32, flat
        Magnitudes as far as they are known, of all tiles, two zeros around each band; updated.
    sign : int8, flat
        -1, +1, or 0 where no bit is known; updated.
    flags : uint8, flat
        Not 0 where a block has a significant coefficient; updated.
    early : uint8, flat
        1 + the plane in whose first pass a coefficient was coded last; updated.
    true : int32, flat
        The coefficients with their signs, where writing; empty where reading.
    models : int32, shape (tile, number), see `new_models`
        Updated.
    data : uint8
    costs : float64
        The bits written when each pass ended, by its number; or empty.
    trellis : bool
        The coefficients are indices with a trellis, see `trellis`; ``models`` are of a trellis.
    state : int64, shape (`kernels.PASSES_STATE`,), optional
        How far the runs are, zeros at first; updated. A call that was interrupted goes on from there when it is made
        again with the same arrays.

    Raises
    ------
    ValueError
        When what ``bands`` or ``runs`` say does not fit the other arrays, or there is no room for what is written.
    """
    if state is None:
        state = np.zeros(kernels.PASSES_STATE, np.int64)
    arrays = known, sign, flags, early, true, models, data, costs, state
    while kernels.passes(reading, trellis, bands, runs, *arrays, _AT_ONCE) < len(runs):
        pass


def pass_gains(
    bands: NDArray[np.int64],
    weights: NDArray[np.float64],
    passes: int,
    true: NDArray[np.int32],
    early: NDArray[np.uint8],
) -> NDArray[np.float64]:
    """Weighted squared error of a tile by the passes that remain: float64, shape (passes + 1,).

    ``weights`` are the squared norms of the bands' synthesis functions, one a band; ``early`` is that of the whole
    tile coded.
    """
    errors, part = np.zeros(passes + 1), np.empty(passes + 1)
    for rows, worth in _parts(bands, weights):
        kernels.pass_gains(rows, worth, true, early, part)
        errors += part
    return errors


def _parts(
    bands: NDArray[np.int64], weights: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.float64]]]:
    """Bands and their weights for one call after another: all at once, or rows of one after another where many."""
    if (bands[:, ROWS] * bands[:, COLUMNS]).sum() <= _AT_ONCE:
        yield bands, weights
        return
    for number in range(len(bands)):
        band, weight = bands[number : number + 1], weights[number : number + 1]
        rows, columns = int(band[0, ROWS]), int(band[0, COLUMNS])
        height = max(1, _AT_ONCE // columns)
        for top, left in itertools.product(range(0, rows, height), range(0, columns, _AT_ONCE)):
            part = band.copy()
            part[0, OFFSET] += top * band[0, STRIDE] + left
            part[0, ROWS], part[0, COLUMNS] = min(height, rows - top), min(_AT_ONCE, columns - left)
            yield part, weight


def reconstruction_point(plane: int) -> int:
    """What is added to a significant magnitude whose bits below ``plane`` are unknown."""
    return (7 << plane) >> 4
