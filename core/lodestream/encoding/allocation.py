"""Which bits go into which layer: in order of what they do to the error for each byte.

Every tile of every channel is a list of coding passes, each with a cost in bits and a gain in squared error. Passes are
grouped into *runs*: on the convex hull of each tile, so that a poor pass before a good one does not hide it, and so
that a run is worth the segment that it takes. Runs are sorted by gain for each bit, parents never after their
children; layers cut this order so that one is at most `_GROWTH` times as long as the one before.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..grid.layout import Layout

__all__ = ["TileCurve", "assign_layers", "hull_slopes"]

#: A segment takes so many bits besides its passes: in the layer's table, in the index, and to start and end a coder.
_SEGMENT = 48.0
#: Two runs are one where as two they save less than this share of the tile's bits so far, or than a segment takes;
#: early in the stream, where many segments are in the same layer anyway, less than a share of the stream's bits.
_SHARE_OF_TILE = 0.02
_SHARE_OF_STREAM = 0.005
#: What a run adds to a layer besides its passes, in bytes.
_ENTRY = 5
#: By how much the bytes grow from layer to layer, at least and at most, where there are more than so many ...
_GROWTH = 1.12, 1.14
_OFTEN = 3800
#: ... and before: a layer's frame takes about 50 bytes with its share of the index, which counts there.
_EARLY_GROWTH = 1.4, 1.8
_EARLY_STEP = 160
_FIRST_LAYER = 48  # bytes of coefficients, at least where there are more layers
# Of streams made for one error; one of fewer bytes than the first is one layer.
_BRIEF = 6000
_FEWEST, _MOST = 3, 24
_SECOND = 16.0  # times the first layer
_BYTES_FOR_A_LAYER = 12000


@dataclass(frozen=True)
class TileCurve:
    """What the coding passes of one tile of one channel cost and gain.

    Attributes
    ----------
    bits : float64, shape (pass,)
        Bits that each pass takes; the last pass has number 0.
    gains : float64, shape (pass,)
        By how much the squared error falls with each pass, in the surface's unit.
    """

    tile: int
    channel: int
    bits: NDArray[np.float64]
    gains: NDArray[np.float64]


def hull_slopes(curve: TileCurve, worth: Callable[[float], float] = lambda slope: 0.0) -> NDArray[np.float64]:
    """Gain for each bit of every pass, shape (pass,): the same for all passes of a run, falling from run to run.

    Two runs that follow each other, of a bits with a gain of s a and of b bits with t b, are one unless s > t and,
    where both as one would come, they save enough bits as two, a b (s - t) / (s a + t b): ``worth(s)``, and a share of
    the tile's bits so far.
    """
    runs: list[tuple[float, float, int]] = []  # bits, gain, passes
    known = 0.0
    for bits, gain in zip(curve.bits[::-1].tolist(), curve.gains[::-1].tolist(), strict=True):
        run = (max(bits, 1e-9), max(gain, 0.0), 1)
        known += run[0]
        while runs:
            last = runs[-1]
            saved = last[1] * run[0] - run[1] * last[0]
            if saved > 0 and saved >= max(worth(last[1] / last[0]), _SHARE_OF_TILE * known) * (last[1] + run[1]):
                break
            runs.pop()
            run = (run[0] + last[0], run[1] + last[1], run[2] + last[2])
        runs.append(run)
    slopes = [gain / bits for bits, gain, passes in runs for _ in range(passes)]
    return np.array(slopes[::-1])


def _worth(curves: list[TileCurve]) -> Callable[[float], float]:
    """What two runs must save to be two, in bits, by the slope of the first; see `_SHARE_OF_STREAM`."""
    slopes = np.concatenate([hull_slopes(curve) for curve in curves])
    order = np.argsort(-slopes, kind="stable")
    falling = (-slopes[order]).tolist()
    known = np.cumsum(np.concatenate([curve.bits for curve in curves])[order]).tolist()
    return lambda slope: min(_SEGMENT, _SHARE_OF_STREAM * known[min(bisect_left(falling, -slope), len(known) - 1)])


def assign_layers(curves: list[TileCurve], layout: Layout, channels: int, few: bool = False) -> list[NDArray[np.int8]]:
    """The state after each layer.

    Parameters
    ----------
    curves : list of TileCurve
        One for each tile and channel that has a bit-plane.
    layout : Layout
    channels : int
        Of the surface; one whose coefficients are all 0 has no curve.
    few : bool
        Only so many layers that their frames are a small part of the bytes.

    Returns
    -------
    list of int8 arrays, shape (tile, channel)
        Passes that remain after the layer.
    """
    top = np.zeros((len(layout.tiles), channels), np.int8)
    if not curves:
        return [top]
    worth = _worth(curves)
    slopes = {(curve.tile, curve.channel): hull_slopes(curve, worth) for curve in curves}
    _lift_parents(slopes, layout)
    counts = [curve.bits.size for curve in curves]
    tile = np.repeat([curve.tile for curve in curves], counts)
    channel = np.repeat([curve.channel for curve in curves], counts)
    number = np.concatenate([np.arange(count) for count in counts])
    slope = np.concatenate([slopes[curve.tile, curve.channel] for curve in curves])
    order = np.lexsort((channel, -number, tile, -slope))
    tile, channel, number, slope = tile[order], channel[order], number[order], slope[order]
    stays = (tile[1:] == tile[:-1]) & (channel[1:] == channel[:-1]) & (slope[1:] == slope[:-1])
    last = np.append(~stays, True)
    sizes = np.cumsum(np.concatenate([curve.bits for curve in curves])[order] / 8 + _ENTRY * last)
    gains = np.cumsum(np.concatenate([curve.gains for curve in curves])[order])
    for curve in curves:
        top[curve.tile, curve.channel] = curve.bits.size
    states, state, start = [], top, 0
    for end in _layer_ends(sizes, gains, last, few):
        state = state.copy()
        np.minimum.at(state, (tile[start:end], channel[start:end]), number[start:end].astype(np.int8))
        states.append(state)
        start = end
    return states


def _lift_parents(slopes: dict[tuple[int, int], NDArray[np.float64]], layout: Layout) -> None:
    """Give a parent's passes of a plane at least the slope of its children's, from the finest level down."""
    parents = layout.parents.data
    for (tile, channel), own in sorted(slopes.items(), reverse=True):
        parent = slopes.get((parents[tile], channel))
        if parent is None:
            continue
        # A plane's passes have the numbers 2 p + 1 and 2 p: the parent's second comes before the child's first.
        for number in range(0, len(parent), 2):
            parent[number] = max(parent[number], float(own[number : number + 2].max(initial=0.0)))
        if len(parent) > len(own):
            parent[len(own) :] = np.maximum(parent[len(own) :], own.max())
        parent[:] = np.maximum.accumulate(parent)


def _layer_ends(
    sizes: NDArray[np.float64], gains: NDArray[np.float64], last: NDArray[np.bool_], few: bool
) -> list[int]:
    """How many passes are known after each layer, from the bytes and the gains that the passes add up to.

    Found from the end to the start, each within a range of bytes that the next one allows. It is the place after the
    `last` pass of a run, if there is one, where the error lies furthest below a line, in the logarithms of both, from
    one end of the range to the other: within a bit-plane the error falls faster at first than later.
    """
    if few and float(sizes[-1]) < _BRIEF:
        return [sizes.size]
    errors = np.log(np.maximum(gains[-1] - gains, max(float(gains[-1]), 0.0) * 1e-15 + 1e-300))
    lengths = np.log(np.maximum(sizes, 1.0))
    ends = [sizes.size - 1]
    while True:
        end = ends[-1]
        low, high = _range_before(float(sizes[end]), float(sizes[-1]), few)
        if end == 0 or high < _FIRST_LAYER:
            break
        start = min(int(np.searchsorted(sizes, low)), end - 1)
        stop = min(max(int(np.searchsorted(sizes, high, side="right")), start + 1), end)
        places = np.arange(start, stop)
        if last[start:stop].any():
            places = places[last[start:stop]]
        run = lengths[stop - 1] - lengths[start]
        slope = (errors[stop - 1] - errors[start]) / run if run > 0 else 0.0
        ends.append(int(places[np.argmin(errors[places] - slope * lengths[places])]))
    return [end + 1 for end in reversed(ends)]


def _range_before(size: float, total: float, few: bool) -> tuple[float, float]:
    """Bytes, at least and at most, after the layer before one that ends at ``size``."""
    if few:
        second = _SECOND * _FIRST_LAYER
        count = min(max(int(total / _BYTES_FOR_A_LAYER), _FEWEST), _MOST)
        growth = max(total / second, 1.0) ** (1 / (count - 2))
        if size > second * growth**0.5:
            return size / growth**1.5, size / growth**0.5
        return (_FIRST_LAYER, _FIRST_LAYER) if size > second / 2 else (0.0, 0.0)
    if size > _OFTEN * _GROWTH[1]:
        return size / _GROWTH[1], size / _GROWTH[0]
    return min(size / _EARLY_GROWTH[1], size - _EARLY_STEP), min(size / _EARLY_GROWTH[0], size - _EARLY_STEP / 2)
