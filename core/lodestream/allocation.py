"""Which bits go into which layer: in order of what they do to the error for each byte.

Every tile of every channel is a list of coding passes, each with a cost in bits and a gain in squared error. Passes are
sorted by gain for each bit (on the convex hull of each tile, so that a poor pass before a good one does not hide it),
parents never after their children; layers cut this order at bytes evenly spaced in the logarithm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .layout import Layout

__all__ = ["MOST_LAYERS", "TileCurve", "assign_layers", "hull_slopes"]

MOST_LAYERS = 24
_FIRST_LAYER = 48  # bytes of coefficients in the first layer
_LEAST_GROWTH = 1.3
_LEAST_LAYER = 160  # bytes: a layer's frame takes about 30
_LAST_LOSSY = 0.92
# Of streams made for one error; one of fewer bytes is one layer.
_BRIEF = 6000
_FEWEST = 3
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


def hull_slopes(curve: TileCurve) -> NDArray[np.float64]:
    """Gain for each bit of every pass, on the upper convex hull: it never rises towards later passes."""
    hull: list[tuple[float, float, int]] = []  # bits, gain, passes
    for bits, gain in zip(curve.bits[::-1], curve.gains[::-1], strict=True):
        step = (max(float(bits), 1e-9), max(float(gain), 0.0), 1)
        while hull and step[1] * hull[-1][0] >= hull[-1][1] * step[0]:
            last = hull.pop()
            step = (step[0] + last[0], step[1] + last[1], step[2] + last[2])
        hull.append(step)
    slopes = [gain / bits for bits, gain, passes in hull for _ in range(passes)]
    return np.array(slopes[::-1])


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
    slopes: dict[tuple[int, int], NDArray[np.float64]] = {}
    for curve in curves:
        top[curve.tile, curve.channel] = len(curve.bits)
        slopes[curve.tile, curve.channel] = hull_slopes(curve)
    _lift_parents(slopes, layout)
    known = {(curve.tile, curve.channel): curve for curve in curves}
    order = sorted(
        (-float(slope), tile, -number, channel)
        for (tile, channel), passes in slopes.items()
        for number, slope in enumerate(passes)
    )
    sizes = np.cumsum([known[tile, channel].bits[-number] / 8 for _, tile, number, channel in order])
    gains = np.cumsum([known[tile, channel].gains[-number] for _, tile, number, channel in order])
    ends = _layer_ends(sizes, gains, few)
    states, state = [], top.copy()
    start = 0
    for end in ends:
        for _, tile, number, channel in order[start:end]:
            state[tile, channel] = -number
        states.append(state.copy())
        start = end
    return states or [top]


def _lift_parents(slopes: dict[tuple[int, int], NDArray[np.float64]], layout: Layout) -> None:
    """Give a parent's passes of a plane at least the slope of its children's, from the finest level down."""
    for (tile, channel), own in sorted(slopes.items(), reverse=True):
        parent = slopes.get((layout.tiles[tile].parent, channel))
        if parent is None:
            continue
        # A plane's passes have the numbers 2 p + 1 and 2 p: the parent's second comes before the child's first.
        for number in range(0, len(parent), 2):
            parent[number] = max(parent[number], float(own[number : number + 2].max(initial=0.0)))
        if len(parent) > len(own):
            parent[len(own) :] = np.maximum(parent[len(own) :], own.max())
        parent[:] = np.maximum.accumulate(parent)


def _targets(first: float, last: float) -> NDArray[np.float64]:
    """Bytes after each layer but the complete one, evenly spaced in the logarithm where layers are worth a table."""
    growth = _LEAST_GROWTH
    while True:
        targets = [first]
        while targets[-1] < last:
            targets.append(max(targets[-1] * growth, targets[-1] + _LEAST_LAYER))
        if len(targets) < MOST_LAYERS:
            break
        growth **= 1.02
    if len(targets) > 1:
        # Whole steps rarely end at the last one: all shrink a little.
        scale = np.log(last / first) / np.log(targets[-1] / first)
        return np.asarray(first * np.power(np.array(targets) / first, scale))
    return np.array(targets)


def _few_targets(first: float, last: float) -> NDArray[np.float64]:
    """Bytes after each layer but the complete one, where that is what was asked for."""
    count = min(max(int(last / _BYTES_FOR_A_LAYER), _FEWEST), MOST_LAYERS)
    return np.append(first, np.geomspace(min(_SECOND * first, last), last, count - 1)[:-1])


def _layer_ends(sizes: NDArray[np.float64], gains: NDArray[np.float64], few: bool) -> list[int]:
    """How many passes are known after each layer, from the bytes and the gains that the passes add up to.

    Within a bit-plane the error falls faster at first than later, so some places between passes are better to stop at
    than others. A layer ends at the best place around its share of the bytes: where the error lies furthest below a
    line, in the logarithms of both, from one end of the neighbourhood to the other.
    """
    if sizes.size == 0:
        return []
    total = float(sizes[-1])
    if few and total < _BRIEF:
        return [sizes.size]
    first = min(_FIRST_LAYER, total)
    # The last lossy picture should not be far from the end, also where the last bits lower the error steeply.
    targets = _few_targets(first, total) if few else _targets(first, max(first, _LAST_LOSSY * total))
    borders = np.sqrt(targets[1:] * targets[:-1])
    starts = np.searchsorted(sizes, borders)
    errors = np.log(np.maximum(gains[-1] - gains, max(float(gains[-1]), 0.0) * 1e-15 + 1e-300))
    lengths = np.log(np.maximum(sizes, 1.0))
    ends = []
    for target, start, stop in zip(targets, [0, *starts], [*starts, sizes.size - 1], strict=True):
        middle = int(np.searchsorted(sizes, target * (1 - 1e-12)))
        start, stop = min(start, middle), min(max(stop, middle + 1), sizes.size)
        run = lengths[stop - 1] - lengths[start]
        slope = (errors[stop - 1] - errors[start]) / run if run > 0 else 0.0
        place = start + int(np.argmin(errors[start:stop] - slope * lengths[start:stop]))
        ends.append((place if start > 0 and stop < sizes.size - 1 else middle) + 1)
    ends.append(sizes.size)
    return [int(end) for end in np.unique(np.minimum(ends, sizes.size))]
