"""Write PLOT3D: a grid file of one or several blocks, as Fortran's unformatted output, with IBLANK where needed.

Source: as of `layouts`.
"""

from __future__ import annotations

from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...coordinates.height_fields import coordinates
from ...errors import FormatError
from ...surface import Block, Surface
from ..closing import wrapped_ends, wraps
from ..mesh_output import exact_float
from ..notes import metadata_left_out, warn, warn_left_out
from ..source import number

__all__ = ["SUFFIXES", "write"]

#: Names of binary files; .fmt is of text, and .xyz of points in any format.
SUFFIXES = (".p3d", ".x", ".g", ".grd", ".bin", ".ufmt", ".unf", ".plot3d")

_TITLE = "PLOT3D"
_PLACE = ("geotransform", "grid", "axes")
_IBLANK = "iblank"

#: A record's length is an integer of 32 bits.
_LONGEST = (1 << 31) - 1


def write(surface: Surface, file: BinaryIO) -> None:
    """Write a count of blocks, their sizes, and x, y and z of each, little-endian between record markers.

    i runs along the columns, j along the rows. Numbers are double where any is not held by single. Holes have IBLANK 0
    and the place of a point that is valid; an attribute ``iblank`` that agrees with them is written as it is.
    A closed axis repeats its first points at the end. Planar points make a grid of two dimensions. One block after the
    other is looked at, then written.

    Raises
    ------
    FormatError
        If integers need more than a double, or a block more bytes than a record may have.
    """
    dtypes, shapes, dimensions = [np.dtype(np.float32)], [], 0
    for block in surface.blocks:
        channels = _arrays(surface, block)
        dtypes += [channel.dtype for channel in channels]
        shapes.append(channels[0].shape)
        dimensions = len(channels)
    code = "<f8" if np.result_type(*dtypes) == np.float64 else "<f4"
    as_given = all(_given(block) is not None for block in surface.blocks)
    blanked = as_given or any(block.holes for block in surface.blocks)
    _warn_left_out(surface, as_given)
    sizes = [(columns, rows, 1)[:dimensions] for rows, columns in shapes]
    lengths = [4, 4 * dimensions * len(shapes)]
    for rows, columns in shapes:
        lengths.append(rows * columns * (dimensions * int(code[-1]) + 4 * blanked))
    if max(lengths) > _LONGEST:
        raise FormatError(f"expected blocks of at most {number(_LONGEST)} bytes for PLOT3D, got {number(max(lengths))}")
    _write_record(file, lengths[0], np.array([len(shapes)], "<i4"))
    _write_record(file, lengths[1], np.array(sizes, "<i4"))
    for block, length in zip(surface.blocks, lengths[2:], strict=True):
        arrays = [channel.astype(code) for channel in _arrays(surface, block)]
        if blanked:
            arrays.append(_blanks(block, as_given).astype("<i4"))
        _write_record(file, length, *arrays)


def _write_record(file: BinaryIO, length: int, *arrays: NDArray[Any]) -> None:
    marker = length.to_bytes(4, "little")
    file.write(marker)
    for array in arrays:
        file.write(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data)
    file.write(marker)


def _arrays(surface: Surface, block: Block) -> list[NDArray[Any]]:
    """Return x, y and z of a block with its closed axes repeated, (rows, columns) each; x and y of planar points."""
    points = block.points
    if points.ndim == 2:
        channels: list[NDArray[Any]] = [*coordinates(surface), points]
    else:
        channels = [points[..., channel] for channel in range(min(points.shape[2], 3))]
    arrays = []
    for values, axis in zip(channels, "xyz", strict=False):
        values = exact_float(values, axis, _TITLE)
        if block.mask is not None and block.holes:
            values = np.where(block.mask, values, values[block.mask][0])
        arrays.append(wrapped_ends(values, block))
    return arrays


def _blanks(block: Block, as_given: bool) -> NDArray[Any]:
    """Return IBLANK of a block: its attribute, or 0 in holes."""
    values = _given(block) if as_given else None
    if values is None:
        values = np.ones(block.shape, np.int32) if block.mask is None else block.mask.astype(np.int32)
    return wrapped_ends(values, block)


def _given(block: Block) -> NDArray[Any] | None:
    """Return the attribute ``iblank`` if it is 0 in holes and nowhere else."""
    values = block.attributes.get(_IBLANK)
    if values is None or values.ndim != 2 or values.dtype.kind not in "iu":
        return None
    limits = np.iinfo(np.int32)
    if values.min() < limits.min or values.max() > limits.max:
        return None
    valid = np.ones(block.shape, np.bool_) if block.mask is None else block.mask
    # Holes have no values in a container; a point that says 0 would become one.
    return np.where(valid, values, 0) if (values[valid] != 0).all() else None


def _warn_left_out(surface: Surface, with_iblank: bool) -> None:
    first = surface.blocks[0]
    channels = first.points.shape[2] if first.points.ndim == 3 else 3
    names = [name for name in first.attributes if not (with_iblank and name == _IBLANK)]
    names += [f"channel {channel}" for channel in range(3, channels)]
    warn_left_out(_TITLE, [*names, *metadata_left_out(surface, _PLACE)])
    if any(wraps(block) != tuple(block.closed) for block in surface.blocks):
        warn("PLOT3D is written with open axes in place of closed ones of fewer than 3 points")
