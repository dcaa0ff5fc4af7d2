"""Values of a surface that a container does not keep."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..surface import Block, Surface

__all__ = ["at_holes"]

#: Names in a note, and characters of each.
_MOST_NAMES = 12
_LONGEST_NAME = 60

_MORE_CHANNELS = "channels beyond the third"


def at_holes(surface: Surface) -> str | None:
    """Describe in one line which attributes have values at holes of the points, which no container keeps.

    NaN, 0 and the metadata's ``nodata`` do not count as values. Returns None if nothing is lost.
    """
    nodata = surface.metadata.get("nodata")
    lost: dict[str, int] = {}
    for block in surface.blocks:
        holes = _holes(block)
        if holes is None:
            continue
        arrays = dict(block.attributes)
        if block.points.ndim == 3 and block.points.shape[2] > 3:
            arrays = {_MORE_CHANNELS: block.points[..., 3:], **arrays}
        for name, values in arrays.items():
            lost[name] = lost.get(name, 0) + _count_values(values[holes], nodata)
    names = [name for name, count in lost.items() if count]
    if not names:
        return None
    shown = ", ".join(_short(name) for name in names[:_MOST_NAMES])
    more = f" and {len(names) - _MOST_NAMES:,} more" if len(names) > _MOST_NAMES else ""
    count = max(lost.values())
    return f"values of attributes at {count:,} hole{'s' * (count > 1)} of the points left out: {shown}{more}"


def _holes(block: Block) -> NDArray[np.bool_] | None:
    """Return the holes whose values are lost, shape (H, W); None where there are none."""
    if block.mask is None:
        return None
    return ~block.mask if block.kept is None else ~(block.mask | block.kept)


def _count_values(values: NDArray[np.generic], nodata: object) -> int:
    """Count the holes, axis 0, whose value is not NaN, zero or the file's nodata value."""
    valued = (values != 0) & (values == values)
    if isinstance(nodata, int | float):
        valued &= values != nodata
    return int(valued.reshape(len(values), -1).any(axis=1).sum()) if len(values) else 0


def _short(name: str) -> str:
    line = "".join(character if character.isprintable() else " " for character in name)
    return line if len(line) <= _LONGEST_NAME else f"{line[: _LONGEST_NAME - 3]}..."
