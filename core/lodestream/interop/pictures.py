"""Surfaces drawn by matplotlib: heights as a shaded map, others in space."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..surface import Block, Surface

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["DPI", "SMALL", "draw_surface", "small_png"]

#: Pixels of an inch.
DPI = 100

#: Pixels of a small picture, along the longer side.
SMALL = 320

_LIGHT = 315, 45  # azimuth and altitude in degrees: north-west, as maps have it
_RELIEF = 0.15  # height of the relief for its shading, in widths of the surface


def draw_surface(figure: Figure, surface: Surface, pixels: int) -> None:
    """Draw a surface into an empty figure.

    Parameters
    ----------
    figure : matplotlib Figure
        Its size is set.
    surface : Surface
    pixels : int
        Of the longer side of a height field. In space there are a quarter as many nodes along an axis, since matplotlib
        draws each quad as a polygon.
    """
    if len(surface.blocks) == 1 and surface.blocks[0].points.ndim == 2:
        _heights(figure, surface.blocks[0], pixels)
    else:
        _in_space(figure, surface, pixels)


def small_png(surface: Surface) -> bytes | None:
    """A small picture of a surface as PNG; None where matplotlib is not installed."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        return None
    figure = Figure(layout="constrained", dpi=DPI)
    FigureCanvasAgg(figure)
    draw_surface(figure, Surface(blocks=[_thinned(block) for block in surface.blocks]), SMALL)
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return file.getvalue()


def _thinned(block: Block) -> Block:
    """Every so many rows and columns of a block, where it has more than a small picture shows."""
    rows, columns = (slice(None, None, max(1, length // SMALL)) for length in block.shape)
    mask = None if block.mask is None else block.mask[rows, columns]
    if mask is not None and not mask.any():
        return block
    return Block(block.points[rows, columns], block.closed, mask=mask)


def _heights(figure: Figure, block: Block, pixels: int) -> None:
    from matplotlib.colors import LightSource

    heights = _valid(block.points.astype(np.float64), block.mask)
    rows, columns = heights.shape
    scale = pixels / max(rows, columns)
    figure.set_size_inches(max(columns * scale, 300) / DPI + 1.5, max(rows * scale, 200) / DPI + 0.7)
    axes = figure.add_subplot()
    low, high = (float(edge) for edge in (np.nanmin(heights), np.nanmax(heights))) if heights.size else (0.0, 1.0)
    height = max(high - low, np.finfo(np.float64).tiny)
    image = axes.imshow(heights, cmap="terrain", vmin=low, vmax=high)
    if min(rows, columns) > 1:
        shaded = LightSource(*_LIGHT).shade(
            np.nan_to_num(heights, nan=low),
            image.cmap,
            blend_mode="soft",
            vmin=low,
            vmax=high,
            vert_exag=_RELIEF * max(rows, columns) / height,
        )
        shaded[..., 3] = np.isfinite(heights)
        axes.imshow(shaded)
    axes.set_axis_off()
    figure.colorbar(image, ax=axes, shrink=0.8)


def _in_space(figure: Figure, surface: Surface, pixels: int) -> None:
    figure.set_size_inches(0.8 * pixels / DPI, 0.8 * pixels / DPI)
    most = pixels // 4
    axes: Any = figure.add_subplot(projection="3d")
    for block in surface.blocks:
        points = _placed(_valid(block.points.astype(np.float64), block.mask))
        points = _wrapped(points, block.closed)
        every = [max(1, -(-count // most)) for count in points.shape[:2]]
        if min(points.shape[:2]) == 1:
            axes.plot(*points.reshape(-1, 3).T, color="#3b6ea5")
        else:
            x, y, z = np.moveaxis(points, 2, 0)
            axes.plot_surface(x, y, z, rstride=every[0], cstride=every[1], color="#8fb3d9", linewidth=0)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _valid(points: NDArray[np.float64], mask: NDArray[np.bool_] | None) -> NDArray[np.float64]:
    """Points (row, column, ...) with NaN in holes."""
    if mask is not None:
        points[~mask] = np.nan
    points[~np.isfinite(points)] = np.nan
    return points


def _placed(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points (row, column, xyz) of heights (row, column), of points in a plane, or of points in space."""
    if points.ndim == 2:
        rows, columns = np.indices(points.shape, np.float64)
        return np.stack([columns, -rows, points], axis=2)
    if points.shape[2] < 3:
        padding = np.zeros((*points.shape[:2], 3 - points.shape[2]))
        return np.concatenate([points, padding], axis=2)
    return points[..., :3]


def _wrapped(points: NDArray[np.float64], closed: tuple[bool, bool]) -> NDArray[np.float64]:
    for axis in (0, 1):
        if closed[axis]:
            points = np.concatenate([points, np.take(points, [0], axis)], axis)
    return points
