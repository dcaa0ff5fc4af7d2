"""Which index each coefficient gets: the one that costs least, in squared error and in bits.

What an index costs in bits is not known before everything is coded, so it is estimated: coefficients are put into
classes by the size of what is around them, and the share of each index in its class gives its bits; a few turns
settle both. The indices of a band depend on each other by the trellis: the cheapest of all ways through it is taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .band_fields import (
    COLUMN_SHIFT,
    COLUMNS,
    OFFSET,
    PARENT,
    PARENT_STRIDE,
    ROW_SHIFT,
    ROWS,
    STRIDE,
)
from .bitplanes import BLOCK
from .numba_kernels import kernel
from .quantiser import MOST_BASE, Quantiser
from .tiles import TileTable
from .trellis import ODD, TRANSITIONS

__all__ = ["MOST_TRIES", "IndexChooser", "longest_base"]

#: Squared error that a bit is worth, in squared steps.
_WORTH = 0.05
_CLASSES = 30
_FIRST_CLASS = 8.0  # number of the class whose coefficients are about a step
_INDICES = 16  # the last stands for all that are larger
_TURNS = 2  # of the first choice
#: How many coefficients the Laplace distribution counts for among those that were seen of a class.
_PRIOR = 8.0
#: The search for a base: how often, how close to the error wanted, and by which power steps grow with it.
MOST_TRIES = 10
_CLOSE = 0.997
_ERROR_TO_STEP = 1.2


class IndexChooser:
    """Chooses the indices of one channel.

    Parameters
    ----------
    table : TileTable
    coefficients : int32, flat, see `tiles.gather`
    """

    def __init__(self, table: TileTable, coefficients: NDArray[np.int32]) -> None:
        self._table, self._coefficients = table, coefficients
        self._bits = _laplace()
        self._turns = _TURNS

    def indices(self, quantiser: Quantiser) -> NDArray[np.int32]:
        """The index of every coefficient, flat."""
        table = self._table
        relative = np.zeros(table.size)
        classes = np.zeros(table.size, np.int8)
        _divide(table.bands, table.steps(quantiser), self._coefficients, relative)
        _classify(table.bands, relative, classes)
        chosen = np.zeros(table.size, np.int32)
        for _ in range(self._turns):
            counts = _PRIOR * np.exp2(-_laplace())
            for band in table.bands:
                _choose(band, relative, classes, self._bits, _WORTH, chosen, counts)
            self._bits = -np.log2(counts / counts.sum(axis=2, keepdims=True))
        self._turns = 1  # what was learned of one choice serves the next one, with other steps, too
        return chosen


def _laplace() -> NDArray[np.float64]:
    """Bits of each index (without its sign) by class, of coefficients with a Laplace distribution.

    float64, shape (quantiser, class, index).
    """
    found = np.empty((2, _CLASSES, _INDICES))
    for odd in range(2):
        for number in range(_CLASSES):
            scale = 2.0 ** ((number - _FIRST_CLASS + 0.5) / 2) + 0.01
            places = np.arange(_INDICES) - 0.5 * odd * (np.arange(_INDICES) > 0)
            borders = np.append((places[1:] + places[:-1]) / 2, np.inf)
            beyond = np.exp(-np.append(0.0, borders) / scale)
            found[odd, number] = -np.log2(np.maximum(beyond[:-1] - beyond[1:], 1e-7))
    return found


@kernel
def _divide(
    bands: NDArray[np.int64], steps: NDArray[np.int64], coefficients: NDArray[np.int32], relative: NDArray[np.float64]
) -> None:
    for band in range(bands.shape[0]):
        scale = 1.0 / steps[band]
        for i in range(bands[band, ROWS]):
            for j in range(bands[band, COLUMNS]):
                at = bands[band, OFFSET] + i * bands[band, STRIDE] + j
                relative[at] = coefficients[at] * scale


@kernel
def _classify(bands: NDArray[np.int64], relative: NDArray[np.float64], classes: NDArray[np.int8]) -> None:
    """Class of each coefficient by its eight neighbours and its parent: half octaves."""
    for band in range(bands.shape[0]):
        stride, parent, parent_stride = bands[band, STRIDE], bands[band, PARENT], bands[band, PARENT_STRIDE]
        row_shift, column_shift = bands[band, ROW_SHIFT], bands[band, COLUMN_SHIFT]
        for i in range(bands[band, ROWS]):
            for j in range(bands[band, COLUMNS]):
                at = bands[band, OFFSET] + i * stride + j
                near = (
                    abs(relative[at - 1])
                    + abs(relative[at + 1])
                    + abs(relative[at - stride])
                    + abs(relative[at + stride])
                )
                corners = (
                    abs(relative[at - stride - 1])
                    + abs(relative[at - stride + 1])
                    + abs(relative[at + stride - 1])
                    + abs(relative[at + stride + 1])
                )
                above = abs(relative[parent + (i >> row_shift) * parent_stride + (j >> column_shift)])
                size = (2.0 * near + corners + 2.0 * above) / 14.0
                number = int(np.floor(2.0 * np.log2(size + 1e-3) + _FIRST_CLASS))
                classes[at] = min(max(number, 0), _CLASSES - 1)


@kernel
def _choose(
    band: NDArray[np.int64],
    relative: NDArray[np.float64],
    classes: NDArray[np.int8],
    bits: NDArray[np.float64],
    worth: float,
    chosen: NDArray[np.int32],
    counts: NDArray[np.float64],
) -> None:
    """The cheapest indices of a band in the order of its blocks, from state 0 on (Viterbi's algorithm).

    ``counts``, of the shape of ``bits``, are increased by what was chosen.
    """
    offset, stride, rows, columns = band[OFFSET], band[STRIDE], band[ROWS], band[COLUMNS]
    states, length = ODD.size, rows * columns
    places = np.empty(length, np.int64)
    before = np.zeros((length, states), np.int8)
    index = np.zeros((length, states), np.int32)
    cost, new = np.full(states, np.inf), np.empty(states)
    cost[0] = 0.0
    number = 0
    for top in range(0, rows, BLOCK):
        for left in range(0, columns, BLOCK):
            for i in range(top, min(top + BLOCK, rows)):
                for j in range(left, min(left + BLOCK, columns)):
                    at = offset + i * stride + j
                    places[number] = at
                    size, group = abs(relative[at]), int(classes[at])
                    new[:] = np.inf
                    for state in range(states):
                        if cost[state] == np.inf:
                            continue
                        half = 0.5 * ODD[state]
                        least = int(size + half)
                        for candidate in range(3):
                            # The nearest below, the nearest above, and none.
                            k = 0 if candidate == 2 else least + candidate
                            if candidate == 2 and least == 0:
                                continue
                            error = size - (k - half if k else 0.0)
                            rate = bits[ODD[state], group, min(k, _INDICES - 1)]
                            if k:
                                rate += 1.0  # the sign
                            if k >= _INDICES - 1:
                                rate += 2.0 * np.log2(k - _INDICES + 3.0)
                            total = cost[state] + error * error + worth * rate
                            after = TRANSITIONS[state, k & 1]
                            if total < new[after]:
                                new[after], before[number, after], index[number, after] = total, state, k
                    cost[:] = new
                    number += 1
    state = int(np.argmin(cost))
    for number in range(length - 1, -1, -1):
        k, at = index[number, state], places[number]
        state = before[number, state]
        chosen[at] = k if relative[at] >= 0 else -k
        counts[ODD[state], int(classes[at]), min(k, _INDICES - 1)] += 1.0


def longest_base(error_of: Callable[[int], float], wanted: float, guess: int) -> int | None:
    """The largest base of a quantiser found whose error is at most the one wanted, and close to it; None: none was.

    Parameters
    ----------
    error_of : callable
        The error with a base; it rises with the base, but for chance.
    guess : int
        Tried first.
    """
    below, above = 0, MOST_BASE + 1
    aim = (1.0 + _CLOSE) / 2 * wanted
    known: list[tuple[float, float]] = []  # logarithms of error over aim and of base, nearest to the aim first
    base = guess
    for _ in range(MOST_TRIES):
        error = error_of(base)
        if error <= wanted:
            below = max(below, base)
        else:
            above = min(above, base)
        if _CLOSE * wanted <= error <= wanted:
            break
        known.append((math.log(max(error, 1e-300) / aim), math.log(base)))
        known.sort(key=lambda point: abs(point[0]))
        (near, at), (far, further) = known[0], known[min(1, len(known) - 1)]
        slope = (further - at) / (far - near) if far != near else _ERROR_TO_STEP
        base = round(math.exp(min(max(at - near * min(max(slope, 0.5), 4.0), at - 1.4), at + 1.4)))
        if not below < base < above:  # by chance: the error does not rise everywhere
            base = round(1.3 * below) if above > MOST_BASE else round(math.sqrt(max(below, 1) * above))
        if not below < base < above:
            break
    return below or None
