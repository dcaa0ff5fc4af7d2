"""The whole hierarchy of one channel in integers: all levels, in place, with the third step fitted by the encoder."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .axis import AxisStep
from .kernels import kernel
from .layout import Layout
from .lifting import CLAMP, REACH, TAPS, forward_step, inverse_step
from .predictors import FOUR_POINT, default_predictors, fitted_steps

__all__ = [
    "PADDING",
    "allocate",
    "forward",
    "inverse",
    "synthesis_norms",
]

#: Rules of falling error on smooth surfaces, O(h^4) where a + 3b = 16 and O(h^6) for (22, -2), and none at all.
_CANDIDATES = [(0, 0), FOUR_POINT, (19, -1), (22, -2), (25, -3)]
#: Unused columns at the end of an array of coefficients, see `allocate`.
PADDING = 24
_SAMPLE_LINES = 96
_NORM_LEVELS = 6


def allocate(shape: tuple[int, int]) -> NDArray[np.int32]:
    """An int32 array for a channel's coefficients.

    It is a window of a slightly wider one: rows then never lie a power of two apart, where a column's samples would
    compete for the same lines of the cache.
    """
    rows, columns = shape
    return np.zeros((rows, columns + PADDING), np.int32)[:, :columns]


def forward(values: NDArray[np.int32], layout: Layout, fit: bool = True) -> NDArray[np.int8]:
    """Turn a channel's lattice coordinates into its coefficients, in place.

    Parameters
    ----------
    values : int32, shape (row, column), from `allocate`
        Magnitudes of at most 2**24.
    layout : Layout
    fit : bool
        Choose the third step's (a, b) by size for each level and axis that is long enough; otherwise (0, 0) there.

    Returns
    -------
    int8, shape (level, axis, 2)
        (a, b) of the step from ``level + 1`` to ``level``.
    """
    predictors = default_predictors(layout)
    fitted = set(fitted_steps(layout))
    for level in range(layout.levels, 0, -1):
        rows, columns = layout.shapes[level]
        corner = values[:rows, :columns]
        for axis, step in enumerate(layout.steps(level)):
            if not step.midpoints:
                continue
            if fit and (level - 1, axis) in fitted:
                predictors[level - 1, axis] = _fit(corner if axis == 0 else corner.T, step)
            a, b = (int(x) for x in predictors[level - 1, axis])
            forward_step(corner, axis, step, (a, b))
    return predictors


def inverse(
    coefficients: NDArray[np.int32],
    layout: Layout,
    predictors: NDArray[np.int8],
    level: int,
    whole: int | None = None,
    fraction: int = 0,
) -> None:
    """Turn coefficients into the grid of ``level``, in place, in the first rows and columns of the array.

    Without ``whole``, the forward transform is undone exactly. Otherwise details of the levels up to ``whole`` count
    lattice steps, those above count steps over 2**fraction; so does the result where ``whole`` is less than ``level``.
    Where all details are known, rounding to whole steps undoes that of the forward transform; where they are not, it
    would only add errors of its own from level to level.
    """
    for finer in range(1, level + 1):
        if whole is not None and finer == whole + 1:
            rows, columns = layout.shapes[whole]
            grid = coefficients[:rows, :columns]
            np.clip(grid, -(CLAMP >> fraction), CLAMP >> fraction, out=grid)
            grid <<= fraction
        rows, columns = layout.shapes[finer]
        corner = coefficients[:rows, :columns]
        steps = layout.steps(finer)
        for axis in (1, 0):
            a, b = (int(x) for x in predictors[finer - 1, axis])
            inverse_step(corner, axis, steps[axis], (a, b))


def _fit(lines: NDArray[np.int32], step: AxisStep) -> tuple[int, int]:
    """The (a, b) that makes the details along axis 0 of some of the columns smallest, in bits."""
    stride = max(1, lines.shape[1] // _SAMPLE_LINES)
    sample = np.array(lines[:, ::stride], order="C")
    forward_step(sample, 0, step, (0, 0))
    first, second, details = _surroundings(sample, step.coarse, step.midpoints)
    costs: dict[tuple[int, int], float] = {}

    def bits(ab: tuple[int, int]) -> float:
        if ab not in costs:
            costs[ab] = _bits(first, second, details, *ab)
        return costs[ab]

    best = min([*_CANDIDATES, *_least_squares(first, second, details)], key=bits)
    for reach in (4, 2, 1):
        around = [(best[0] + i * reach, best[1] + j * reach) for i, j in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))]
        best = min((ab for ab in around if max(map(abs, ab)) <= 127), key=bits)
    return best


@kernel
def _surroundings(
    sample: NDArray[np.int32], coarse: int, midpoints: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Factors of a and b in v_k, and d_k, for the inner midpoints k: 2 ... midpoints - 4."""
    shape = midpoints - 5, sample.shape[1]
    first, second, details = np.empty(shape), np.empty(shape), np.empty(shape)
    for k in range(shape[0]):
        for j in range(shape[1]):
            near = np.float64(sample[k + 2, j]) + np.float64(sample[k + 3, j])
            first[k, j] = near - sample[k + 1, j] - sample[k + 4, j]
            second[k, j] = near - sample[k, j] - sample[k + 5, j]
            details[k, j] = sample[coarse + k + 2, j]
    return first, second, details


