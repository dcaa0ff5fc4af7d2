"""Where the nodes of a coarser level lie on the map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..grid.axis import axis_lengths, axis_step
from ..surface import Closed

__all__ = ["has_gap", "level_coordinates", "level_geotransform"]

#: h_j of the update step, as many as matter in float64.
_UPDATE = (1.0 - 1.0 / np.sqrt(2.0)) * (2.0 * np.sqrt(2.0) - 3.0) ** np.arange(24)

#: Heights without a place of their own are drawn over their indices.
_INDICES = (-0.5, 1.0, 0.0, -0.5, 0.0, 1.0)


def level_geotransform(
    transform: Sequence[float] | None, shape: tuple[int, int], coarse: tuple[int, int], closed: Closed
) -> list[float]:
    """The geotransform of a level's grid.

    Node j of an axis stands where the full grid has (N - 1) / (n - 1) j: exactly so without a gap, and about there with
    one, see `level_coordinates`.

    Parameters
    ----------
    transform : six floats in GDAL's order, or None
        Of the full grid: cell corners, so that point (0, 0) lies half a cell from the first number.
    shape, coarse : (int, int)
        Rows and columns of the full grid and of the level's.
    closed : (bool, bool)
        A closed axis of n nodes has n intervals, an open one n - 1.

    Returns
    -------
    list of six floats
    """
    x0, x_column, x_row, y0, y_column, y_row = transform or _INDICES
    down, across = (
        full / nodes if wraps else (full - 1) / max(nodes - 1, 1)
        for full, nodes, wraps in zip(shape, coarse, closed, strict=True)
    )
    x0 += 0.5 * x_column * (1 - across) + 0.5 * x_row * (1 - down)
    y0 += 0.5 * y_column * (1 - across) + 0.5 * y_row * (1 - down)
    return [x0, x_column * across, x_row * down, y0, y_column * across, y_row * down]


def level_coordinates(length: int, closed: bool, halvings: int) -> NDArray[np.float64]:
    """Where the nodes of a coarser level lie along an axis, in indices of the full grid.

    The ramp 0, 1, 2, ... put through the same coarsening as the surface: evenly spaced unless the axis had a gap.

    Parameters
    ----------
    length : int
        Samples of the full axis.
    closed : bool
        The ramp then goes on after its end, one turn of ``length`` further.
    halvings : int
        How often the axis is coarsened; not at all once it has stopped.

    Returns
    -------
    float64 array of shape (node,)
        Increasing.
    """
    nodes = np.arange(length, dtype=np.float64)
    for _ in range(halvings):
        step = axis_step(len(nodes), closed)
        if not step.midpoints:
            break
        even, odd = nodes[0::2], nodes[1::2][: step.midpoints]
        after = np.append(even[1:], even[0] + length)[: step.midpoints]
        details = odd - (even[: step.midpoints] + after) / 2
        reach = len(_UPDATE)
        table = step.extension(reach)
        outside = table[:, 1] * details[table[:, 0]]
        extended = np.concatenate((outside[:reach], details, outside[reach:]))
        series = np.convolve(extended, np.concatenate((_UPDATE[::-1], _UPDATE)), "valid")
        nodes = np.append(even[: step.run] + series[: step.run], nodes[-1:] if step.tail else [])
    return nodes


def has_gap(length: int, closed: bool, halvings: int) -> bool:
    """Whether an axis that is coarsened so often has an interval without a midpoint on the way."""
    finer = axis_lengths(length, closed)[:0:-1][:halvings]
    return any(n % 2 == (1 if closed else 0) for n in finer)
