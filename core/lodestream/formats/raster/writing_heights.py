"""What formats for height fields, GeoTIFF and PNG, need of a surface, and what they cannot say of it."""

from __future__ import annotations

from collections.abc import Sequence

from ...coordinates.height_fields import coordinates, to_heights
from ...errors import FormatError
from ...surface import Surface
from ..notes import warn

__all__ = ["even_heights", "geotransform"]


def even_heights(surface: Surface, title: str) -> Surface:
    """The surface as heights over an even lattice.

    Raises
    ------
    FormatError
        When it is none.
    """
    if surface.points.ndim == 3:
        heights = to_heights(surface)
        if heights is None and (heights := to_heights(surface, exactly=False)) is not None:
            warn(f"{title} takes x and y from an even grid: those of holes that are off this grid are left out")
        if heights is None:
            kind = "planar points" if surface.points.shape[2] == 2 else "x, y, z"
            raise FormatError(f"expected heights on an even grid for {title}, got {kind} that are not")
        surface = heights
    if "nodes" in surface.metadata:
        warn(f"{title} assumes evenly spaced rows and columns; those of this level are only nearly so")
    return surface


def geotransform(surface: Surface) -> Sequence[float] | None:
    """The affine rule nearest to where heights lie, six numbers in GDAL's order; None for mere indices."""
    metadata, (rows, columns) = surface.metadata, surface.shape
    if metadata.get("geotransform") is not None:
        coordinates(surface)  # refuses what is none
        return [float(value) for value in metadata["geotransform"]]
    if "grid" not in metadata and "axes" not in metadata:
        return None
    transform = []
    for plane in coordinates(surface):
        origin = float(plane[0, 0])
        across = (float(plane[0, -1]) - origin) / max(columns - 1, 1)
        down = (float(plane[-1, 0]) - origin) / max(rows - 1, 1)
        transform += [origin - (across + down) / 2, across, down]
    return transform
