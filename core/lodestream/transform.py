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
    "allocate",
    "forward",
    "inverse",
    "synthesis_norms",
]

#: Rules of falling error on smooth surfaces, O(h^4) where a + 3b = 16 and O(h^6) for (22, -2), and none at all.
_CANDIDATES = [(0, 0), FOUR_POINT, (19, -1), (22, -2), (25, -3)]
_SAMPLE_LINES = 96
_NORM_LEVELS = 6


def allocate(shape: tuple[int, int]) -> NDArray[np.int32]:
    """An int32 array for a channel's coefficients.

    It is a window of a slightly wider one: rows then never lie a power of two apart, where a column's samples would
    compete for the same lines of the cache.
    """
    rows, columns = shape
    return np.zeros((rows, columns + 24), np.int32)[:, :columns]


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
    nodes = sample[: step.run].astype(np.float64)
    details = sample[step.coarse :].astype(np.float64)
    last = step.midpoints - 3
    inner = details[2:last]
    outer = [nodes[2 + shift : last + shift] for shift in range(-2, 4)]  # c_{k-2} ... c_{k+3}
    near = outer[2] + outer[3]
    first, second = near - outer[1] - outer[4], near - outer[0] - outer[5]

    def bits(ab: tuple[int, int]) -> float:
        return _bits(inner - np.floor((ab[0] * first + ab[1] * second + 128) / 256))

    best = min([*_CANDIDATES, *_least_squares(first, second, inner)], key=bits)
    for reach in (4, 2, 1):
        around = [(best[0] + i * reach, best[1] + j * reach) for i, j in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))]
        best = min((ab for ab in around if max(map(abs, ab)) <= 127), key=bits)
    return best


def _least_squares(
    first: NDArray[np.float64], second: NDArray[np.float64], details: NDArray[np.float64]
) -> list[tuple[int, int]]:
    """Fits of 256 d = a u + b w, residuals reweighted towards small ones in turn."""
    weights = np.ones_like(details)
    found = []
    for _ in range(5):
        uu, uw, ww = (float((weights * p).sum()) for p in (first * first, first * second, second * second))
        ud, wd = (256 * float((weights * p * details).sum()) for p in (first, second))
        determinant = uu * ww - uw * uw
        if determinant <= 1e-9 * uu * ww:
            break
        a, b = (ud * ww - wd * uw) / determinant, (wd * uu - ud * uw) / determinant
        found.append((int(np.clip(round(a), -127, 127)), int(np.clip(round(b), -127, 127))))
        weights = 1.0 / (1.0 + np.abs(details - (a * first + b * second) / 256))
    return found


def _bits(details: NDArray[np.float64]) -> float:
    """About the bits that details take."""
    return float(np.log2(1.0 + np.abs(details)).sum())


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
