"""How errors of quantized coefficients add up in the surface, which the encoder minimises in place of their squares.

Synthesis functions of neighbours in a band overlap, so the sum of squares over the surface is a quadratic form of a
band's errors: e G e, where G holds the inner products of its synthesis functions before the third step. Far from the
ends G is a convolution along each axis, and a product of a causal filter and its mirror image: e G e is g times the sum
of squares of ``e_k + f_1 e_{k-1} + f_2 e_{k-2} + ...``, along both axes one after the other. So what counts is the
error of a coefficient plus what is *fed back* of those that were quantized before it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..entropy.tiles import TileTable
from ..quantization.band_steps import Quantiser, band_step, lifting_steps_along

__all__ = ["FILTERS", "feedback_rules"]

#: Of nodes and of details, by the axis's lifting steps from there to the finest level: f_1, f_2 and g; with further
#: ones the same filter, and g doubles with each.
FILTERS = np.array(
    [
        [(0, 0, 1), (0.1716, 0, 1.4571), (0.2404, 0, 2.5997), (0.2608, 0, 5.0327), (0.2661, 0, 9.9806)],
        [
            (0, 0, 1),
            (-0.1716, 0.0294, 0.6863),
            (-0.2713, 0.0637, 0.82),
            (-0.3214, 0.0808, 1.3535),
            (-0.3374, 0.0863, 2.561),
        ],
    ]
)


def feedback_rules(table: TileTable, quantiser: Quantiser) -> NDArray[np.float32]:
    """Return the rules of each band for `kernels.choose`.

    Returns
    -------
    float32, shape (band, 6)
        How far below an index its point lies in the odd quantiser, and the weight of a squared error, both in
        quantization steps; f_1 and f_2 along axis 0; f_1 and f_2 along axis 1. A weight of one is that of a squared
        error of `Quantiser.base` in one point of the surface.
    """
    layout, (classes, of_band) = table.layout, table.classes()
    rules = []
    for level, grid, kind in classes:
        step = band_step(level, grid, kind, layout, quantiser)
        weight, taps = (step / quantiser.base) ** 2, []
        for axis in range(2):
            count, detail = lifting_steps_along(level, grid, kind[axis], layout, axis)
            alone = layout.grids[grid].interface and axis == 1
            first, second, gain = _alone(count) if alone else _filter(count, detail)
            weight *= gain
            taps += [first, second]
        rules.append(((step + 1) // 2 / step, weight, *taps))
    return np.array(rules, np.float32).reshape(-1, 6)[of_band]


def _filter(count: int, detail: bool) -> tuple[float, float, float]:
    known = min(count, FILTERS.shape[1] - 1)
    first, second, gain = FILTERS[int(detail), known].tolist()
    return first, second, gain * 2.0 ** (count - known)


def _alone(count: int) -> tuple[float, float, float]:
    """Return the squared norm of the synthesis function of a node without neighbours."""
    return 0.0, 0.0, (2.0 * 4.0**count + 1.0) / (3.0 * 2.0**count)
