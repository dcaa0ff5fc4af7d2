"""Surfaces that go once around the Earth: closed where the step in longitude fits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..coordinates.seams import merge
from ..surface import Closed, Surface

__all__ = ["TURN", "close_around", "encircles"]

#: Degrees of a full turn.
TURN = 360.0

#: How far the step over the seam may be from the others, relative to them.
_TOLERANCE = 0.01

#: How much longer than the steps on both sides of it the step over the seam of a curvilinear grid may be.
_STRETCH = 1.5


def _fits(count: int, step: float) -> bool:
    """Whether so many steps are a full turn."""
    return count > 2 and abs(abs(count * step) - TURN) <= _TOLERANCE * abs(step)


def close_around(surface: Surface, longitude: tuple[int, float], closed: Closed | None) -> Surface:
    """Close the axis along which longitudes of a height field are evenly spaced, where they go around the Earth.

    Parameters
    ----------
    surface : Surface
        Heights over longitudes and latitudes.
    longitude : (int, float)
        The axis, and the step in degrees.
    closed : (bool, bool) or None
        What was said of the surface, which holds; None: nothing.

    Returns
    -------
    Surface
        With a last row or column that repeats the first merged into it, see `lodestream.coordinates.seams.merge`.
    """
    axis, step = longitude
    around: Closed = (axis == 0, axis == 1)
    if closed is not None:
        around = (around[0] and closed[0], around[1] and closed[1])
    if not any(around):
        return surface
    if _fits(surface.shape[axis] - 1, step):
        return merge(surface, around)
    if _fits(surface.shape[axis], step):
        mask, attributes = surface.mask, surface.attributes
        return Surface(surface.points, around, mask=mask, attributes=attributes, metadata=surface.metadata)
    return surface


def encircles(longitude: NDArray[np.float64], latitude: NDArray[np.float64], axis: int) -> bool:
    """Whether an axis of a curvilinear grid leads back to where it began.

    Parameters
    ----------
    longitude, latitude : arrays of shape (H, W)
        In degrees, wrapped or not; NaN where unknown.
    axis : {0, 1}

    Returns
    -------
    bool
        True when the last point of every line along the axis is as near to its first as neighbours there are, on the
        sphere; never for lines of fewer than five points, or that repeat their first.
    """
    if longitude.shape[axis] < 5:
        return False
    east, north = (np.moveaxis(np.radians(angle), axis, 0)[[-2, -1, 0, 1]] for angle in (longitude, latitude))
    points = np.stack((np.cos(east) * np.cos(north), np.sin(east) * np.cos(north), np.sin(north)))
    before, over, after = np.sqrt((np.diff(points, axis=1) ** 2).sum(axis=0))
    known = np.isfinite(before + over + after)
    close = over <= _STRETCH * np.maximum(before, after) + 1e-12
    return bool(known.any() and close[known].all() and over[known].max() > 1e-9)
