"""Write ESRI ASCII grids: a short header, then heights as text from the north-west corner on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...surface import Surface
from ..notes import metadata_left_out, warn, warn_left_out
from .writing_heights import even_heights, geotransform, warn_off

__all__ = ["write"]

_TITLE = "ESRI ASCII grid"
_HELD = ("geotransform", "grid", "axes")

#: What stands for holes where the surface does not say so, or a height has that value.
_NODATA = (-9999, -99999, -999999, -32768, -2147483648)

#: The place of a grid that has none: x is the column, y is the row.
_NOWHERE = (-0.5, 1.0, 0.0, -0.5, 0.0, 1.0)


def write(surface: Surface, file: BinaryIO) -> None:
    """Write heights, row by row from the north, with every digit that they need, and the number that marks holes.

    Cells that are not square are written as ``dx`` and ``dy``, which GDAL reads.

    Raises
    ------
    FormatError
        If these are no heights on an even grid.
    """
    surface = even_heights(surface, _TITLE)
    transform = geotransform(surface)
    if transform is not None and (transform[2] or transform[4]):
        warn(f"{_TITLE} is written without its place, since the grid is rotated")
        transform = None
    elif transform is not None:
        warn_off(surface, transform, _TITLE)
    closed = ["closure"] * any(surface.closed)
    warn_left_out(_TITLE, [*surface.attributes, *closed, *metadata_left_out(surface, _HELD)])
    x0, dx, _, y0, _, dy = _NOWHERE if transform is None else transform
    heights, mask = surface.points, surface.mask
    if dy > 0:
        heights, mask, y0, dy = np.flipud(heights), _flipped(mask, 0), y0 + dy * len(heights), -dy
    if dx < 0:
        heights, mask, x0, dx = np.fliplr(heights), _flipped(mask, 1), x0 + dx * heights.shape[1], -dx
    rows, columns = heights.shape
    lines = [f"ncols {columns}", f"nrows {rows}", f"xllcorner {x0!r}", f"yllcorner {y0 + dy * rows!r}"]
    if dx == -dy:
        lines.append(f"cellsize {dx!r}")
    else:
        warn(f"{_TITLE} is written with dx and dy, since the cells are not square; not all programs read that")
        lines += [f"dx {dx!r}", f"dy {-dy!r}"]
    nodata = _nodata(surface, heights, mask)
    if nodata is not None:
        lines.append(f"NODATA_value {nodata}")
    file.write("".join(f"{line}\n" for line in lines).encode())
    _write_rows(file, heights, mask, str(nodata))


def _flipped(mask: NDArray[np.bool_] | None, axis: int) -> NDArray[np.bool_] | None:
    return None if mask is None else np.flip(mask, axis)


def _write_rows(file: BinaryIO, heights: NDArray[Any], mask: NDArray[np.bool_] | None, nodata: str) -> None:
    for number, row in enumerate(heights):
        # The shortest digits that read back as the same number in the type of the heights.
        words: Sequence[str] = row.tolist() if row.dtype.kind in "iu" else [str(value) for value in row]
        if mask is not None:
            words = [word if there else nodata for word, there in zip(words, mask[number].tolist(), strict=True)]
        file.write((" ".join(map(str, words)) + "\n").encode())


def _nodata(surface: Surface, heights: NDArray[Any], mask: NDArray[np.bool_] | None) -> int | float | None:
    """Return the number that marks holes: the surface's nodata value even without holes; None without either."""
    valid = heights if mask is None else heights[mask]
    given = surface.metadata.get("nodata")
    candidates: list[int | float] = []
    if isinstance(given, int | float) and not isinstance(given, bool) and np.isfinite(given):
        whole = float(given).is_integer()
        # Among integers a number with a fraction would make a program read all of them as floats.
        candidates += [int(given)] if whole and heights.dtype.kind in "iu" else [given] * (heights.dtype.kind == "f")
    if mask is not None:
        candidates += _NODATA
    free = [value for value in candidates if not (valid == value).any()]
    if free or mask is None:
        return free[0] if free else None
    return int(np.floor(valid.min())) - 1
