"""Which index each coefficient gets: the one that costs least, in squared error and in bits.

What an index costs in bits is not known before everything is coded, so it is estimated: coefficients are put into
classes by the size of what is around them, and the share of each index in its class gives its bits; a few turns
settle both. With a trellis the indices of a band depend on each other, and the cheapest of all ways through it is
found by the Viterbi algorithm.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from .bitplanes import BLOCK
from .kernels import kernel
from .quantiser import MOST_BASE, ODD, TRANSITIONS, Quantiser
from .tiles import TileTable

__all__ = ["Chooser", "longest_base"]

#: Squared error that a bit is worth, in squared steps: without a trellis, and with one.
_WORTH = (0.08, 0.045)
_CLASSES = 30
_FIRST_CLASS = 8.0  # number of the class whose coefficients are about a step
_INDICES = 16  # the last stands for all that are larger
_TURNS = 2
#: How many coefficients the Laplace distribution counts for among those that were seen of a class.
_PRIOR = 8.0
#: The search for a base: how often, how close to the error wanted, and by which power steps grow with it.
_TRIES = 8
_CLOSE = 0.997
_ERROR_TO_STEP = 1.2


class Chooser:
    """Chooses the indices of one channel.

    Parameters
    ----------
    table : TileTable
    coefficients : int32, flat, see `tiles.gather`
    """

    def __init__(self, table: TileTable, coefficients: NDArray[np.int32]) -> None:
        self._table, self._coefficients = table, coefficients
        self._bits = {trellis: _laplace(trellis) for trellis in (False, True)}

    def indices(self, quantiser: Quantiser) -> tuple[NDArray[np.int32], float]:
        """The index of every coefficient, flat, and about how many bits they take."""
        table, trellis = self._table, quantiser.trellis
        steps = table.steps(quantiser)
        relative = np.zeros(table.size)
        classes = np.zeros(table.size, np.int8)
        _divide(table.bands, steps, self._coefficients, relative)
        _classify(table.bands, relative, classes)
        chosen = np.zeros(table.size, np.int32)
        transitions, odd = (TRANSITIONS, ODD) if trellis else (np.zeros((1, 2), np.int64), np.zeros(1, np.int64))
        prior = np.exp2(-_laplace(trellis))
        total = 0.0
        for _ in range(_TURNS):
            bits = self._bits[trellis]
            counts = np.zeros(bits.shape)
            total = 0.0
            for band in table.bands:
                total += _choose(band, relative, classes, bits, _WORTH[trellis], transitions, odd, chosen, counts)
            counts += _PRIOR * prior
            # What is learned of one choice serves the next one, with other steps, too.
            self._bits[trellis] = -np.log2(counts / counts.sum(axis=2, keepdims=True))
        return chosen, total


def _laplace(trellis: bool) -> NDArray[np.float64]:
    """Bits of each index (without its sign) by class, of coefficients with a Laplace distribution.

    float64, shape (quantiser, class, index).
    """
    found = np.empty((2, _CLASSES, _INDICES))
    for odd in range(2):
        for number in range(_CLASSES):
            scale = 2.0 ** ((number - _FIRST_CLASS + 0.5) / 2) + 0.01
            places = np.arange(_INDICES) - 0.5 * (odd if trellis else 0) * (np.arange(_INDICES) > 0)
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
        for i in range(bands[band, 2]):
            for j in range(bands[band, 3]):
                at = bands[band, 0] + i * bands[band, 1] + j
                relative[at] = coefficients[at] * scale


@kernel
def _classify(bands: NDArray[np.int64], relative: NDArray[np.float64], classes: NDArray[np.int8]) -> None:
    """Class of each coefficient by its eight neighbours and its parent: half octaves."""
    for band in range(bands.shape[0]):
        stride, parent = bands[band, 1], bands[band, 5]
        for i in range(bands[band, 2]):
            for j in range(bands[band, 3]):
                at = bands[band, 0] + i * stride + j
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
                above = abs(relative[parent + (i >> bands[band, 7]) * bands[band, 6] + (j >> bands[band, 8])])
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
    transitions: NDArray[np.int64],
    odd: NDArray[np.int64],
    chosen: NDArray[np.int32],
    counts: NDArray[np.float64],
) -> float:
    """The cheapest indices of a band in the order of its blocks, from state 0 on; returns about the bits they take.

    ``transitions`` and ``odd`` have a row for each state of the trellis, or one where there is none. ``counts``, of the
    shape of ``bits``, are increased.
    """
    offset, stride, rows, columns = band[0], band[1], band[2], band[3]
    states, length = odd.size, rows * columns
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
                        half = 0.5 * odd[state]
                        least = int(size + half)
                        for candidate in range(3):
                            # The nearest below, the nearest above, and none.
                            k = 0 if candidate == 2 else least + candidate
                            if candidate == 2 and least == 0:
                                continue
                            error = size - (k - half if k else 0.0)
                            rate = bits[odd[state], group, min(k, _INDICES - 1)]
                            if k:
                                rate += 1.0  # the sign
                            if k >= _INDICES - 1:
                                rate += 2.0 * np.log2(k - _INDICES + 3.0)
                            total = cost[state] + error * error + worth * rate
                            after = transitions[state, k & 1]
                            if total < new[after]:
                                new[after], before[number, after], index[number, after] = total, state, k
                    cost[:] = new
                    number += 1
    state = int(np.argmin(cost))
    used = 0.0
    for number in range(length - 1, -1, -1):
        k, at = index[number, state], places[number]
        state = before[number, state]
        chosen[at] = k if relative[at] >= 0 else -k
        shown = min(k, _INDICES - 1)
        counts[odd[state], int(classes[at]), shown] += 1.0
        used += bits[odd[state], int(classes[at]), shown] + (1.0 if k else 0.0)
        if k >= _INDICES - 1:
            used += 2.0 * np.log2(k - _INDICES + 3.0)
    return used


def longest_base(error_of: Callable[[int], float], wanted: float, guess: int) -> int | None:
    """The largest base of a quantiser found whose error is at most the one wanted, and close to it; None: none was.

    Parameters
    ----------
    error_of : callable
        The error with a base; it rises with the base, but for chance.
    guess : int
        Tried first.
    """
    below, above = (0, 0.0), (MOST_BASE + 1, np.inf)
    base = guess
    for _ in range(_TRIES):
        error = error_of(base)
        if error <= wanted:
            below = max(below, (base, error))
        else:
            above = min(above, (base, error))
        if error <= wanted and error >= _CLOSE * wanted:
            break
        aim = (1.0 + _CLOSE) / 2 * wanted
        if below[1] > 0.0 and above[1] < np.inf and below[1] < above[1]:
            share = np.log(aim / below[1]) / np.log(above[1] / below[1])
            factor = float((above[0] / below[0]) ** share) * below[0] / base
        else:
            factor = min(max((aim / max(error, 1e-300)) ** _ERROR_TO_STEP, 0.25), 4.0)
        base = min(max(round(base * factor), below[0] + 1), above[0] - 1)
        if not below[0] < base < above[0]:
            break
    return below[0] or None
