"""Which bits go into which layer: in order of what they do to the error for each byte.

Every tile of every channel is a list of bit-planes, each with a cost in bits and a gain in squared error. Planes are
sorted by gain for each bit (on the convex hull of each tile, so that a poor plane before a good one does not hide it),
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
_LEAST_GROWTH = 1.2


@dataclass(frozen=True)
class TileCurve:
    """What the planes of one tile of one channel cost and gain.

    Attributes
    ----------
    bits : float64, shape (plane,)
        Bits that plane p takes.
    gains : float64, shape (plane,)
        By how much the squared error falls with plane p, in the surface's unit.
    """

    tile: int
    channel: int
    bits: NDArray[np.float64]
    gains: NDArray[np.float64]


def hull_slopes(curve: TileCurve) -> NDArray[np.float64]:
    """Gain for each bit of every plane, on the upper convex hull: it never rises towards lower planes."""
    hull: list[tuple[float, float, int]] = []  # bits, gain, planes
    for bits, gain in zip(curve.bits[::-1], curve.gains[::-1], strict=True):
        step = (max(float(bits), 1e-9), max(float(gain), 0.0), 1)
        while hull and step[1] * hull[-1][0] >= hull[-1][1] * step[0]:
            last = hull.pop()
            step = (step[0] + last[0], step[1] + last[1], step[2] + last[2])
        hull.append(step)
    slopes = [gain / bits for bits, gain, planes in hull for _ in range(planes)]
    return np.array(slopes[::-1])


def assign_layers(curves: list[TileCurve], layout: Layout, channels: int) -> list[NDArray[np.int8]]:
    """The state after each layer.

    Parameters
    ----------
    curves : list of TileCurve
        One for each tile and channel that has a plane.
    layout : Layout
    channels : int
        Of the surface; one whose coefficients are all 0 has no curve.

    Returns
    -------
    list of int8 arrays, shape (tile, channel)
        Lowest plane that is known after the layer; where nothing is, the tile's number of planes.
    """
    top = np.zeros((len(layout.tiles), channels), np.int8)
    slopes: dict[tuple[int, int], NDArray[np.float64]] = {}
    for curve in curves:
        top[curve.tile, curve.channel] = len(curve.bits)
        slopes[curve.tile, curve.channel] = hull_slopes(curve)
    _lift_parents(slopes, layout)
    bits = {(curve.tile, curve.channel): curve.bits for curve in curves}
    order = sorted(
        (-float(slope), tile, -plane, channel)
        for (tile, channel), planes in slopes.items()
        for plane, slope in enumerate(planes)
    )
    sizes = np.cumsum([bits[tile, channel][-plane] / 8 for _, tile, plane, channel in order])
    ends = _layer_ends(sizes)
    states, state = [], top.copy()
    start = 0
    for end in ends:
        for _, tile, plane, channel in order[start:end]:
            state[tile, channel] = -plane
        states.append(state.copy())
        start = end
    return states or [top]


def _lift_parents(slopes: dict[tuple[int, int], NDArray[np.float64]], layout: Layout) -> None:
    """Give a parent's plane at least the slope of its children's, from the finest level down."""
    for (tile, channel), own in sorted(slopes.items(), reverse=True):
        parent = slopes.get((layout.tiles[tile].parent, channel))
        if parent is None:
            continue
        shared = min(len(own), len(parent))
        parent[:shared] = np.maximum(parent[:shared], own[:shared])
        # A higher plane of the parent than any of the child's must come before them too.
        if len(parent) > shared:
            parent[shared:] = np.maximum(parent[shared:], own.max())
        parent[:] = np.maximum.accumulate(parent)


def _layer_ends(sizes: NDArray[np.float64]) -> list[int]:
    """How many planes are known after each layer, from the bytes that the planes add up to."""
    if sizes.size == 0:
        return []
    total = float(sizes[-1])
    first = min(_FIRST_LAYER, total)
    count = min(MOST_LAYERS, 1 + int(np.log(total / first) / np.log(_LEAST_GROWTH)))
    targets = np.geomspace(first, total, count)
    ends = np.searchsorted(sizes, targets * (1 - 1e-12)) + 1
    ends[-1] = sizes.size
    return [int(end) for end in np.unique(np.minimum(ends, sizes.size))]
