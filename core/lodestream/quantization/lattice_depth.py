"""How finely to divide values that lie on no lattice: until a finer lattice costs more than storing the rest.

Each bit more of the lattice is one bit less of residual for every value whose bits reach so far. On smooth surfaces
the transform predicts it, and it costs less; on noisy ones it costs as much or a little more.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..grid.layout import Layout
from ..transform.pyramid import allocate, forward
from .lattice import LATTICE_BITS, precision_lattice

__all__ = ["default_divisions"]

#: Lattice steps of the widest extent, in the order of preference; bits that a finer division must save for each value.
_USUAL_STEPS = 2.0**20
_FINEST_STEPS = 2.0**LATTICE_BITS - 8
_MIN_SAVED_BITS = 0.7
_SAMPLE_SIDE = 256


def default_divisions(channels: Sequence[NDArray[Any]]) -> float:
    """Return the number of lattice steps of the widest extent of coordinates without a lattice.

    Parameters
    ----------
    channels : sequence of floats, each of shape (row, column)
        The coordinates of a block, or of the largest, holes filled; finite.
    """
    if any(channel.dtype.kind != "f" for channel in channels):
        return _USUAL_STEPS
    span = max(float(channel.max()) - float(channel.min()) for channel in channels)
    if not 0.0 < span < np.inf:
        return _USUAL_STEPS
    with np.errstate(over="ignore", invalid="ignore"):  # extreme values get the usual steps
        saved = _bits(channels, span / _USUAL_STEPS) - _bits(channels, span / _FINEST_STEPS)
    return _FINEST_STEPS if _MIN_SAVED_BITS < saved < np.inf else _USUAL_STEPS


def _bits(channels: Sequence[NDArray[Any]], step: float) -> float:
    """Estimate the bits of a value, on a lattice of this step and in the residual, in the middle of the surface."""
    total, count = 0.0, 0
    for channel in channels:
        middle = tuple(
            slice(max(0, (n - _SAMPLE_SIDE) // 2), max(0, (n - _SAMPLE_SIDE) // 2) + _SAMPLE_SIDE)
            for n in channel.shape
        )
        window = np.ascontiguousarray(channel[middle])
        lattice = precision_lattice(float(channel.min()), float(channel.max()), step)
        work = allocate(window.shape)
        lattice.coordinates(window, out=work)
        forward([work], Layout.single(window.shape, (False, False), (7, 7)))
        spacing = np.spacing(np.abs(window)).astype(np.float64)
        total += float(np.log2(1.0 + 2.7 * np.abs(work)).sum())
        total += float(np.maximum(np.log2(lattice.step / spacing), 0.0).sum())
        count += window.size
    return total / count
