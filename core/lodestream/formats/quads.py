"""Points and faces of a surface as a mesh, for the formats that hold meshes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..surface import Surface

__all__ = ["columns", "edges", "quads"]


def columns(surface: Surface) -> list[NDArray[Any]]:
    """Coordinates and attributes of the points in row order, an array of length H * W each.

    Heights are drawn over x and y: those of the centres of the cells where a ``geotransform`` says where they are, else
    x = column and y = row. Planar points get z = 0.
    """
    points = surface.points
    rows, width = surface.shape
    if points.ndim == 3:
        result = [points[:, :, channel].reshape(-1) for channel in range(points.shape[2])]
        return result if len(result) > 2 else [*result, np.zeros(rows * width, points.dtype)]
    row, column = (index.reshape(-1) for index in np.indices((rows, width)))
    transform = surface.metadata.get("geotransform")
    if transform is None:
        return [column, row, points.reshape(-1)]
    try:
        x0, x_column, x_row, y0, y_column, y_row = map(float, transform)
    except (TypeError, ValueError):
        raise InputError(f"expected a geotransform of six numbers in the metadata, got {transform!r}") from None
    return [
        x0 + (column + 0.5) * x_column + (row + 0.5) * x_row,
        y0 + (column + 0.5) * y_column + (row + 0.5) * y_row,
        points.reshape(-1),
    ]


def quads(surface: Surface) -> NDArray[np.int64]:
    """Quads of the grid in row order, as an (F, 4) array of 0-based indices of points, all wound the same way.

    A closed axis is joined by faces when it has at least three points: with two, they would lie on those already there.
    """
    rows, width = surface.shape
    wraps_rows, wraps_columns = _wraps(surface)
    r = np.arange(rows if wraps_rows else rows - 1)[:, None]
    c = np.arange(width if wraps_columns else width - 1)[None, :]
    below, right = (r + 1) % rows, (c + 1) % width
    corners = (r * width + c, r * width + right, below * width + right, below * width + c)
    return np.stack(corners, axis=-1).reshape(-1, 4)


def edges(surface: Surface) -> NDArray[np.int64]:
    """Edges of a curve, whose grid has a single row or column and so no quads, as an (E, 2) array of indices."""
    count = max(surface.shape)
    wraps = _wraps(surface)[surface.shape.index(count)]
    start = np.arange(count if wraps else count - 1)
    return np.stack((start, (start + 1) % count), axis=-1)


def _wraps(surface: Surface) -> tuple[bool, bool]:
    rows, width = surface.shape
    return surface.closed[0] and rows > 2, surface.closed[1] and width > 2
