"""The geotransform of a grid mapping, as GDAL and rioxarray have it, where it says every coordinate of heights."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...coordinates.height_fields import coordinates
from ...scratch import rows_at_once
from ...surface import Surface
from .values import Values

__all__ = ["by_geotransform", "transform_of"]

#: How far a geotransform may be from coordinates, in cells, until it says something else: files round both.
_NEAR = 0.01


def transform_of(attributes: Mapping[str, Any]) -> list[float] | None:
    """Return the six numbers of the geotransform in the attributes of a grid mapping; None: it says none."""
    try:
        transform = [float(number) for number in str(attributes["GeoTransform"]).split()]
    except (KeyError, ValueError):
        return None
    return transform if len(transform) == 6 and all(map(math.isfinite, transform)) else None


def by_geotransform(surface: Surface, heights: Values, transform: list[float]) -> tuple[Surface, str | None]:
    """Give heights the geotransform of their grid mapping, if it says every coordinate bit for bit.

    Parameters
    ----------
    surface : Surface
        Heights over the coordinates of the file, or x, y, z.
    heights : Values
        Those of the file, shape (H, W).
    transform : list of float

    Returns
    -------
    surface : Surface
        The same one where the geotransform says other coordinates.
    note : str or None
        How far it is from them, if that is no rounding. GDAL writes rows from the south beside a geotransform from
        the north, which says the same; and of a part of a Dataset it is that of the whole.
    """
    if surface.shape != heights.array.shape:
        return surface, None
    height = surface.shape[0]
    turned = [transform[0] + height * transform[2], transform[1], -transform[2]]
    turned += [transform[3] + height * transform[5], transform[4], -transform[5]]
    offsets = _offsets(surface, transform)
    if any(offsets):
        near = [it for it in (offsets, _offsets(surface, turned)) if not _is_whole(it)]
        away = min(max(map(abs, it)) for it in near) if len(near) == 2 else 0.0
        words = f"left out a GeoTransform that lies elsewhere than x and y, by {away:.3g} cells"
        return surface, words if away > _NEAR else None
    # Axes are kept where they say a type, which a geotransform does not.
    typed = "dtype" in surface.metadata.get("axes", ())
    metadata = {key: value for key, value in surface.metadata.items() if key != "axes" or typed}
    metadata["geotransform"] = transform
    points, mask = (surface.points, surface.mask) if surface.points.ndim == 2 else (heights.array, heights.valid)
    attributes = surface.attributes
    return Surface(points, surface.closed, mask=mask, attributes=attributes, metadata=metadata), None


def _is_whole(offsets: Sequence[float]) -> bool:
    """Return whether all points are off by the same whole columns and rows, as those of a part of a grid."""
    left, right, top, bottom = offsets
    even = all(map(math.isfinite, offsets)) and max(right - left, bottom - top) <= _NEAR
    return even and max(abs(left - round(left)), abs(top - round(top))) <= _NEAR


@np.errstate(over="ignore", invalid="ignore")
def _offsets(surface: Surface, transform: list[float]) -> tuple[float, float, float, float]:
    """By how many columns and rows of a geotransform points are off: least and greatest of each.

    A geotransform of absurd numbers overflows, and is off by an infinite number.
    """
    (_, right_x, down_x), (_, right_y, down_y) = transform[:3], transform[3:]
    area = right_x * down_y - down_x * right_y
    if not area or not math.isfinite(area):
        return math.inf, math.inf, math.inf, math.inf
    ends = [math.inf, -math.inf, math.inf, -math.inf]
    for rows in rows_at_once(surface.shape):
        x, y = _of_rows(surface, {"geotransform": transform}, rows)
        if surface.points.ndim == 2:
            given = _of_rows(surface, surface.metadata, rows)
            east, north = given[0] - x, given[1] - y
        else:
            valid = ... if surface.mask is None else surface.mask[rows]
            points = surface.points[rows].astype(np.float64)[valid]
            east, north = points[..., 0] - x[valid], points[..., 1] - y[valid]
        offsets = (down_y * east - down_x * north) / area, (right_x * north - right_y * east) / area
        for axis, steps in enumerate(offsets):
            if steps.size:
                ends[2 * axis] = min(ends[2 * axis], float(steps.min()))
                ends[2 * axis + 1] = max(ends[2 * axis + 1], float(steps.max()))
    return ends[0], ends[1], ends[2], ends[3]


def _of_rows(surface: Surface, metadata: Mapping[str, Any], rows: slice) -> tuple[NDArray[Any], NDArray[Any]]:
    """x and y that metadata say of some rows of heights, shape (row, column)."""
    lines = [*range(rows.start, rows.stop), rows.stop]  # a surface has two points or more
    places = {**metadata, "nodes": [lines, list(range(surface.shape[1]))]}
    nothing = np.broadcast_to(np.zeros((), surface.dtype), (len(lines), surface.shape[1]))
    x, y = coordinates(Surface(nothing, metadata=places))
    return x[:-1], y[:-1]
