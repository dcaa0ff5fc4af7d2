"""Compiled loops of the paper's solver: Lemma 1's stencil, and Lemma 2 on panels that stay in a core's cache.

Sums may be fused and change their last bit with it; `lodestream.paper` promises 1e-12 of the scale.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .kernels import kernel

__all__ = ["ALPHA", "combine", "solve_columns", "solve_rows"]

Floats = NDArray[np.float64]

#: Reciprocal of the constant pivot: the factors of A'_p have 1/alpha = 3 + 2 sqrt 2 on the diagonal.
ALPHA = 3.0 - 2.0 * math.sqrt(2.0)
#: Root of c^2 + 6 c + 1 = 0 inside the unit circle; the inverse of A_p decays by it from one entry to the next.
_DECAY = -ALPHA
#: Sums around a closed axis stop here: the next power of c is below 1e-36, out of reach of float64.
_CLOSED_TERMS = 48
#: Right-hand sides that are solved together: as many float64 as stay in a core's second cache beside their source.
_PANEL_VALUES = 1 << 15
#: However long the systems are, a panel has four cache lines of columns, or two of rows, which are turned on the way.
_PANEL_COLUMNS = 32
_PANEL_ROWS = 16
#: Columns of systems so long that even such a panel has left the cache are solved where they are.
_PANEL_LARGEST = 1 << 19


@kernel
def combine(
    fine: Floats,
    sides: Floats,
    row_run: int,
    row_midpoints: int,
    rows_wrap: bool,
    column_run: int,
    column_midpoints: int,
    columns_wrap: bool,
) -> None:
    """Lemma 1: one row of nodes after another, its three fine rows first, then three columns of their sum."""
    width, channels = fine.shape[1], fine.shape[2]
    run = column_run if column_midpoints else 0
    length = run + column_midpoints
    row = np.empty(width * channels)
    nothing = np.zeros(width * channels)
    for i in range(sides.shape[0]):
        if i < row_run and row_midpoints:
            above = below = nothing
            if i > 0 or rows_wrap:
                above = fine[2 * i - 1 if i else 2 * row_midpoints - 1].reshape(-1)
            if i < row_midpoints:
                below = fine[2 * i + 1].reshape(-1)
            centre = fine[2 * i].reshape(-1)
            for j in range(row.size):
                row[j] = 4.0 * centre[j] + 2.0 * (above[j] + below[j])
        else:
            row[:] = fine[i + row_midpoints].reshape(-1)
        side = sides[i].reshape(-1)
        for j in range(run * channels, side.size):
            side[j] = row[j + (length - run) * channels]
        for channel in range(channels if run else 0):
            first = 4.0 * row[channel] + 2.0 * row[channels + channel]
            if columns_wrap:
                first += 2.0 * row[(length - 1) * channels + channel]
            side[channel] = first
            for j in range(1, column_midpoints):
                at = 2 * j * channels + channel
                side[j * channels + channel] = 4.0 * row[at] + 2.0 * (row[at - channels] + row[at + channels])
            if run > column_midpoints:
                at = (length - 1) * channels + channel
                side[(run - 1) * channels + channel] = 4.0 * row[at] + 2.0 * row[at - channels]


@kernel
def _solve_panel(panel: Floats, pivots: Floats, terms: int, closed: bool) -> None:
    """Lemma 2 on one panel, in place: both sweeps go from row to row, all right-hand sides of a row at once."""
    size, width = panel.shape
    around = 1.0 - _DECAY**size
    if closed:
        power = 1.0
        for j in range(1, min(size, _CLOSED_TERMS)):
            power *= _DECAY
            for q in range(width):
                panel[0, q] += power * panel[size - j, q]
        for q in range(width):
            panel[0, q] /= around
    for i in range(1, size):
        factor = pivots[i - 1]
        for q in range(width):
            panel[i, q] -= factor * panel[i - 1, q]
    factor = pivots[size - 1]
    if closed:
        power = 1.0
        for j in range(1, min(size, _CLOSED_TERMS)):
            power *= _DECAY
            for q in range(width):
                panel[size - 1, q] += power * panel[j - 1, q]
        factor /= around
    for q in range(width):
        panel[size - 1, q] *= factor
    for i in range(size - 2, -1, -1):
        factor = pivots[i]
        for q in range(width):
            panel[i, q] = factor * (panel[i, q] - panel[i + 1, q])
    if closed or size < terms:
        return
    first = panel[0].copy()
    last = panel[size - 1] * (0.5 + math.sqrt(0.5))
    power = 1.0
    for j in range(terms):
        power *= _DECAY
        for q in range(width):
            panel[j, q] -= power * first[q]
        for q in range(width):
            panel[size - 1 - j, q] -= power * last[q]


@kernel
def solve_columns(values: Floats, pivots: Floats, terms: int, closed: bool) -> None:
    """Systems along axis 0 of an array (p or more, q), in place, a panel of columns at a time."""
    size, total = pivots.size, values.shape[1]
    width = min(total, max(_PANEL_COLUMNS, _PANEL_VALUES // size))
    # A panel that is the whole array, or that no cache would hold, is not worth copying.
    if width == total or size * width > _PANEL_LARGEST:
        _solve_panel(values[:size], pivots, terms, closed)
        return
    scratch = np.empty(size * width)
    for start in range(0, total, width):
        count = min(width, total - start)
        panel = scratch[: size * count].reshape(size, count)
        for i in range(size):
            for q in range(count):
                panel[i, q] = values[i, start + q]
        _solve_panel(panel, pivots, terms, closed)
        for i in range(size):
            for q in range(count):
                values[i, start + q] = panel[i, q]


@kernel
def solve_rows(values: Floats, pivots: Floats, terms: int, closed: bool) -> None:
    """Systems along axis 1 of an array (m, p or more, channels), in place, a panel of turned rows at a time."""
    size, total, channels = pivots.size, values.shape[0], values.shape[2]
    height = max(1, min(total, max(_PANEL_ROWS, _PANEL_VALUES // size) // channels))
    scratch = np.empty(size * height * channels)
    for start in range(0, total, height):
        count = min(height, total - start)
        panel = scratch[: size * count * channels].reshape(size, count * channels)
        # Eight unknowns of a row at a time, a cache line each, are turned while their place in the panel stays near.
        for part in range(0, size, 8):
            for i in range(count):
                for j in range(part, min(part + 8, size)):
                    for channel in range(channels):
                        panel[j, i * channels + channel] = values[start + i, j, channel]
        _solve_panel(panel, pivots, terms, closed)
        for part in range(0, size, 8):
            for i in range(count):
                for j in range(part, min(part + 8, size)):
                    for channel in range(channels):
                        values[start + i, j, channel] = panel[j, i * channels + channel]
