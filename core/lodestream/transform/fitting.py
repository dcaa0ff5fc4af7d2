"""Fitting the third step in the encoder: the (a, b) whose details take the fewest bits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from ..grid.axis import AxisStep
from ..parallel import spread
from .lifting import forward_step
from .predictors import FIT_NODES, FOUR_POINT

__all__ = ["fitted_predictor", "fitted_to_columns", "sample_stride"]

#: Starts of the search: (0, 0), and rules with an error of O(h^4) on smooth surfaces, where a + 3b = 16, or O(h^6).
_START_PREDICTORS = [(0, 0), FOUR_POINT, (19, -1), (22, -2), (25, -3)]
_MAX_SAMPLE_LINES = 96
#: Values in one call of a kernel of the fit.
_VALUES_PER_CALL = 1 << 22
#: Threads share the work for samples of at least so many details.
_MIN_DETAILS_FOR_THREADS = 1 << 13


class _Sample(NamedTuple):
    """Factors of a and b in v_k, and d_k, of some midpoints: int32, flat; and what no magnitude of the factors exceeds.

    Details with what the third step needs around them: k from 2 to midpoints - 4.
    """

    first: NDArray[np.int32]
    second: NDArray[np.int32]
    details: NDArray[np.int32]
    largest: int

    def batches(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]]:
        """Yield factors and details in batches of the size of a kernel's call, each int32, shape (value,)."""
        for start in range(0, self.details.size, _VALUES_PER_CALL):
            batch = slice(start, start + _VALUES_PER_CALL)
            yield self.first[batch], self.second[batch], self.details[batch]

    def bits(self, a: int, b: int) -> float:
        """Estimate the bits that the details take with (a, b): the sum of log2(1 + |e|)."""
        total = np.zeros(1)
        for batch in self.batches():
            kernels.predictor_bits(*batch, self.largest, a, b, total)
        return float(total[0])

    def moments(self, a: float, b: float, weighted: bool) -> list[float]:
        """Return the sums of u u, u w, w w, u d and w d, weighted by the details that (a, b) leaves."""
        sums = np.zeros(5)
        for batch in self.batches():
            kernels.predictor_moments(*batch, a, b, weighted, sums)
        moments: list[float] = sums.tolist()
        return moments


def fitted_predictor(grids: Sequence[tuple[NDArray[np.int32], AxisStep]], search: bool = True) -> tuple[int, int]:
    """Return the (a, b) with which the details along axis 0 of a sample of the columns take the fewest bits.

    Parameters
    ----------
    grids : sequence of (int32 array of shape (row, column), AxisStep)
        Samples of each grid, and the step along axis 0; one of them at least is long enough to be fitted.
    search : bool
        Not only among a few fixed ones.
    """
    lines = sum(corner.shape[1] for corner, _ in grids)
    sampled = [(corner[:, :: sample_stride(corner.shape[1], lines)], step) for corner, step in grids]
    return fitted_to_columns(sampled, search)


def sample_stride(columns: int, lines: int | None = None) -> int:
    """Return the stride between the columns of a grid that are sampled; sampling begins at column 0.

    ``lines`` is the number of columns of all grids together, by default ``columns``.
    """
    return max(1, min((columns if lines is None else lines) // _MAX_SAMPLE_LINES, columns))


def fitted_to_columns(grids: Sequence[tuple[NDArray[np.int32], AxisStep]], search: bool) -> tuple[int, int]:
    """Do what `fitted_predictor` does, given the sampled columns, int32, shape (row, column), see `sample_stride`."""
    sample = _sample(grids)
    costs: dict[tuple[int, int], float] = {}

    def best_of(tried: list[tuple[int, int]]) -> tuple[int, int]:
        """Return the (a, b) of fewest bits, counting each only once."""
        new = [ab for ab in dict.fromkeys(tried) if ab not in costs]
        if sample.details.size < _MIN_DETAILS_FOR_THREADS:
            costs.update((ab, sample.bits(*ab)) for ab in new)
        else:
            costs.update(zip(new, spread(lambda ab: sample.bits(*ab), new), strict=True))
        return min(tried, key=costs.__getitem__)

    if not search:
        return best_of(_START_PREDICTORS)
    # Bits are not convex in (a, b), and bumpy from rounding: several starts, then a search in steps that get smaller.
    best = best_of([*_START_PREDICTORS, *_least_squares(sample)])
    for reach in (4, 2, 1):
        around = [(best[0] + i * reach, best[1] + j * reach) for i, j in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))]
        best = best_of([ab for ab in around if max(map(abs, ab)) <= 127])
    return best


def _sample(grids: Sequence[tuple[NDArray[np.int32], AxisStep]]) -> _Sample:
    """Step the columns without the third step, and collect details and factors."""
    samples = []
    for chosen, step in grids:
        if step.midpoints and step.run >= FIT_NODES:
            columns = np.array(chosen, order="C")
            forward_step(columns, 0, step, (0, 0))
            samples.append(_surroundings(columns, step.coarse, step.midpoints))
    if len(samples) == 1:
        return samples[0]
    first, second, details = (np.concatenate([sample[i] for sample in samples]) for i in range(3))
    return _Sample(first, second, details, max(sample.largest for sample in samples))


def _surroundings(lines: NDArray[np.int32], coarse: int, midpoints: int) -> _Sample:
    """Collect details and factors of lines that were stepped, shape (sample, line), by runs of midpoints."""
    count, width = midpoints - 5, lines.shape[1]
    first, second, details = np.empty((3, count * width), np.int32)
    largest, height = 0, max(1, _VALUES_PER_CALL // width)
    for start in range(0, count, height):
        stop = min(start + height, count)
        batch = slice(start * width, stop * width)
        planes = lines[start : stop + 5], lines[coarse + 2 + start : coarse + 2 + stop]
        largest = max(largest, kernels.predictor_factors(*planes, first[batch], second[batch], details[batch]))
    return _Sample(first, second, details, largest)


def _least_squares(sample: _Sample) -> list[tuple[int, int]]:
    """Fit 256 d = a u + b w by least squares, iteratively reweighted towards small residuals."""
    fits = []
    a = b = 0.0
    for turn in range(5):
        uu, uw, ww, ud, wd = sample.moments(a, b, turn > 0)
        determinant = uu * ww - uw * uw
        if determinant <= 1e-9 * uu * ww:
            break  # the factors are nearly proportional, so the fit of a and b is ill-conditioned
        a, b = 256 * (ud * ww - wd * uw) / determinant, 256 * (wd * uu - ud * uw) / determinant
        fits.append((max(-127, min(127, round(a))), max(-127, min(127, round(b)))))
    return fits
