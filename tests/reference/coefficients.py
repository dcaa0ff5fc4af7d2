"""Coefficients of a unit of which passes remain: section 8 of docs/format.md, its beginning and 8.1."""

import numpy as np
from numpy.typing import NDArray

from .bands import Band
from .levels import Grid
from .tiles import Share

DETAILS = [0, 77936, 69201, 52586, 37885, 26915]
NODES = [65536, 53303, 39201, 27993, 19842, 14039]


def _weight(steps: int, detail: int) -> int:
    half = (steps - 4) // 2 if steps > 5 else 0
    return (DETAILS if detail else NODES)[steps - 2 * half] >> half


def quantiser_step(base: int, grid: Grid, level: int, share: Share) -> int:
    """Compute the quantiser step S of a band in lattice steps."""
    lower = max(level, 1) - 1
    finest = len(grid.axes) - 1
    product = base
    for axis in (0, 1):
        if grid.interface and axis == 1:
            steps = finest - lower
        else:
            steps = sum(grid.stepped(upper, axis) for upper in range(lower + 1, finest + 1))
        product *= _weight(steps, share.kind[axis])
    return max(1, product >> 32)


def reconstructed(band: Band, remaining: int, step: int) -> NDArray[np.int64]:
    """Reconstruct coefficients as they are while passes remain.

    `band` (Band): with these passes decoded, or more; `remaining` (int): passes that remain; `step` (int): S of a band
    of indices, otherwise 0. Returns int64 (rows, columns): the coefficients.
    """
    magnitude = band.magnitude.astype(np.int64)
    plane = (remaining + 1) >> 1
    known = magnitude >> plane
    if step:
        value = 16 * magnitude - 8 * (band.odd & (magnitude > 0))
        if remaining:
            value = np.where(known > 0, 16 * (known << plane) + 7 * ((1 << plane) - 1) - 4, 0)
    else:
        value = np.where(known > 0, (known << plane) + ((7 << plane) >> 4), 0)
    if remaining & 1:
        low = plane - 1
        early = (known == 0) & (magnitude >> low > 0) & band.early
        value[early] = 16 * (1 << low) + 7 * ((1 << low) - 1) - 4 if step else (1 << low) + ((7 << low) >> 4)
    if step:
        value = np.minimum(value * step >> 4, 1 << 28)
    return np.where(band.negative, -value, value)
