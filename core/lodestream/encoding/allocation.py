"""Allocation of coding passes to layers: in order of the error that they remove for each byte.

Every tile of every channel is a list of coding passes, each with a cost in bits and a gain in squared error. Passes are
grouped into *runs*: on the convex hull of each tile, so that a poor pass before a good one does not hide it, and so
that a run is worth the segment that it takes. Runs are sorted by gain for each bit, parents never after their
children; layers cut this order so that one is at most `_GROWTH` times as long as the one before. There are
never more than a container may have. Some of the ends are moved afterwards, see `stops`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..container import limits
from ..grid.layout import Layout
from .curves import Curves, Worth
from .effort import FewLayers

__all__ = ["PassOrder", "layer_ends", "pass_order"]

#: A segment takes so many bits besides its passes: in the layer's table, in the index, and to start and end a coder.
_SEGMENT = 48.0
#: Two runs of a tile are one where as two they save less than a segment takes; early in the stream, where many segments
#: are in the same layer anyway, less than a share of the stream's bits.
_SHARE_OF_STREAM = 0.005
#: What a run adds to a layer besides its passes, in bytes.
_ENTRY = 5
#: By how much the bytes grow from layer to layer, at least and at most, where there are more than so many ...
_GROWTH = 1.13, 1.15
_OFTEN = 3800
#: ... and before: a layer's frame takes about 50 bytes with its share of the index, which counts there.
_EARLY_GROWTH = 1.4, 1.8
_EARLY_STEP = 160
_FIRST_LAYER = 48  # bytes of coefficients, at least where there are more layers
# Of streams of few layers; one of fewer bytes than the first is one layer.
_BRIEF = 6000
_FEWEST = 3
_SECOND = 16.0  # times the first layer


@dataclass(frozen=True, eq=False)
class PassOrder:
    """All passes of a stream in their order.

    Attributes
    ----------
    top : int8, shape (tile, channel)
        Passes of every tile and channel.
    unit : int64, shape (pass,)
        Tile times channels, plus channel.
    number : int8, shape (pass,)
        Passes of the unit that remain after this one.
    sizes, gains : float64, shape (pass,)
        Bytes, and the squared error that is removed, of all passes up to each one.
    last : bool, shape (pass,)
        Of a run the last pass.
    """

    top: NDArray[np.int8]
    unit: NDArray[np.int64]
    number: NDArray[np.int8]
    sizes: NDArray[np.float64]
    gains: NDArray[np.float64]
    last: NDArray[np.bool_]

    def states(self, ends: Iterable[int]) -> Iterator[NDArray[np.int8]]:
        """Yield the passes that remain after so many, ascending: int8 arrays, shape (tile, channel)."""
        state, start = self.top, 0
        for end in ends:
            state = state.copy()
            np.minimum.at(state.reshape(-1), self.unit[start:end], self.number[start:end])
            yield state
            start = end


def pass_order(curves: Curves, layout: Layout, channels: int) -> PassOrder:
    """Return the order of all passes.

    Parameters
    ----------
    curves : Curves
    layout : Layout
    channels : int
        Of the surface; one whose coefficients are all 0 has no curve.
    """
    top = np.zeros((len(layout.tiles), channels), np.int8)
    top[curves.tile, curves.channel] = curves.counts
    slope = curves.slopes(_worth(curves))
    curves.lift_parents(slope, layout)
    unit = np.repeat(curves.tile * channels + curves.channel, curves.counts)
    number = (np.arange(unit.size) - np.repeat(curves.ends - curves.counts, curves.counts)).astype(np.int8)
    # By tile, then by number, then by channel where slopes are equal.
    order = np.lexsort((unit % channels, -number, unit // channels, -slope))
    unit, number, slope = unit[order], number[order], slope[order]
    last = np.ones(unit.size, np.bool_)
    last[:-1] = (unit[1:] != unit[:-1]) | (slope[1:] != slope[:-1])
    del slope
    sizes = np.cumsum(curves.bits[order] / 8 + _ENTRY * last)
    return PassOrder(top, unit, number, sizes, np.cumsum(curves.gains[order]), last)


def _worth(curves: Curves) -> Worth:
    """Return the limits of what two runs must save to be two, see `_SHARE_OF_STREAM`."""
    falling = -curves.slopes()
    order = np.argsort(falling, kind="stable")
    return Worth(falling[order], np.cumsum(curves.bits[order]), _SHARE_OF_STREAM, _SEGMENT)


def layer_ends(order: PassOrder, most: int, few: FewLayers | None = None) -> list[int]:
    """Return the number of passes that are known after each of at most ``most`` layers; with ``few``, of so many.

    They follow from bytes and gains that the passes add up to.
    Where there would be more layers, neighbours are merged, evenly over the stream, so that it still begins small.

    Found from the end to the start, each within a range of bytes that the next one allows. It is the place after the
    `last` pass of a run, if there is one, where the error lies furthest below a line, in the logarithms of both, from
    one end of the range to the other: within a bit-plane the error falls faster at first than later.
    """
    sizes, gains, last = order.sizes, order.gains, order.last
    if not sizes.size or (few and float(sizes[-1]) < _BRIEF):
        return [sizes.size]
    errors = np.log(np.maximum(gains[-1] - gains, max(float(gains[-1]), 0.0) * 1e-15 + 1e-300))
    lengths = np.log(np.maximum(sizes, 1.0))
    ends = [sizes.size - 1]
    while len(ends) < limits.LAYERS:
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
    if len(ends) > most:  # ends[0] is that of the stream, ends[-1] that of the first layer
        kept = np.rint(np.linspace(0, len(ends) - 1, most)).astype(int) if most > 1 else [0]
        ends = [ends[place] for place in kept]
    return [end + 1 for end in reversed(ends)]


def _range_before(size: float, total: float, few: FewLayers | None) -> tuple[float, float]:
    """Return the fewest and the most bytes of the stream after the layer before one that ends at ``size``."""
    if few:
        second = _SECOND * _FIRST_LAYER
        count = min(max(int(total / few.bytes), _FEWEST), few.most)
        growth = max(total / second, 1.0) ** (1 / (count - 2))
        if size > second * growth**0.5:
            return size / growth**1.5, size / growth**0.5
        return (_FIRST_LAYER, _FIRST_LAYER) if size > second / 2 else (0.0, 0.0)
    if size > _OFTEN * _GROWTH[1]:
        return size / _GROWTH[1], size / _GROWTH[0]
    return min(size / _EARLY_GROWTH[1], size - _EARLY_STEP), min(size / _EARLY_GROWTH[0], size - _EARLY_STEP / 2)
