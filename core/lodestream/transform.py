"""The whole hierarchy of one channel in integers: all levels, in place, with the third step fitted by the encoder.

A channel has an array for each grid of the layout, see `lodestream.layout`. A part whose side comes from a curve holds
that side's points at every level: level 0 copies them, and the details along the side that the inverse needs are made
by a forward step of the curve's points. Curves are therefore stepped first.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .axis import AxisStep
from .layout import Layout, Source
from .lifting import CLAMP, FRACTION_BITS, REACH, TAPS, forward_step, inverse_step
from .numba_kernels import kernel
from .predictors import CURVES, FIT_NODES, FOUR_POINT, default_predictors, fitted_steps, predictor

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


def forward(arrays: Sequence[NDArray[np.int32]], layout: Layout, fit: bool = True) -> NDArray[np.int8]:
    """Turn a channel's lattice coordinates into its coefficients, in place.

    Parameters
    ----------
    arrays : int32, shape (row, column), from `allocate`, one for each grid
        Magnitudes of at most 2**24. Sides that come from curves hold the same points as these.
    layout : Layout
    fit : bool
        Choose the third step's (a, b) by size for each level and axis that is long enough; otherwise (0, 0) there.

    Returns
    -------
    int8, shape (level, axis, 2)
        (a, b) of the step from ``level + 1`` to ``level`` along axis 0 and 1 of the parts, and of the curves.
    """
    predictors = default_predictors(layout)
    fitted = set(fitted_steps(layout))
    for level in range(layout.levels, 0, -1):
        for axis in range(2):
            corners = [_corner(array, layout.shape(k, level)) for k, array in enumerate(arrays)]
            for which in (axis, CURVES) if axis == 0 else (axis,):
                if fit and (level - 1, which) in fitted:
                    lines = [
                        (corner if axis == 0 else corner.T, layout.steps(k, level)[axis])
                        for k, corner in enumerate(corners)
                        if layout.grids[k].curve == (which == CURVES)
                    ]
                    predictors[level - 1, which] = _fit(lines)
            for k, grid in enumerate(layout.grids):
                step = layout.steps(k, level)[axis]
                if step.midpoints:
                    forward_step(corners[k], axis, step, predictor(predictors, grid, step, level, axis))
    return predictors


def _corner(array: NDArray[np.int32], shape: tuple[int, int]) -> NDArray[np.int32]:
    return array[: shape[0], : shape[1]]


def inverse(
    arrays: Sequence[NDArray[np.int32]],
    layout: Layout,
    predictors: NDArray[np.int8],
    level: int,
    whole: int | None = None,
    coordinate: bool = True,
) -> None:
    """Turn coefficients into the grids of ``level``, in place, in the first rows and columns of the arrays.

    Without ``whole``, the forward transform is undone exactly. Otherwise details of the levels up to ``whole`` count
    lattice steps, those above count steps over 2**`FRACTION_BITS`; so does the result where ``whole`` is less than
    ``level``.
    Where all details are known, rounding to whole steps undoes that of the forward transform; where they are not, it
    would only add errors of its own from level to level.

    Of a channel that is no ``coordinate`` no side comes from a curve, and curves mean nothing.
    """
    takes = coordinate and layout.shared
    numbers = [k for k, grid in enumerate(layout.grids) if coordinate or not grid.curve]
    if takes:
        _take_nodes(arrays, layout)
    for finer in range(1, level + 1):
        for k in numbers:
            if whole is not None and finer == whole + 1:
                corner = _corner(arrays[k], layout.shape(k, whole))
                np.clip(corner, -(CLAMP >> FRACTION_BITS), CLAMP >> FRACTION_BITS, out=corner)
                corner <<= FRACTION_BITS
            grid, steps = layout.grids[k], layout.steps(k, finer)
            corner = _corner(arrays[k], layout.shape(k, finer))
            if takes and not grid.curve:
                _take_details(arrays, layout, predictors, k, finer)
            for axis in (1, 0):
                if steps[axis].midpoints:
                    inverse_step(corner, axis, steps[axis], predictor(predictors, grid, steps[axis], finer, axis))


def _take_nodes(arrays: Sequence[NDArray[np.int32]], layout: Layout) -> None:
    """Level 0 of what comes from curves: their common ends first, then the sides of parts."""
    for k, grid in enumerate(layout.grids):
        rows, columns = layout.shape(k, 0)
        for side, source in enumerate(grid.sources):
            if source is None:
                continue
            if grid.curve:
                last = layout.shape(source.grid, 0)[0] - 1
                arrays[k][0 if side == 0 else rows - 1, 0] = arrays[source.grid][last if source.reversed else 0, 0]
            else:
                place = (0, rows - 1, 0, columns - 1)[side]
                line = arrays[k][place, :columns] if side < 2 else arrays[k][:rows, place]
                line[:] = _points(arrays, layout, source, 0)


def _points(arrays: Sequence[NDArray[np.int32]], layout: Layout, source: Source, level: int) -> NDArray[np.int32]:
    """Points of a curve at a level, in the order of the side that takes them."""
    points = arrays[source.grid][: layout.shape(source.grid, level)[0], 0]
    return points[::-1] if source.reversed else points


def _take_details(
    arrays: Sequence[NDArray[np.int32]], layout: Layout, predictors: NDArray[np.int8], part: int, level: int
) -> None:
    """The details along a part's sides that come from curves."""
    grid, steps = layout.grids[part], layout.steps(part, level)
    rows, columns = (step.coarse for step in steps)
    for side, source in enumerate(grid.sources):
        axis = 1 if side < 2 else 0
        step = steps[axis]
        if source is None or not step.midpoints:
            continue
        place = (0, rows - 1, 0, columns - 1)[side]
        target = arrays[part][place, : step.length] if side < 2 else arrays[part][: step.length, place]
        points = _points(arrays, layout, source, level)
        if points.size == 1:
            target[step.coarse :] = 0  # a pole
            continue
        line = points.reshape(1, -1).copy()
        forward_step(line, 1, step, predictor(predictors, grid, step, level, axis))
        target[step.coarse :] = line[0, step.coarse :]


