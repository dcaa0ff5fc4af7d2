"""The third step fitted by the encoder: which (a, b) leaves the details that take the fewest bits."""

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

#: Rules of falling error on smooth surfaces, O(h^4) where a + 3b = 16 and O(h^6) for (22, -2), and none at all.
_CANDIDATES = [(0, 0), FOUR_POINT, (19, -1), (22, -2), (25, -3)]
_SAMPLE_LINES = 96
#: Values in one call of a kernel that fits.
_AT_ONCE = 1 << 22
#: Least details of a sample that threads share.
_SHARED = 1 << 13


class _Sample(NamedTuple):
    """Factors of a and b in v_k, and d_k, of some midpoints: int32, flat; and what no magnitude of the factors exceeds.

    Details with what the third step needs around them: k from 2 to midpoints - 4.
    """

    first: NDArray[np.int32]
    second: NDArray[np.int32]
    details: NDArray[np.int32]
    largest: int

    def batches(self) -> Iterator[tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]]:
        """Factors and details, so many as a kernel takes at once."""
        for start in range(0, self.details.size, _AT_ONCE):
            batch = slice(start, start + _AT_ONCE)
            yield self.first[batch], self.second[batch], self.details[batch]

    def bits(self, a: int, b: int) -> float:
        """About the bits that the details take with (a, b): the sum of log2(1 + |e|)."""
        total = np.zeros(1)
        for batch in self.batches():
            kernels.predictor_bits(*batch, self.largest, a, b, total)
        return float(total[0])

    def moments(self, a: float, b: float, weighted: bool) -> list[float]:
        """Sums of u u, u w, w w, u d and w d, weighted by what (a, b) leaves of the details."""
        sums = np.zeros(5)
        for batch in self.batches():
            kernels.predictor_moments(*batch, a, b, weighted, sums)
        found: list[float] = sums.tolist()
        return found


def fitted_predictor(grids: Sequence[tuple[NDArray[np.int32], AxisStep]]) -> tuple[int, int]:
    """The (a, b) that makes the details along axis 0 of some of the columns smallest, in bits.

    Parameters
    ----------
    grids : sequence of (int32 array of shape (row, column), AxisStep)
        Samples of each grid, and the step along axis 0; one of them at least is long enough to be fitted.
    """
    lines = sum(corner.shape[1] for corner, _ in grids)
    return fitted_to_columns([(corner[:, :: sample_stride(corner.shape[1], lines)], step) for corner, step in grids])


def sample_stride(columns: int, lines: int | None = None) -> int:
    """Every how manieth column of a grid is looked at, the first one among them; all grids have ``lines`` columns."""
    return max(1, min((columns if lines is None else lines) // _SAMPLE_LINES, columns))


def fitted_to_columns(grids: Sequence[tuple[NDArray[np.int32], AxisStep]]) -> tuple[int, int]:
    """`fitted_predictor` of the columns that are looked at, int32, shape (row, column), see `sample_stride`."""
    sample = _sample(grids)
    costs: dict[tuple[int, int], float] = {}

    def best_of(tried: list[tuple[int, int]]) -> tuple[int, int]:
        new = [ab for ab in dict.fromkeys(tried) if ab not in costs]
        if sample.details.size < _SHARED:
            costs.update((ab, sample.bits(*ab)) for ab in new)
        else:
            costs.update(zip(new, spread(lambda ab: sample.bits(*ab), new), strict=True))
        return min(tried, key=costs.__getitem__)

    # Bits are not convex in (a, b), and bumpy from rounding: several starts, then a search in steps that get smaller.
    best = best_of([*_CANDIDATES, *_least_squares(sample)])
    for reach in (4, 2, 1):
        around = [(best[0] + i * reach, best[1] + j * reach) for i, j in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1))]
        best = best_of([ab for ab in around if max(map(abs, ab)) <= 127])
    return best


def _sample(grids: Sequence[tuple[NDArray[np.int32], AxisStep]]) -> _Sample:
    """Columns stepped without the third step."""
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
    count, width = midpoints - 5, lines.shape[1]
    first, second, details = np.empty((3, count * width), np.int32)
    largest, height = 0, max(1, _AT_ONCE // width)
    for start in range(0, count, height):
        stop = min(start + height, count)
        batch = slice(start * width, stop * width)
        planes = lines[start : stop + 5], lines[coarse + 2 + start : coarse + 2 + stop]
        largest = max(largest, kernels.predictor_factors(*planes, first[batch], second[batch], details[batch]))
    return _Sample(first, second, details, largest)


def _least_squares(sample: _Sample) -> list[tuple[int, int]]:
    """Fits of 256 d = a u + b w, residuals reweighted towards small ones in turn."""
    found = []
    a = b = 0.0
    for turn in range(5):
        uu, uw, ww, ud, wd = sample.moments(a, b, turn > 0)
        determinant = uu * ww - uw * uw
        if determinant <= 1e-9 * uu * ww:
            break  # one factor is all but a multiple of the other: nothing tells a from b
        a, b = 256 * (ud * ww - wd * uw) / determinant, 256 * (wd * uu - ud * uw) / determinant
        found.append((max(-127, min(127, round(a))), max(-127, min(127, round(b)))))
    return found
