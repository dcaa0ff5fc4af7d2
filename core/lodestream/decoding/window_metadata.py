"""A window of a surface of one block: which of its axes wrap, and metadata that say where it lies."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..container.model import Header
from ..coordinates.height_fields import axes_at
from ..planning.selection import region_at
from ..surface import Closed
from ..target import Region
from .level_grids import level_nodes, level_positions

__all__ = ["positions", "window_closed", "window_metadata"]


def window_closed(closed: Closed, shape: tuple[int, int], region: Region) -> Closed:
    """Return which axes of a window wrap: those of the surface that the window holds whole."""
    rows, columns = (
        wraps and stop - start == length for wraps, (start, stop), length in zip(closed, region, shape, strict=True)
    )
    return rows, columns


def window_metadata(metadata: dict[str, Any], header: Header, region: Region, level: int) -> dict[str, Any]:
    """Return the metadata of a window of a level, whose geotransform, nodes and axes are moved with it.

    Across the seam of a closed axis all go on, beyond the end of the surface.

    Parameters
    ----------
    metadata : dict
        Of the whole surface, of one block.
    header : Header
    region : ((int, int), (int, int))
        Rows and columns, half-open, in full-resolution indices.
    level : int
    """
    placed = metadata
    if level < header.levels and header.point_channels == 1:
        placed = level_positions(metadata, header, level)
    values = {key: value for key, value in placed.items() if key not in ("seam", "turn", "poles", "nodes")}
    shape, inside = header.level_shape(level) or header.shape, region_at(header, region, level)
    (top, _), (left, _) = inside
    lines = [_line(*of) for of in zip(placed.get("nodes") or (None, None), inside, shape, strict=True)]
    if any(lines):
        values["nodes"] = lines
    if (transform := values.get("geotransform")) is not None:
        x0, x_column, x_row, y0, y_column, y_row = transform
        x0, y0 = x0 + left * x_column + top * x_row, y0 + left * y_column + top * y_row
        values["geotransform"] = [x0, x_column, x_row, y0, y_column, y_row]
    if "axes" in values:
        # Of the whole surface: a step of a level across the seam may be shorter than the others.
        closed = window_closed(header.closed, header.shape, region)
        values["axes"] = axes_at(metadata["axes"], header.shape, positions(header, region, level), closed)
    return values


def positions(header: Header, region: Region, level: int) -> list[NDArray[np.int64]]:
    """Return the rows and columns of the surface at which the nodes of a window of a level stand.

    int64, shape (row,) and (column,). Across the seam of a closed axis they go on beyond its end.
    """
    lines = []
    for line, (start, _), span, length in zip(
        level_nodes(header, level)[0], region, region_at(header, region, level), header.shape, strict=True
    ):
        places = line[np.arange(*span) % len(line)]
        lines.append(np.where(places < start, places + length, places))
    return lines


def _line(nodes: list[float] | None, span: tuple[int, int], length: int) -> list[float] | None:
    """Return the rows or columns of a window, in steps of the even grid from its first one; None if they are even."""
    if nodes is None:
        return None
    places = np.arange(*span)
    line = np.asarray(nodes, np.float64)[places % length] + places // length * length - span[0]
    return None if np.array_equal(line, places - span[0]) else line.tolist()
