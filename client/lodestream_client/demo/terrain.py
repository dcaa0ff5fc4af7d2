"""The surface of the demo: mountains that rivers have cut, generated on the spot and the same on every run."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

__all__ = ["CELL", "bilinear", "terrain"]

Floats = NDArray[np.float64]

CELL = 30.0  # metres from one point to the next

# Time steps on each grid, the coarsest first; each grid is twice as fine as the one before.
_STEPS = (80, 40, 16, 8, 2)
_SEED = 3
_YEARS = 40_000.0  # of a step on the coarsest grid; half of it on the next
_UPLIFT = 3e-3  # metres a year
_ERODIBILITY = 3e-5
_AREA_EXPONENT = 0.45
_NEIGHBOURS = ((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1))


def terrain(shape: tuple[int, int], progress: Callable[[float], None] = lambda done: None) -> NDArray[np.int16]:
    """Return heights in whole metres on a grid with 30 m between points.

    Mountains rise, rivers cut them by the stream power law (h' = uplift - k area^m slope), slopes creep. Coarse grids
    are computed first and refined, so that a grid of a million points takes few steps.

    Parameters
    ----------
    shape : (rows, columns), both at least 32
    progress : callable
        Called with the share that is done, 0 to 1.

    Returns
    -------
    array (rows, columns) of int16
    """
    rng = np.random.default_rng(_SEED)
    last = len(_STEPS) - 1
    heights = rng.uniform(0.0, 20.0, [(size - 2) // 2**last + 2 for size in shape])
    peaks = rng.uniform((0.15, 0.0, 0.008, 0.3), (0.85, 1.0, 0.05, 1.0), (14, 4))
    work = np.cumsum([steps * 4.0**grid for grid, steps in enumerate(_STEPS)])
    for grid, steps in enumerate(_STEPS):
        cell, years = CELL * 2 ** (last - grid), _YEARS / 2**grid
        if grid:
            heights = _refined(heights, rng) + rng.normal(0.0, 0.12 * cell, (2 * np.array(heights.shape) - 1))
        rise = _UPLIFT * years * _uplift(heights.shape, peaks)
        for step in range(steps):
            heights = _eroded(heights, rise, cell, _ERODIBILITY * years, rng)
            heights = _crept(heights, 0.06 if grid == last else 0.02)
            progress(float((work[grid] - (steps - step - 1) * 4.0**grid) / work[last]))
    return np.rint(heights[: shape[0], : shape[1]]).astype(np.int16)


def bilinear(grid: Floats, rows: Floats, columns: Floats) -> Floats:
    """Return interpolated values of a grid (H, W) at fractional rows and columns within it, which broadcast."""
    i = np.minimum(rows.astype(np.intp), grid.shape[0] - 2)
    j = np.minimum(columns.astype(np.intp), grid.shape[1] - 2)
    down, across = rows - i, columns - j
    upper = (1 - across) * grid[i, j] + across * grid[i, j + 1]
    lower = (1 - across) * grid[i + 1, j] + across * grid[i + 1, j + 1]
    values: Floats = (1 - down) * upper + down * lower
    return values


def _uplift(shape: tuple[int, ...], peaks: Floats) -> Floats:
    # A range that winds from west to east, and peaks beside it.
    y, x = np.linspace(0.0, 1.0, shape[0])[:, None], np.linspace(0.0, 1.0, shape[1])
    crest = 0.48 + 0.16 * np.sin(4 * x + 0.5) + 0.04 * np.sin(15 * x)
    rise = 0.05 + 0.5 * np.exp(-(((y - crest) / 0.28) ** 2))
    for row, column, width, strength in peaks:
        rise += 0.5 * strength * np.exp(-((y - row) ** 2 + 1.5 * (x - column) ** 2) / width)
    return rise


def _refined(heights: Floats, rng: np.random.Generator) -> Floats:
    # Bent a little on the way: rivers follow the eight directions of a grid, which would show.
    rows, columns = heights.shape
    y, x = np.arange(2 * rows - 1)[:, None] / 2, np.arange(2 * columns - 1) / 2
    bent = []
    for place, most in ((y, rows - 1), (x, columns - 1)):
        place = place + np.zeros((2 * rows - 1, 2 * columns - 1))
        for angle, length, phase in rng.uniform((0.0, 8.0, 0.0), (2 * np.pi, 20.0, 2 * np.pi), (6, 3)):
            place += 0.5 * np.sin((np.cos(angle) * y + np.sin(angle) * x) * (2 * np.pi / length) + phase)
        bent.append(place.clip(0.0, most))
    return bilinear(heights, *bent)


def _eroded(heights: Floats, rise: Floats, cell: float, strength: float, rng: np.random.Generator) -> Floats:
    # One implicit step. Sums along rivers take log2(length) passes: each pass doubles how far a point looks.
    receivers, distance = _receivers(heights, rng)
    outlet = receivers == np.arange(heights.size)
    nowhere = heights.size
    area = np.append(np.full(heights.size, cell * cell), 0.0)
    below = np.append(np.where(outlet, nowhere, receivers), nowhere)
    while (below != nowhere).any():
        area += np.bincount(below, area, nowhere + 1)
        area[nowhere] = 0.0
        below = below[below]
    factor = np.where(outlet, 0.0, strength * area[:nowhere] ** _AREA_EXPONENT / (distance * cell))
    raised = heights + rise
    raised[[0, -1]] = heights[[0, -1]]  # base level
    # h = settled + share * h[receiver], with more and more of the way down the river put in place of h[receiver].
    settled, share, below = raised.ravel() / (1 + factor), factor / (1 + factor), receivers
    while share.any():
        settled = settled + share * settled[below]
        share = share * share[below]
        share[share < 1e-9] = 0.0
        below = below[below]
    eroded: Floats = settled.reshape(heights.shape)
    return eroded


def _receivers(heights: Floats, rng: np.random.Generator) -> tuple[NDArray[np.intp], Floats]:
    # The neighbour that each point drains to, flat, and how far it is in cells; itself at outlets and in pits. Slopes
    # are taken with some chance, so that rivers do not all run along the grid.
    rows, columns = heights.shape
    receivers = np.arange(heights.size).reshape(heights.shape)
    steepest, distance = np.zeros_like(heights), np.ones_like(heights)
    padded = np.pad(heights, 1, constant_values=np.inf)
    places = receivers.copy()
    for down, across in _NEIGHBOURS:
        length = float(np.hypot(down, across))
        neighbour = padded[1 + down : 1 + down + rows, 1 + across : 1 + across + columns]
        slope = (heights - neighbour) / length * rng.uniform(0.6, 1.4, heights.shape)
        better = slope > steepest
        steepest[better], distance[better] = slope[better], length
        receivers[better] = (places + down * columns + across)[better]
    receivers[[0, -1]] = places[[0, -1]]
    return receivers.ravel(), distance.ravel()


def _crept(heights: Floats, strength: float) -> Floats:
    p = np.pad(heights, 1, mode="edge")
    crept: Floats = heights + strength * (p[:-2, 1:-1] + p[2:, 1:-1] + p[1:-1, :-2] + p[1:-1, 2:] - 4 * heights)
    return crept
