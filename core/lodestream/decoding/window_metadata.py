"""A window of a surface of one block: which of its axes wrap, and metadata that say where it lies."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..coordinates.coordinate_rules import VALUES, Rule, evaluate
from ..coordinates.height_fields import window_axes
from ..surface import Closed
from ..target import Region

__all__ = ["window_closed", "window_grid", "window_metadata"]


def window_closed(closed: Closed, shape: tuple[int, int], region: Region) -> Closed:
    """Which axes of a window wrap: those that do in the surface, where the window holds all of them."""
    rows, columns = (
        wraps and stop - start == length for wraps, (start, stop), length in zip(closed, region, shape, strict=True)
    )
    return rows, columns


def window_grid(rules: list[Rule], shape: tuple[int, int], region: Region) -> dict[str, Any]:
    """Metadata by which the heights of a window get back x and y, see `lodestream.coordinates.height_fields`."""
    anywhere = []
    for rule, length, down in zip(rules, (shape[1], shape[0]), (False, True), strict=True):
        if rule[-1] is True:
            # Its last number is that of the last place of the surface.
            place = np.arange(length, dtype=np.float64).reshape((-1, 1) if down else (1, -1))
            anywhere.append([*evaluate(rule, place, place, down).ravel().tolist(), VALUES])
        else:
            anywhere.append(rule)
    return {"grid": anywhere, "nodes": [[*range(*span)] for span in region]}


def window_metadata(metadata: dict[str, Any], shape: tuple[int, int], region: Region) -> dict[str, Any]:
    """Metadata of a window of a surface of this shape: a geotransform, or axes, move with it."""
    (top, _), (left, _) = region
    values = {key: value for key, value in metadata.items() if key not in ("seam", "turn", "poles")}
    if (transform := values.get("geotransform")) is not None:
        x0, x_column, x_row, y0, y_column, y_row = transform
        x0, y0 = x0 + left * x_column + top * x_row, y0 + left * y_column + top * y_row
        values["geotransform"] = [x0, x_column, x_row, y0, y_column, y_row]
    if "axes" in values:
        values["axes"] = window_axes(values["axes"], shape, *region)
    return values