def _fit(grids: Sequence[tuple[NDArray[np.int32], AxisStep]]) -> tuple[int, int]:
    """The (a, b) that makes the details along axis 0 of some of the columns smallest, in bits."""
    lines = sum(corner.shape[1] for corner, _ in grids)
    samples = []
    for corner, step in grids:
        if step.midpoints and step.run >= FIT_NODES:
            stride = max(1, min(lines // _SAMPLE_LINES, corner.shape[1]))
            sample = np.array(corner[:, ::stride], order="C")
            forward_step(sample, 0, step, (0, 0))
            samples.append(_surroundings(sample, step.coarse, step.midpoints))
    first, second, details = samples[0]
    if len(samples) > 1:
        first, second, details = (np.concatenate([s[i].ravel() for s in samples])[:, None] for i in range(3))
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


def synthesis_norms(layout: Layout, predictors: NDArray[np.int8], number: int = 0) -> NDArray[np.float64]:
    """Squared norms of what one unit of a coefficient of a grid adds to the surface, in the middle of the grid.

    What a curve adds reaches into the parts beside it, as their nodes do.

    Returns
    -------
    float64, shape (level, 2, 2)
        By level of the band and its kind along either axis (node, detail); at level 0 only [0, 0, 0] has a meaning.
    """
    lines = _line_norms(layout, predictors, number)
    norms: NDArray[np.float64] = lines[0][:, :, None] * lines[1][:, None, :]
    if layout.grids[number].curve:
        for part, grid in enumerate(layout.grids):
            for side, source in enumerate(grid.sources):
                if source is not None and source.grid == number and not grid.curve:
                    across, points = side // 2, grid.shape[1 - side // 2] if layout.grids[number].shape[0] == 1 else 1
                    return norms * points * _line_norms(layout, predictors, part)[across, :, 0][:, None, None]
    return norms


def _line_norms(layout: Layout, predictors: NDArray[np.int8], number: int) -> NDArray[np.float64]:
    """Squared norms along each axis of a grid: float64, shape (axis, level, node or detail)."""
    lines = np.ones((2, layout.levels + 1, 2))
    for axis in range(2):
        stepping = []
        for level in range(1, layout.levels + 1):
            step = layout.steps(number, level)[axis]
            if step.midpoints:
                stepping.append((level, *predictor(predictors, layout.grids[number], step, level, axis)))
        for level in range(layout.levels + 1):
            above = tuple(step for step in stepping if step[0] >= level)
            lines[axis, level] = [_line_norm(above, max(level, 1), kind) for kind in (0, 1)]
    return lines


@lru_cache(maxsize=4096)
def _line_norm(stepping: tuple[tuple[int, int, int], ...], first: int, kind: int) -> float:
    """Squared norm along one axis of a node (kind 0) or detail (kind 1) of a band of level ``first``.

    ``stepping``: level and (a, b) of the steps from this level on.
    """
    if not stepping:
        return 1.0
    length, line = 16, np.zeros(16)
    is_node = kind == 0 or stepping[0][0] != first
    for count, (_, a, b) in enumerate(stepping[:_NORM_LEVELS]):
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
