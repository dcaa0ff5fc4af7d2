"""Quantization steps of bands, for a stream that is encoded for one RMS error, in place of lattice steps.

Each band has a step, so that one of any coefficient changes the surface by about as much. What is coded, plane by
plane, are the *indices*: a coefficient is its index times its band's step.

A *trellis* of dependent quantisation halves the distance between values without longer indices. There are two
quantisers, the even and the odd multiples of half a step, 0 in both. Which one applies to a coefficient follows from
the parity of the indices before it, as in JPEG 2000 part 2 and H.266; the states are those of the latter's successor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..grid.layout import Layout

__all__ = ["MOST_BASE", "ODD", "TRANSITIONS", "Quantiser", "band_step", "lifting_steps_along"]

#: Largest `Quantiser.base`.
MOST_BASE = (1 << 24) - 1

#: The state after an even and after an odd index, by the state before; every band of a tile begins in state 0.
TRANSITIONS = np.array([[0, 2], [5, 7], [1, 3], [6, 4], [2, 0], [4, 6], [3, 1], [7, 5]], np.int64)
#: Whether a coefficient is one of the odd multiples, by the state before it.
ODD = np.array([0, 1, 0, 1, 0, 1, 0, 1], np.int64)

#: Of a node and of a detail along an axis: 2**16 over the norm of its synthesis function with the four-point rule, by
#: the axis's lifting steps from there to the finest level; further ones halve it for each two of them.
_ALONG = np.array([[65536, 53303, 39201, 27993, 19842, 14039], [65536, 77936, 69201, 52586, 37885, 26915]], np.int64)


@dataclass(frozen=True)
class Quantiser:
    """How the coordinates of a stream are quantized.

    Attributes
    ----------
    base : int
        The quantization step of a coefficient that changes one point alone, in lattice steps; 1 to 2**24 - 1.
    """

    base: int


def band_step(level: int, grid: int, kind: tuple[bool, bool], layout: Layout, quantiser: Quantiser) -> int:
    """Return the quantization step of bands of a level, grid and kind, in lattice steps; 1 to 2**26 - 1."""
    product = quantiser.base
    for axis in range(2):
        product *= _along(*lifting_steps_along(level, grid, kind[axis], layout, axis))
    return max(1, product >> 32)


def lifting_steps_along(level: int, grid: int, detail: bool, layout: Layout, axis: int) -> tuple[int, bool]:
    """Count the lifting steps along an axis from bands of a level to the finest; say whether they are details there.

    Across its line, an interface counts as a node, because its points change the patches beside it.
    """
    first = max(level, 1)
    if layout.grids[grid].interface and axis == 1:
        return layout.levels + 1 - first, False
    levels = range(first, layout.levels + 1)
    return sum(1 for k in levels if layout.steps(grid, k)[axis].midpoints), detail


def _along(count: int, detail: bool) -> int:
    """Return 2**16 over the norm of a synthesis function after ``count`` lifting steps along an axis."""
    halvings = max(0, (count - 4) // 2)
    return int(_ALONG[int(detail), count - 2 * halvings]) >> halvings
