"""Choose the index of each coefficient that costs least, in squared error and in bits.

What an index costs in bits is not known before everything is coded, so it is estimated: coefficients are put into
classes by the size of what is around them, and the share of each index in its class gives its bits; a few turns
settle both. The indices of a band depend on each other by the trellis: the cheapest of all ways through it is taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from .. import kernels
from ..entropy.band_fields import COLUMNS, ROWS
from ..entropy.tiles import TileTable
from ..kernels import CLASSES, INDICES, RATES
from ..quantization.band_steps import MOST_BASE, TRANSITIONS

__all__ = ["MOST_TRIES", "IndexChooser", "longest_base"]

#: Squared error that a bit is worth, in squared quantization steps of one point of the surface.
_WORTH = 0.05
_FIRST_CLASS = 8.0  # number of the class whose coefficients are about a quantization step
#: How many coefficients the Laplace distribution counts for among those that were seen of a class.
_PRIOR = 8.0
#: Coefficients in one call of a kernel, unless a band has more.
_AT_ONCE = 1 << 18
#: The search for a base: how often, how close to the error wanted, and by which power quantization steps grow with it.
MOST_TRIES = 10
_CLOSE = 0.997
_ERROR_TO_STEP = 1.2


class IndexChooser:
    """Chooses the indices of one channel, band by band: `begin`, then `choose` until all bands are done, then `end`.

    Parameters
    ----------
    table : TileTable

    Attributes
    ----------
    chosen : int32, flat
        The indices chosen since `begin`.
    """

    chosen: NDArray[np.int32]

    def __init__(self, table: TileTable) -> None:
        self._table = table
        self._bits = _laplace()
        widest = int(table.bands[:, COLUMNS].max(initial=0))
        # What the kernel works in: of a row of blocks, for each survivor.
        self._room = np.empty(8 * len(TRANSITIONS) * widest, np.int16), np.empty(2 * widest, np.float32)

    def begin(self, steps: NDArray[np.int64], rules: NDArray[np.float32]) -> None:
        """Begin to choose all indices; statistics of the last choice are kept, whatever its quantization steps were.

        For the shapes of ``steps`` and ``rules`` see `TileTable.steps` and `noise_shaping.feedback_rules`.
        """
        self._steps, self._rules = steps, rules
        self._relative = np.zeros(self._table.size)
        self._classes = np.zeros(self._table.size, np.int8)
        self.chosen = np.zeros(self._table.size, np.int32)
        self._rates = _rates(self._bits)
        self._counts = _PRIOR * np.exp2(-_laplace())

    def choose(self, numbers: NDArray[np.int64], coefficients: NDArray[np.int32]) -> None:
        """Choose the indices of some bands, after those of their parents.

        Parameters
        ----------
        numbers : int64, shape (chosen band,)
            Of the bands in the table.
        coefficients : int32, shape (`TileTable.size`,), see `tiles.gather`
            What the indices are to stand for.
        """
        bands = self._table.bands[numbers]
        relative, classes = self._relative, self._classes
        for first, last in _runs(bands[:, ROWS] * bands[:, COLUMNS]):
            run, members = bands[first:last], numbers[first:last]
            kernels.classify(run, self._steps[members], coefficients, relative, classes)
            kernels.choose(
                run, self._rules[members], relative, classes, self._rates, self.chosen, self._counts, *self._room
            )

    def end(self) -> NDArray[np.int32]:
        """Return all indices, shape (`TileTable.size`,), and estimate from them the costs for the next choice."""
        self._bits = -np.log2(self._counts / self._counts.sum(axis=2, keepdims=True))
        chosen = self.chosen
        del self.chosen, self._relative, self._classes
        return chosen


def _rates(bits: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the cost of each index and its sign: float32, shape (quantiser, class, `kernels.RATES`)."""
    index = np.arange(RATES)
    rates = bits[:, :, np.minimum(index, INDICES - 1)] + (index > 0)
    rates += 2.0 * np.log2(np.maximum(index - INDICES + 3, 1)) * (index >= INDICES - 1)
    weighted: NDArray[np.float32] = (_WORTH * rates).astype(np.float32, order="C")
    return weighted


def _runs(sizes: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Divide bands into runs, one for each call of a kernel; return (first, last + 1) of each.

    ``sizes``: coefficients of each band.
    """
    runs, first, size = [], 0, 0
    for number, band_size in enumerate(sizes.tolist()):
        if number > first and size + band_size > _AT_ONCE:
            runs.append((first, number))
            first, size = number, 0
        size += band_size
    return [*runs, (first, len(sizes))]


@cache
def _laplace() -> NDArray[np.float64]:
    """Return the bits of each index, without its sign, for coefficients of a Laplace distribution, by class.

    float64, shape (quantiser, class, index).
    """
    bits = np.empty((2, CLASSES, INDICES))
    for odd in range(2):
        for number in range(CLASSES):
            scale = 2.0 ** ((number - _FIRST_CLASS + 0.5) / 2) + 0.01
            places = np.arange(INDICES) - 0.5 * odd * (np.arange(INDICES) > 0)
            borders = np.append((places[1:] + places[:-1]) / 2, np.inf)
            beyond = np.exp(-np.append(0.0, borders) / scale)
            bits[odd, number] = -np.log2(np.maximum(beyond[:-1] - beyond[1:], 1e-7))
    bits.flags.writeable = False
    return bits


def longest_base(error_of: Callable[[int], float], wanted: float, guess: int) -> int | None:
    """Find the largest base of a quantiser whose error is at most the wanted one, and close to it.

    None if there is none.

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
        if _CLOSE * wanted <= error <= wanted or above * _CLOSE < below:
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
