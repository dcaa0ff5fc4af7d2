"""Geotransforms of coarser levels."""

from __future__ import annotations

from collections.abc import Sequence

from ..surface import Closed

__all__ = ["even_step", "level_geotransform"]

#: Geotransform of heights without a position: coordinates are their indices.
_INDICES = (-0.5, 1.0, 0.0, -0.5, 0.0, 1.0)


def even_step(length: int, nodes: int, closed: bool) -> float:
    """Return the samples of the full axis from one node of a level to the next, if all steps were equal.

    A closed axis of n nodes has n intervals, which make one turn; an open one has n - 1, from end to end.
    """
    return length / nodes if closed else (length - 1) / max(nodes - 1, 1)


def level_geotransform(
    transform: Sequence[float] | None, shape: tuple[int, int], coarse: tuple[int, int], closed: Closed
) -> list[float]:
    """Return the geotransform of a level's grid, as if its nodes were evenly spaced (true where no axis has a gap).

    Parameters
    ----------
    transform : six floats in GDAL's order, or None
        Of the full grid. It refers to cell corners: point (0, 0) lies half a cell from the first number.
    shape, coarse : (int, int)
        Rows and columns of the full grid and of the level's.
    closed : (bool, bool)

    Returns
    -------
    list of six floats
    """
    x0, x_column, x_row, y0, y_column, y_row = transform or _INDICES
    down, across = (even_step(*axis) for axis in zip(shape, coarse, closed, strict=True))
    x0 += 0.5 * x_column * (1 - across) + 0.5 * x_row * (1 - down)
    y0 += 0.5 * y_column * (1 - across) + 0.5 * y_row * (1 - down)
    return [x0, x_column * across, x_row * down, y0, y_column * across, y_row * down]
