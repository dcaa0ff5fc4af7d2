"""Surfaces that go once around the Earth: closed where the step in longitude fits."""

from __future__ import annotations

from ..seams import merge
from ..surface import Closed, Surface

__all__ = ["TURN", "close_around", "fits"]

#: Degrees of a full turn.
TURN = 360.0

#: How far the step over the seam may be from the others, relative to them.
_TOLERANCE = 0.01


def fits(count: int, step: float) -> bool:
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
        With a last row or column that repeats the first merged into it, see `lodestream.seams.merge`.
    """
    axis, step = longitude
    around: Closed = (axis == 0, axis == 1)
    if closed is not None:
        around = (around[0] and closed[0], around[1] and closed[1])
    if not any(around):
        return surface
    if fits(surface.shape[axis] - 1, step):
        return merge(surface, around)
    if fits(surface.shape[axis], step):
        mask, attributes = surface.mask, surface.attributes
        return Surface(surface.points, around, mask=mask, attributes=attributes, metadata=surface.metadata)
    return surface
