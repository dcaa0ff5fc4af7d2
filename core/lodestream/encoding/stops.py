"""Ends of layers where clients stop: at RMS errors of 1e-2, 1e-3 and 1e-4 of the extent.

A client stops at the first layer that meets its error, which on average ends half a layer later than it could. So the
errors of the ends that `layer_ends` finds are measured, and between the two on either side of a common error one more
end is sought: what the gains foretell is set right by what was measured at both, and measured in turn. The nearer one
of the two then gives way to it, so that there are no more layers than before.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from .allocation import PassOrder

__all__ = ["moved_ends", "sought_ends"]

#: Errors at which clients stop, of the extent.
_ERRORS = 1e-2, 1e-3, 1e-4
#: Ends are not sought where they would save less than this share of the bytes.
_WORTH = 0.02
#: One more layer must save so many bytes: all clients after it receive its frame, about 50 bytes.
_LAYER = 128
#: What is sought lies so far below the error: a little above, it would be of no use.
_BELOW = 0.998


def sought_ends(order: PassOrder, measured: Mapping[int, float], extent: float, geometric: int) -> list[int]:
    """Return ends of layers that should be measured next, of each common error one at most.

    Parameters
    ----------
    order : PassOrder
    measured : mapping of int to float
        The RMS error of the coordinates after so many passes, for each end that was measured.
    extent : float
        Of the surface.
    geometric : int
        The first so many channels are coordinates.
    """
    left = _left(order, geometric)
    found = set()
    for before, end, limit in _stops(measured, extent):
        places = np.arange(before, end - 1)  # the end after a place is one more
        if not places.size:
            continue
        errors = _foretold(order, left, places, (before, measured[before]), (end, measured[end]))
        met = np.flatnonzero(errors <= _BELOW * limit)
        place = int(places[met[0] if met.size else -1])
        if order.sizes[place] < (1 - _WORTH) * order.sizes[end - 1]:
            found.add(place + 1)
    return sorted(found)


def moved_ends(
    order: PassOrder, ends: Sequence[int], measured: Mapping[int, float], extent: float, most: int
) -> list[int]:
    """Return the ends of at most ``most`` layers: of each common error the first one that meets it is one of them.

    ``ends`` are those that `layer_ends` found, and parameters those of `sought_ends`. The first end, the last one and
    those that meet another common error stay; where neither of the ends beside a new one may give way, there is one
    layer more if it saves clearly more than its frame takes.
    """
    stops = [end for _, end, _ in _stops(measured, extent)]
    moved, fixed = list(ends), {ends[0], ends[-1], *stops}
    for end in reversed(stops):
        place = bisect_left(moved, end)
        beside = [other for other in moved[place - 1 : place + 1] if other not in fixed]
        if moved[place] == end:
            continue
        if beside:
            moved[moved.index(min(beside, key=lambda other: _distance(order, other, end)))] = end
        elif len(moved) < most and order.sizes[moved[place] - 1] - order.sizes[end - 1] > _LAYER:
            moved.insert(place, end)
    return moved


def _stops(measured: Mapping[int, float], extent: float) -> Iterator[tuple[int, int, float]]:
    """Yield of each common error the last measured end above it, the first one that meets it, and the error."""
    ends = sorted(measured)
    for error in _ERRORS:
        number = next((number for number, end in enumerate(ends) if measured[end] <= error * extent), 0)
        if number:
            yield ends[number - 1], ends[number], error * extent


def _left(order: PassOrder, geometric: int) -> NDArray[np.float64]:
    """Return the logarithm of the error of the coordinates that gains foretell after each pass, float64, (pass,)."""
    gains = np.diff(order.gains, prepend=0.0)
    gains[order.unit % order.top.shape[1] >= geometric] = 0.0
    known = np.cumsum(gains)
    largest = max(float(np.abs(known).max(initial=0.0)), 1e-300)
    left: NDArray[np.float64] = 0.5 * np.log(np.maximum(known[-1:] - known, 1e-15 * largest))
    return left


def _foretold(
    order: PassOrder,
    left: NDArray[np.float64],
    places: NDArray[np.int64],
    before: tuple[int, float],
    after: tuple[int, float],
) -> NDArray[np.float64]:
    """Return the errors foretold after some passes between two ends whose errors were measured: float64, (place,).

    ``before`` and ``after`` are these ends and errors; where the latter is 0, the former alone sets right what gains
    foretell.
    """
    first, error = before[0] - 1, np.log(before[1])
    if not after[1]:
        foretold: NDArray[np.float64] = np.exp(error + left[places] - left[first])
        return foretold
    by = left if left[after[0] - 1] < left[first] else -np.log(np.maximum(order.sizes, 1.0))
    fall = (by[places] - by[first]) / (by[after[0] - 1] - by[first])
    return np.asarray(np.exp(error + fall * (np.log(after[1]) - error)))


def _distance(order: PassOrder, end: int, other: int) -> float:
    """Return how far apart two ends are, in the logarithm of the bytes."""
    return abs(float(np.log(max(order.sizes[end - 1], 1.0)) - np.log(max(order.sizes[other - 1], 1.0))))
