"""A value that marks holes although its file does not say so, as with ``gdal_translate -a_nodata``."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import OptionError
from ..scratch import Room, rows_at_once
from ..surface import Block, Surface
from .notes import warn
from .source import number

__all__ = ["checked", "with_nodata"]

_WHOLE = re.compile(r"[-+]?[0-9]{1,20}")


def checked(value: object) -> int | float:
    """Return the number in `value`, a number or its text; NaN and infinities are allowed.

    Raises
    ------
    OptionError
        If it is none.
    """
    text = str(value).strip()
    if _WHOLE.fullmatch(text):
        return int(text)  # exactly, though float64 has not all integers of 64 bits
    try:
        return float(text)
    except ValueError:
        raise OptionError(f"nodata must be a number or nan, and is {str(value)[:80]!a}") from None


def with_nodata(surface: Surface, nodata: int | float, room: Room) -> Surface:
    """Turn points with the value `nodata` into holes, and issue a note of their number.

    Values are compared in their own type. A height is a hole if it has the value. A point of several coordinates is one
    if all of them have it (a depth camera's 0, 0, 0). Where no point does, z counts: x and y are kept there in
    floating-point numbers, see `Block.kept`.

    Parameters
    ----------
    surface : Surface
        As a reader returns it, of any number of blocks.
    nodata : int or float
    room : Room
        Where large arrays go.

    Returns
    -------
    Surface
        With `nodata` in the metadata, if these are heights whose file declares none.

    Raises
    ------
    InputError
        If no point of a block is left.
    """
    value = _of_type(nodata, surface.dtype)
    channels = 1 if surface.blocks[0].points.ndim == 2 else min(surface.blocks[0].points.shape[2], 3)
    count = known = 0
    blocks = surface.blocks
    if value is not None:
        by_z = channels == 3 and not any(_occurs_in_all(block.points, value) for block in blocks)
        results = [_masked(block, value, by_z, room) for block in blocks]
        blocks = tuple(block for block, _, _ in results)
        count, known = sum(new for _, new, _ in results), sum(old for _, _, old in results)
    total = number(sum(block.shape[0] * block.shape[1] for block in blocks))
    if count:
        warn(f"nodata={nodata} masks {number(count)} of {total} points")
    elif known:
        words = "has this value and is a hole" if known == 1 else "have this value and are holes"
        warn(f"nodata={nodata} masks nothing more: {number(known)} of {total} points {words}")
    else:
        warn(f"nodata={nodata} masks nothing: none of {total} points has this value")
    if not count:
        return surface
    metadata = dict(surface.metadata)
    if channels == 1:
        # In the form that MessagePack and JSON hold: there is no NaN, and no larger integer.
        plain = float(nodata) if abs(nodata) >= 2**63 else nodata
        metadata.setdefault("nodata", plain if math.isfinite(plain) else str(plain))
    result = Surface(blocks=blocks, metadata=metadata)
    result.joints = surface.joints
    return result


def _of_type(nodata: int | float, dtype: np.dtype[Any]) -> Any:
    """Return the number in the type of the values; None if the type does not have it."""
    if dtype.kind == "f":
        try:
            with np.errstate(over="ignore"):
                value = dtype.type(nodata)
        except OverflowError:
            return None
        return value if np.isfinite(value) == math.isfinite(nodata) else None
    limits = np.iinfo(dtype)
    if not math.isfinite(nodata) or nodata != int(nodata) or not limits.min <= nodata <= limits.max:
        return None
    return dtype.type(int(nodata))


def _equal(values: NDArray[Any], value: Any) -> NDArray[np.bool_]:
    """Return whether each value, of an array of any shape, equals this one; NaN equals NaN."""
    return np.isnan(values) if value != value else np.asarray(values == value)


def _in_all(points: NDArray[Any], value: Any) -> NDArray[np.bool_]:
    """Return whether all coordinates of points, shape (row, column) or (row, column, channel), have this value."""
    return _equal(points, value) if points.ndim == 2 else np.asarray(_equal(points[..., :3], value).all(axis=2))


def _occurs_in_all(points: NDArray[Any], value: Any) -> bool:
    return any(bool(_in_all(points[rows], value).any()) for rows in rows_at_once(points.shape))


def _masked(block: Block, value: Any, by_z: bool, room: Room) -> tuple[Block, int, int]:
    """Return the block with its new holes, their number, and the number of such points that were holes before."""
    points = block.points
    mask = room.empty(block.shape, np.bool_)
    count = known = 0
    for rows in rows_at_once(points.shape):
        marked = _equal(points[rows][..., 2], value) if by_z else _in_all(points[rows], value)
        valid = np.ones(marked.shape, np.bool_) if block.mask is None else block.mask[rows]
        count += int(np.count_nonzero(marked & valid))
        known += int(np.count_nonzero(marked & ~valid))
        mask[rows] = valid & ~marked
    if not count:
        return block, 0, known
    if by_z and points.dtype.kind == "f":
        points = room.empty(points.shape, points.dtype)
        for rows in rows_at_once(points.shape):
            points[rows] = block.points[rows]
            points[rows][..., 2][_equal(block.points[rows][..., 2], value) & ~mask[rows]] = np.nan
    return Block(points, block.closed, mask=mask, attributes=block.attributes), count, known
