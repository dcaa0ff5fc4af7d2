"""A window of a surface: its points, and metadata that say where it lies."""

from __future__ import annotations

from typing import Any

from .heights import window_axes
from .surface import Surface
from .target import Region

__all__ = ["window_of"]


def window_of(surface: Surface, metadata: dict[str, Any], region: Region) -> tuple[Surface, dict[str, Any]]:
    """Cut a window out of a surface of one block.

    An axis that wraps is open in a window that does not hold all of it. A geotransform moves with the window.

    Raises
    ------
    InputError
        When no point of the window is valid.
    """
    (top, bottom), (left, right) = region
    block = surface.blocks[0]
    place = slice(top, bottom), slice(left, right)
    closed = tuple(
        wraps and stop - start == length
        for wraps, (start, stop), length in zip(block.closed, region, block.shape, strict=True)
    )
    mask = None if block.mask is None else block.mask[place]
    attributes = {name: values[place] for name, values in block.attributes.items()}
    values = {key: value for key, value in metadata.items() if key not in ("seam", "turn", "poles")}
    if (transform := values.get("geotransform")) is not None:
        x0, x_column, x_row, y0, y_column, y_row = transform
        x0, y0 = x0 + left * x_column + top * x_row, y0 + left * y_column + top * y_row
        values["geotransform"] = [x0, x_column, x_row, y0, y_column, y_row]
    if "axes" in values:
        values["axes"] = window_axes(values["axes"], block.shape, *region)
    window = Surface(block.points[place], (closed[0], closed[1]), mask=mask, attributes=attributes)
    return window, values
