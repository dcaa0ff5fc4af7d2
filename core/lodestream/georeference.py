"""Where the nodes of a coarser level lie on the map."""

from __future__ import annotations

from collections.abc import Sequence

from .surface import Closed

__all__ = ["level_geotransform"]

#: Heights without a place of their own are drawn over their indices.
_INDICES = (-0.5, 1.0, 0.0, -0.5, 0.0, 1.0)


def level_geotransform(
    transform: Sequence[float] | None, shape: tuple[int, int], coarse: tuple[int, int], closed: Closed
) -> list[float]:
    """The geotransform of a level's grid.

    Node j of an axis stands where the full grid has (N - 1) / (n - 1) j: exactly so without a gap, and within a cell of
    the level with one.

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
