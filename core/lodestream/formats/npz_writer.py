"""Write NPZ: points, their places, the mask of holes and attributes, each as an array of its own."""

from __future__ import annotations

import re
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..coordinates.height_fields import coordinates
from ..surface import Surface
from .archives import new_archive, new_member
from .notes import listing, metadata_left_out, warn, warn_left_out
from .npy import with_holes, write_array

__all__ = ["COORDINATES", "HEIGHTS", "MASK", "POINTS", "WORDS", "write"]

#: Names of the arrays of a surface: heights (H, W), or points (H, W, C); where a point is no hole, bool (H, W).
HEIGHTS, POINTS, MASK = "heights", "points", "mask"

#: What x and y are called in archives: no attribute may have such a name, or it would be read as one of them.
COORDINATES = {"x": ("x", "lon", "longitude", "easting"), "y": ("y", "lat", "latitude", "northing")}

#: Texts of the metadata that are arrays too, of one element.
WORDS = ("crs", "unit")

_PLACE = ("geotransform", "grid", "axes")

#: What a name of a member may hold: no way out of the folder that an archive is unpacked in.
_UNSAFE = re.compile(r"[^\w .+-]|^\.+")


def write(surface: Surface, file: BinaryIO) -> None:
    """Write ``heights`` with ``x`` and ``y``, or ``points``; ``mask``, ``crs``, ``unit``, attributes by their names.

    x and y are vectors where a vector says every coordinate bit for bit, else arrays of shape (H, W). Holes of
    floating-point numbers are NaN; ``mask`` is False there.
    """
    heights = surface.points.ndim == 2
    arrays: dict[str, NDArray[Any]] = {HEIGHTS if heights else POINTS: with_holes(surface)}
    if heights and any(surface.metadata.get(key) is not None for key in _PLACE):
        for name, plane, axis in zip("xy", coordinates(surface), (1, 0), strict=True):
            arrays[name] = _vector(plane, axis)
    if surface.mask is not None:
        arrays[MASK] = surface.mask
    held = [key for key in WORDS if isinstance(surface.metadata.get(key), str)]
    arrays |= {key: np.array(surface.metadata[key]) for key in held}
    renamed, kept = [], {HEIGHTS, POINTS, *COORDINATES["x"], *COORDINATES["y"]}
    for name, values in surface.attributes.items():
        free = _UNSAFE.sub("_", name)
        while free in arrays or free.lower() in kept:
            free += "_"
        arrays[free] = values
        renamed += [f"{name} as {free}"] * (free != name)
    if renamed:
        warn(f"NPZ is written with the attribute {listing(renamed)}")
    closed = ["closure"] * any(surface.closed)
    warn_left_out("NPZ", [*closed, *metadata_left_out(surface, (*held, *_PLACE))])
    with new_archive(file) as archive:
        for name, values in arrays.items():
            with new_member(archive, f"{name}.npy") as member:
                write_array(member, values)


def _vector(plane: NDArray[Any], axis: int) -> NDArray[Any]:
    """Return one line of a coordinate (H, W) along an axis, if all lines are equal; else all of it."""
    line = plane[0] if axis == 1 else plane[:, 0]
    whole = np.broadcast_to(line[None, :] if axis == 1 else line[:, None], plane.shape)
    return np.ascontiguousarray(line if plane.tobytes() == whole.tobytes() else plane)
