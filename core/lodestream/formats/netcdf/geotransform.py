"""The geotransform of a grid mapping, as GDAL and rioxarray have it, where it says every coordinate of heights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...coordinates.height_fields import coordinates
from ...scratch import rows_at_once
from ...surface import Surface
from .values import Values

__all__ = ["by_geotransform"]


def by_geotransform(surface: Surface, heights: Values, attributes: Mapping[str, Any]) -> Surface:
    """Give heights the geotransform of their grid mapping, if it says every coordinate bit for bit.

    Parameters
    ----------
    surface : Surface
        Heights over the coordinates of the file, or x, y, z.
    heights : Values
        Those of the file, shape (H, W).
    attributes : mapping
        Of the grid mapping.

    Returns
    -------
    Surface
        The same one where there is no such geotransform.
    """
    try:
        transform = [float(number) for number in str(attributes["GeoTransform"]).split()]
    except (KeyError, ValueError):
        return surface
    if len(transform) != 6 or surface.shape != heights.array.shape or not _lies_at(surface, transform):
        return surface
    metadata = {key: value for key, value in surface.metadata.items() if key != "axes"} | {"geotransform": transform}
    points, mask = (surface.points, surface.mask) if surface.points.ndim == 2 else (heights.array, heights.valid)
    return Surface(points, surface.closed, mask=mask, attributes=surface.attributes, metadata=metadata)


def _lies_at(surface: Surface, transform: list[float]) -> bool:
    """Whether a geotransform says every coordinate; some rows at a time, of which there may be many."""
    for rows in rows_at_once(surface.shape):
        told = _of_rows(surface, {"geotransform": transform}, rows)
        if surface.points.ndim == 2:
            given, valid = _of_rows(surface, surface.metadata, rows), None
        else:
            given = surface.points[rows, :, 0], surface.points[rows, :, 1]
            valid = None if surface.mask is None else surface.mask[rows]
        if not all(((a == b) | (False if valid is None else ~valid)).all() for a, b in zip(given, told, strict=True)):
            return False
    return True


def _of_rows(surface: Surface, metadata: Mapping[str, Any], rows: slice) -> tuple[NDArray[Any], NDArray[Any]]:
    """x and y that metadata say of some rows of heights, shape (row, column)."""
    lines = [*range(rows.start, rows.stop), rows.stop]  # a surface has two points or more
    places = {**metadata, "nodes": [lines, list(range(surface.shape[1]))]}
    nothing = np.broadcast_to(np.zeros((), surface.dtype), (len(lines), surface.shape[1]))
    x, y = coordinates(Surface(nothing, metadata=places))
    return x[:-1], y[:-1]
