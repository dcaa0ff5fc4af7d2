"""Height fields that go once around the Earth: closed if the step in longitude fits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..coordinates.seams import merge
from ..surface import Closed, Surface

__all__ = ["TURN", "close_around", "close_uneven", "encircles", "next_around"]

#: Degrees of a full turn.
TURN = 360.0

#: How far the step over the seam may be from the others, relative to them.
_TOLERANCE = 0.01

#: How far from a full turn, relative to it, rounded longitudes of one may end.
_ROUNDING = 1e-6

#: How much longer than the steps on both sides of it the step over the seam of a curvilinear grid may be.
_STRETCH = 1.5


def _fits(count: int, step: float) -> bool:
    """Return whether so many steps are a full turn."""
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
    return _closed(surface, axis, closed, _fits(surface.shape[axis] - 1, step), _fits(surface.shape[axis], step))


def close_uneven(surface: Surface, axis: int, longitudes: NDArray[np.float64], closed: Closed | None) -> Surface:
    """Close the axis along which longitudes of a height field are unevenly spaced, where they go around the Earth.

    Parameters
    ----------
    surface : Surface
        Heights over longitudes and latitudes.
    axis : {0, 1}
    longitudes : array of shape (N,)
        In degrees, wrapped or not, one for each place along the axis.
    closed : (bool, bool) or None
        What was said of the surface, which holds; None: nothing.

    Returns
    -------
    Surface
        As of `close_around`. The step over the seam may be as long as `encircles` allows.
    """
    unwrapped = np.unwrap(longitudes, period=TURN)
    repeats = abs(abs(unwrapped[-1] - unwrapped[0]) - TURN) <= TURN * _ROUNDING
    around = encircles(longitudes[None, :], np.zeros((1, len(longitudes))), 1)
    return _closed(surface, axis, closed, bool(repeats), around)


def next_around(longitudes: NDArray[np.float64]) -> float:
    """Return the first longitude in degrees, of shape (N,), shifted by whole turns to be nearest to the last one."""
    return float(np.unwrap([longitudes[-1], longitudes[0]], period=TURN)[1])


def _closed(surface: Surface, axis: int, closed: Closed | None, repeats: bool, around: bool) -> Surface:
    """Merge the last line of an axis that `repeats` its longitude, or close the axis, unless `closed` forbids it."""
    if closed is not None and not closed[axis]:
        return surface
    along: Closed = (axis == 0, axis == 1)
    if repeats:
        return merge(surface, along)
    if around:
        mask, attributes = surface.mask, surface.attributes
        return Surface(surface.points, along, mask=mask, attributes=attributes, metadata=surface.metadata)
    return surface


def encircles(longitude: NDArray[np.float64], latitude: NDArray[np.float64], axis: int) -> bool:
    """Return whether an axis of a curvilinear grid leads back to where it began.

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