def _least_squares(
    first: NDArray[np.float64], second: NDArray[np.float64], details: NDArray[np.float64]
) -> list[tuple[int, int]]:
    """Fits of 256 d = a u + b w, residuals reweighted towards small ones in turn."""
    found = []
    a = b = 0.0
    for turn in range(5):
        uu, uw, ww, ud, wd = _moments(first, second, details, a, b, turn > 0)
        determinant = uu * ww - uw * uw
        if determinant <= 1e-9 * uu * ww:
            break
        a, b = 256 * (ud * ww - wd * uw) / determinant, 256 * (wd * uu - ud * uw) / determinant
        found.append((max(-127, min(127, round(a))), max(-127, min(127, round(b)))))
    return found


@kernel
def _moments(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    details: NDArray[np.float64],
    a: float,
    b: float,
    weighted: bool,
) -> tuple[float, float, float, float, float]:
    """Sums of u u, u w, w w, u d and w d, weighted by what (a, b) leaves of the details; good to 1e-12."""
    rows, columns = details.shape
    sums = np.zeros((5, columns))
    weight = 1.0
    for i in range(rows):
        for j in range(columns):
            u, w, d = first[i, j], second[i, j], details[i, j]
            if weighted:
                weight = 1.0 / (1.0 + abs(d - (a * u + b * w) * 0.00390625))
            sums[0, j] += weight * u * u
            sums[1, j] += weight * u * w
            sums[2, j] += weight * w * w
            sums[3, j] += weight * u * d
            sums[4, j] += weight * w * d
    return sums[0].sum(), sums[1].sum(), sums[2].sum(), sums[3].sum(), sums[4].sum()


@kernel
def _bits(
    first: NDArray[np.float64], second: NDArray[np.float64], details: NDArray[np.float64], a: float, b: float
) -> float:
    """About the bits that the details take with (a, b): the sum of log2(1 + |e|), good to 1e-12."""
    rows, columns = details.shape
    products = np.empty(columns)
    total = 0.0
    for start in range(0, rows, 16):
        # Sixteen factors of less than 2**37 each are far from overflow: one logarithm does for all of them.
        products[:] = 1.0
        for i in range(start, min(start + 16, rows)):
            for j in range(columns):
                e = details[i, j] - np.floor((a * first[i, j] + b * second[i, j] + 128.0) * 0.00390625)
                products[j] *= 1.0 + abs(e)
        for j in range(columns):
            total += np.log2(products[j])
    return total


def synthesis_norms(layout: Layout, predictors: NDArray[np.int8]) -> NDArray[np.float64]:
    """Squared norms of what one unit of a coefficient adds to the surface, in its middle.

    Returns
    -------
    float64, shape (level, 2, 2)
        By level of the band and its kind along either axis (node, detail); at level 0 only [0, 0, 0] has a meaning.
    """
    lines = np.ones((2, layout.levels + 1, 2))
    for axis in range(2):
        for level in range(layout.levels + 1):
            lines[axis, level] = [_line_norm(layout, predictors, axis, level, kind) for kind in (0, 1)]
    norms: NDArray[np.float64] = lines[0][:, :, None] * lines[1][:, None, :]
    return norms


def _line_norm(layout: Layout, predictors: NDArray[np.int8], axis: int, level: int, kind: int) -> float:
    """Squared norm along one axis of a node (kind 0) or detail (kind 1) of a band of this level."""
    first = max(level, 1)
    stepping = [m for m in range(first, layout.levels + 1) if layout.steps(m)[axis].midpoints]
    if not stepping:
        return 1.0
    length, line = 16, np.zeros(16)
    is_node = kind == 0 or stepping[0] != first
    for count, m in enumerate(stepping[:_NORM_LEVELS]):
        a, b = (int(x) for x in predictors[m - 1, axis])
        details = np.zeros(length)
        if count == 0:
            (line if is_node else details)[length // 2] = 1.0
        line = _synthesis_line(line, details, a, b)
        length = line.size
    return float((line * line).sum()) * 2.0 ** max(0, len(stepping) - _NORM_LEVELS)


@kernel
def _synthesis_line(nodes: NDArray[np.float64], surplus: NDArray[np.float64], a: int, b: int) -> NDArray[np.float64]:
    """One inverse step of a closed line without rounding."""
    n = nodes.size
    details = np.empty(n)
    for k in range(n):
        near = nodes[k] + nodes[(k + 1) % n]
        v = a * (near - nodes[(k + 2) % n] - nodes[k - 1]) + b * (near - nodes[(k + 3) % n] - nodes[k - 2])
        details[k] = surplus[k] + v / 256.0
    line = np.empty(2 * n)
    for k in range(n):
        total = 0.0
        for j in range(REACH):
            total += TAPS[j] * (details[(k + j) % n] + details[k - 1 - j])
        line[2 * k] = nodes[k] - total / 2.0**24
    for k in range(n):
        line[2 * k + 1] = details[k] + (line[2 * k] + line[(2 * k + 2) % (2 * n)]) / 2.0
    return line
