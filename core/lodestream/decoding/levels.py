"""What a state knows of whole levels: which are there entirely, and of which there is nothing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..entropy.dequantize import UNANNOUNCED
from ..grid.layout import Layout

__all__ = ["known_levels"]


def known_levels(layout: Layout, state: NDArray[np.int8], level: int) -> tuple[int, list[int]]:
    """The finest level up to which all details are known, and the levels without details, both at most ``level``.

    ``state`` is int8, shape (tile,). No level is without details where sides come from interfaces, which tell those
    along them.
    """
    starts = layout.starts[: level + 1]
    own = state[: layout.tiles_of(level).stop]
    if not own.any():
        return level, []
    unknown = np.flatnonzero(np.maximum.reduceat(own, starts)[1:])
    whole = int(unknown[0]) if unknown.size else level
    if layout.shared:
        return whole, []
    nothing = np.minimum.reduceat(own, starts)[1:] >= UNANNOUNCED
    bare: list[int] = (np.flatnonzero(nothing) + 1).tolist()
    return whole, bare
