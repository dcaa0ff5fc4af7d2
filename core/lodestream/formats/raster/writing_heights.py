"""Checks of formats for height fields, and notes of what they cannot hold."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...coordinates.height_fields import coordinates, to_heights
from ...errors import FormatError
from ...scratch import rows_at_once
from ...surface import Surface
from ..notes import warn

__all__ = ["even_heights", "geotransform", "warn_off"]

#: How far a coordinate may be from the affine rule that is written, in steps of the grid, before it is worth a note.
_OFF = 1e-6


def even_heights(surface: Surface, title: str) -> Surface:
    """Return the surface as heights over an even lattice.

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
    return surface


def geotransform(surface: Surface) -> Sequence[float] | None:
    """Return the affine rule nearest to the places of heights, six numbers in GDAL's order; None for mere indices."""
    metadata, (rows, columns) = surface.metadata, surface.shape
    if metadata.get("geotransform") is not None and "nodes" not in metadata:
        coordinates(surface, slice(0, 1))  # refuses what is none
        return [float(value) for value in metadata["geotransform"]]
    if not {"grid", "axes", "nodes"} & metadata.keys():
        return None
    coordinates(surface, slice(0, 1))  # refuses angles that are no rules
    transform, unwrapped = [], _unwrapped(surface)
    for first, last in zip(
        *(coordinates(unwrapped, edge) for edge in (slice(0, 1), slice(rows - 1, rows))), strict=True
    ):
        origin = float(first[0, 0])
        across = (float(first[0, -1]) - origin) / max(columns - 1, 1)
        down = (float(last[0, 0]) - origin) / max(rows - 1, 1)
        transform += [origin - (across + down) / 2, across, down]
    return transform


def _unwrapped(surface: Surface) -> Surface:
    """Return heights with longitudes that do not jump, as an affine rule has them."""
    metadata = {key: value for key, value in surface.metadata.items() if key != "angles"}
    return Surface(surface.points, mask=surface.mask, metadata=metadata)


def warn_off(surface: Surface, transform: Sequence[float], title: str) -> None:
    """Note how far the cells are from the places of the heights."""
    if not {"grid", "axes", "nodes"} & surface.metadata.keys():
        return
    exact = _unwrapped(surface)
    affine = Surface(surface.points, mask=surface.mask, metadata={"geotransform": transform})
    away = [0.0, 0.0]
    for rows in rows_at_once(surface.shape):
        pairs = zip(coordinates(affine, rows), coordinates(exact, rows), strict=True)
        away = [max(most, float(np.abs(is_ - was).max())) for most, (is_, was) in zip(away, pairs, strict=True)]
    for name, off, steps in zip("xy", away, (transform[1:3], transform[4:6]), strict=True):
        if off > _OFF * max(map(abs, steps)):
            warn(f"{title} assumes evenly spaced rows and columns: {name} changes by up to {off:.3g}")
