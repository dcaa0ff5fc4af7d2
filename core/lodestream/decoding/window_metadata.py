"""A window of a surface of one block: which of its axes wrap, and metadata that say where it lies."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..coordinates.height_fields import axes_at
from ..surface import Closed
from ..target import Region

__all__ = ["window_closed", "window_metadata"]


def window_closed(closed: Closed, shape: tuple[int, int], region: Region) -> Closed:
    """Which axes of a window wrap: those that do in the surface, where the window holds all of them."""
    rows, columns = (
        wraps and stop - start == length for wraps, (start, stop), length in zip(closed, region, shape, strict=True)
    )
    return rows, columns


def window_metadata(metadata: dict[str, Any], shape: tuple[int, int], region: Region) -> dict[str, Any]:
    """Metadata of a window of a surface of this shape: a geotransform, or axes, move with it.

    Across the seam of a closed axis both go on, beyond the end of the surface.
    """
    (top, _), (left, _) = region
    values = {key: value for key, value in metadata.items() if key not in ("seam", "turn", "poles")}
    if (transform := values.get("geotransform")) is not None:
        x0, x_column, x_row, y0, y_column, y_row = transform
        x0, y0 = x0 + left * x_column + top * x_row, y0 + left * y_column + top * y_row
        values["geotransform"] = [x0, x_column, x_row, y0, y_column, y_row]
    if "axes" in values:
        values["axes"] = axes_at(values["axes"], shape, [np.arange(*span) for span in region])
    return values
