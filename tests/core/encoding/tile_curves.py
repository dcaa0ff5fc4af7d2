"""Curves of single tiles, put together as the encoder has them of all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lodestream.encoding.curves import Curves

__all__ = ["TileCurve", "joined"]


class TileCurve(NamedTuple):
    """Bits and gains of the passes of one tile of one channel, float64, shape (pass,); the last pass has number 0."""

    tile: int
    channel: int
    bits: NDArray[np.float64]
    gains: NDArray[np.float64]


def joined(curves: Sequence[TileCurve]) -> Curves:
    """These curves, in their order."""
    numbers = ([curve.tile for curve in curves], [curve.channel for curve in curves], [c.bits.size for c in curves])
    tile, channel, counts = (np.array(own, np.int64) for own in numbers)
    nothing = np.zeros(0)
    bits = np.concatenate([nothing, *(curve.bits for curve in curves)])
    return Curves(tile, channel, counts, bits, np.concatenate([nothing, *(curve.gains for curve in curves)]))
